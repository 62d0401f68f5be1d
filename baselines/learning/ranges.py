"""What an option may be, said beside its field and checked from there."""

import dataclasses
import functools
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from mapp_env.validation import check_choice, check_count, check_flag, check_number


class Within(NamedTuple):
    """What a number may be, beside its type."""

    least: float
    most: float


Share = Annotated[float, Within(0.0, 1.0)]
Positive = Annotated[float, Within(1e-6, 1e6)]


def check_options(options: Any) -> None:
    """Raise a ValueError for a value that the annotations of a dataclass do not allow."""
    for name, (kind, *metadata) in _annotations(options.__class__).items():
        value = getattr(options, name)
        if kind is bool:
            check_flag(name, value)
        elif get_origin(kind) is Literal:
            check_choice(name, value, get_args(kind))
        for bounds in metadata:
            if isinstance(bounds, Within) and kind is int:
                check_count(name, value, int(bounds.least), int(bounds.most))
            elif isinstance(bounds, Within):
                check_number(name, value, *bounds)


@functools.cache
def _annotations(kind: type) -> dict[str, tuple[Any, ...]]:
    """Return of each field its type, and what else its annotation says."""
    hints = get_type_hints(kind, include_extras=True)
    return {
        field.name: get_args(hint) if get_origin(hint) is Annotated else (hint,)
        for field in dataclasses.fields(kind)
        for hint in [hints[field.name]]
    }


def allowed_values(kind: type, name: str) -> tuple[str, ...]:
    """Return what a field may be."""
    return get_args(_annotations(kind)[name][0])
