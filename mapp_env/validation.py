"""Checks of what users pass in: every refusal names the argument, its value and what is allowed."""

from __future__ import annotations

import math
import operator
import reprlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_SEED = 2**128 - 1

# Looks at the first few items alone: a refusal should not take as long as printing a whole list.
_SHORT = reprlib.Repr()
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 8
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 300


def describe(value: object, limit: int = 100) -> str:
    """Return ``repr(value)``, cut so that a message stays readable whatever was passed."""
    if isinstance(value, np.ndarray) and (value.ndim > 1 or value.size > 16):
        return f"array of shape {value.shape} and dtype {value.dtype}"
    try:
        text = _SHORT.repr(value)
    except Exception:  # a hostile __repr__, or a number with more digits than Python prints
        text = f"a {type(value).__name__}"
    return text if len(text) <= limit else f"{text[: limit - 3]}..."


def as_integer(value: object) -> int | None:
    """Return ``value`` as an ``int``, or ``None`` if it is not a whole number by its type.

    Booleans and floats (even ``2.0``) are not: a count that went through arithmetic is more often
    a mistake than a wish.
    """
    if isinstance(value, bool | np.bool_):
        return None
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return None


def as_array(value: Any) -> NDArray[Any]:
    """Return ``value`` as an array; one without axes if it is ragged or nested too deep."""
    try:
        return np.asarray(value)
    except (ValueError, RecursionError):
        return np.array(None)


def as_real(value: object) -> float | None:
    """Return ``value`` as a finite ``float``, or ``None`` if it is no real number by its type."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def check_count(name: str, value: object, low: int, high: int) -> int:
    """Return ``value`` as an ``int`` between ``low`` and ``high``, both included.

    Raises a ValueError if ``value`` is not an integer (booleans and floats are not) or out of
    range.
    """
    number = as_integer(value)
    if number is None or not low <= number <= high:
        raise ValueError(f"{name} must be an integer in {low}..{high}, got {describe(value)}")
    return number


def check_choice(name: str, value: object, allowed: Iterable[str | None]) -> Any:
    """Return ``value`` if it is one of ``allowed``.

    Raises a ValueError if it is not; the message lists what is allowed.
    """
    options: Sequence[str | None] = tuple(allowed)
    if (value is None or isinstance(value, str)) and value in options:
        return value
    listed = ", ".join(repr(option) for option in options)
    raise ValueError(f"{name} must be one of {listed}; got {describe(value)}")


def check_flag(name: str, value: object) -> bool:
    """Return ``value`` if it is ``True`` or ``False``.

    Raises a ValueError if ``value`` is anything else, numbers included.
    """
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {describe(value)}")
    return bool(value)


def check_number(name: str, value: object, low: float, high: float) -> float:
    """Return ``value`` as a ``float`` between ``low`` and ``high``, both included.

    Raises a ValueError if ``value`` is not a finite number (a boolean is not) or out of range.
    """
    number = as_real(value)
    if number is None or not low <= number <= high:
        raise ValueError(f"{name} must be a number in {low:g}..{high:g}, got {describe(value)}")
    return number
