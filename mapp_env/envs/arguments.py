"""What each face is told when it is made: the fields of a task, and few of its own."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, overload

from mapp_env.engine.task import Task
from mapp_env.validation import check_choice

try:
    from gymnasium.vector import AutoresetMode
except ImportError:  # Gymnasium 1.0 has the next-step mode alone, and no name for it
    from enum import Enum

    class AutoresetMode(Enum):  # type: ignore[no-redef]
        """The modes of Gymnasium 1.1 and later."""

        NEXT_STEP = "NextStep"
        SAME_STEP = "SameStep"
        DISABLED = "Disabled"


__all__ = ["BATCH_RENDER_MODES", "AutoresetMode", "BatchTask", "CentralTask", "TupleTask", "takes"]

CENTRAL_ACTIONS = ("auto", "joint", "multi")
BATCH_RENDER_MODES = ("rgb_array", "ansi")


@dataclass(frozen=True)
class TupleTask(Task):
    """A task in which agents see themselves first, unless something else is asked for."""

    observation: str = "own_first"


@dataclass(frozen=True)
class CentralTask(Task):
    """A task, and how the meta-agent's actions are given."""

    central_action: str = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("central_action", self.central_action, CENTRAL_ACTIONS)


@dataclass(frozen=True)
class BatchTask(CentralTask):
    """The same for a batch, and what happens at the end of a row's episode."""

    central_action: str = "multi"
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("render_mode", self.render_mode, (None, *BATCH_RENDER_MODES))
        if not isinstance(self.autoreset_mode, AutoresetMode):
            modes = {each.value: each for each in AutoresetMode} | dict(AutoresetMode.__members__)
            name = check_choice("autoreset_mode", self.autoreset_mode, modes)
            object.__setattr__(self, "autoreset_mode", modes[name])


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

    Signature, help and positional use are as if the fields of the class ``task`` were written out.
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
