"""The arguments of an environment stand once, as the fields of a task: faces take them over."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, overload

from mapp_env.engine.task import Task

__all__ = ["takes"]

P = ParamSpec("P")
S = TypeVar("S")
T = TypeVar("T", bound=Task, covariant=True)


class _Taking(Protocol[P, T]):
    @overload
    def __call__(self, init: Callable[[S, T], None], /) -> Callable[Concatenate[S, P], None]: ...

    @overload
    def __call__(
        self, init: Callable[[S, int, T], None], /
    ) -> Callable[Concatenate[S, int, P], None]: ...


def takes(task: Callable[P, T]) -> _Taking[P, T]:
    """Let an ``__init__`` whose last argument is a task take what the task is made from instead.

    Signature, help and positional use are as if the fields were written out.

    Parameters
    ----------
    task : type
        A :class:`~mapp_env.engine.task.Task`, or a subclass with other fields or defaults.
    """

    def decorate(init: Callable[..., None]) -> Any:
        own = list(inspect.signature(init).parameters.values())[:-1]
        make: Callable[..., T] = task  # the caller's arguments are its own
        whole = inspect.Signature([*own, *inspect.signature(task).parameters.values()])

        @wraps(init)
        def made(*args: Any, **kwargs: Any) -> None:
            given = whole.bind(*args, **kwargs).arguments
            before = [given.pop(each.name) for each in own]
            init(*before, make(**given))

        made.__signature__ = whole  # type: ignore[attr-defined]
        return made

    return decorate
