"""Checks of a configuration: every refusal names the argument, its value and what is allowed."""

import math
from numbers import Integral, Real


def check_count(name: str, value: object, low: int, high: int) -> None:
    """Refuse what is not a whole number in ``[low, high]``.

    Raises
    ------
    ValueError
        If `value` is a bool, fractional, or out of the range.
    """
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or not low <= value <= high:  # type: ignore[operator]
        raise ValueError(f"{name} must be a whole number from {low} to {high}, got {value!r}")


def check_number(name: str, value: object, low: float, high: float) -> None:
    """Refuse what is not a finite number in ``[low, high]``.

    Raises
    ------
    ValueError
        If `value` is a bool, not finite, or out of the range.
    """
    real = isinstance(value, Real) and not isinstance(value, bool)
    if not real or not math.isfinite(value) or not low <= value <= high:  # type: ignore
        raise ValueError(f"{name} must be a number from {low:g} to {high:g}, got {value!r}")


def check_choice(name: str, value: object, allowed: tuple[str, ...]) -> None:
    """Refuse what is not one of the `allowed` words.

    Raises
    ------
    ValueError
        If `value` is none of them.
    """
    if value not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {value!r}")
