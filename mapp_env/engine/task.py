"""A task: everything an environment is told when it is made, validated."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.observation import Observation, View, view
from mapp_env.engine.rules import Reward
from mapp_env.engine.state import N_ACTIONS, World
from mapp_env.engine.world import make_world, needs_paths
from mapp_env.grid import MAX_ALL_PAIRS_CELLS, Grid
from mapp_env.grids import find_grids
from mapp_env.problem import MAX_AGENTS, MAX_CYCLES, MAX_LANDMARKS, check_grid
from mapp_env.validation import check_choice, check_count, check_flag

RENDER_MODES = ("human", "rgb_array", "ansi")
ACTIONS = ("moves", "landmarks")  # in the order of state.MOVES and state.LANDMARKS

MAX_BYTES = 1 << 30
"""Largest array of one kind (tables, observations, paths) that an environment may need."""

TABLE_BYTES = 21  # of a cell in a world's open and home, and moves where paths are looked up


class GridLike:
    """A field that is given a grid, its name, its path or a pool, and holds a grid or a tuple."""

    def __get__(self, task: Task | None, owner: type) -> Any:
        return "paper-7x7" if task is None else task.__dict__["grid"]

    def __set__(self, task: Task, grid: object) -> None:
        task.__dict__["grid"] = find_grids(grid)


@dataclass(frozen=True)
class Task:
    """What an environment is made of: the arguments that all faces take, validated.

    Their meaning is said once, in :class:`mapp_env.envs.parallel_env.MappParallelEnv`.

    Raises a ValueError if an argument is invalid, or what they ask for together would not fit in
    memory.
    """

    grid: GridLike = GridLike()
    n_agents: int = 3
    n_landmarks: int = 5
    max_cycles: int = 50
    reward: str = "manhattan"
    observation: str = "global"
    allow_wait: bool = False
    render_mode: str | None = None
    _: KW_ONLY
    actions: str = "moves"
    return_home: bool = False

    def __post_init__(self) -> None:
        values = {
            "n_agents": check_count("n_agents", self.n_agents, 1, MAX_AGENTS),
            "n_landmarks": check_count("n_landmarks", self.n_landmarks, 1, MAX_LANDMARKS),
            "max_cycles": check_count("max_cycles", self.max_cycles, 1, MAX_CYCLES),
            "reward": check_choice("reward", self.reward, _names(Reward)),
            "observation": check_choice("observation", self.observation, _names(Observation)),
            "allow_wait": check_flag("allow_wait", self.allow_wait),
            "render_mode": check_choice("render_mode", self.render_mode, (None, *RENDER_MODES)),
            "actions": check_choice("actions", self.actions, ACTIONS),
            "return_home": check_flag("return_home", self.return_home),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)
        if self.allow_wait and self.actions == "landmarks":
            raise ValueError(
                "allow_wait must be False with actions='landmarks', where the last action is to "
                "stay (with return_home: to walk home); got True"
            )
        size = TABLE_BYTES * sum(grid.n_cells for grid in self.grids)
        if size > MAX_BYTES:
            raise ValueError(
                f"grid: tables of {len(self.grids)} grid(s) would take {size} bytes, allowed are "
                f"{MAX_BYTES}"
            )
        for index, grid in enumerate(self.grids):
            name = f"grid[{index}]" if self.is_pool else "grid"
            room = check_grid(name, grid).reachable.size
            if self.n_landmarks > room:
                raise ValueError(
                    f"n_landmarks must be at most {room}, the cells of {name}, {grid!r}, that can "
                    f"be reached from its depot; got {self.n_landmarks}"
                )
        self.check_memory(1)

    def __getstate__(self) -> dict[str, Any]:
        """Copy the arguments alone: copies of the read-only tables would not be read-only."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy."""
        for name, value in state.items():
            object.__setattr__(self, name, value)

    # -- what follows from the arguments -----------------------------------------------

    @property
    def is_pool(self) -> bool:
        """Whether each episode draws its grid (R10), be it of one only."""
        return isinstance(self.grid, tuple)

    @property
    def grids(self) -> tuple[Grid, ...]:
        """The grids that episodes are on: one, or those of the pool."""
        return self.grid if self.is_pool else (self.grid,)

    @cached_property
    def numbers(self) -> dict[Grid, int]:
        """The number of each grid; of equal ones the first."""
        return {grid: index for index, grid in reversed(list(enumerate(self.grids)))}

    @cached_property
    def largest(self) -> int:
        """Number of cells of the largest grid."""
        return max(grid.n_cells for grid in self.grids)

    @property
    def action_kind(self) -> int:
        """What actions are, as the kernels know it."""
        return ACTIONS.index(self.actions)

    @property
    def n_actions(self) -> int:
        """Number of actions an agent has: 4, or 5 with waiting; or one more than landmarks."""
        moves = N_ACTIONS + self.allow_wait
        return moves if self.actions == "moves" else self.n_landmarks + 1

    @property
    def reward_kind(self) -> Reward:
        """The reward as the kernels know it."""
        return Reward[self.reward.upper()]

    @property
    def observation_kind(self) -> Observation:
        """The observation as the kernels know it."""
        return Observation[self.observation.upper()]

    @cached_property
    def view(self) -> View:
        """Shape and bounds of one agent's observation."""
        return view(self.observation_kind, self.grids, self.n_agents, self.n_landmarks)

    @cached_property
    def state_view(self) -> View:
        """Shape and bounds of the global observation."""
        return view(Observation.GLOBAL, self.grids, self.n_agents, self.n_landmarks)

    @cached_property
    def central_view(self) -> View:
        """Shape and bounds of what the meta-agent sees: every agent's view, or the global one."""
        one = self.view
        if self.observation_kind == Observation.GLOBAL:
            return one
        low, high = (np.repeat(bound[None], self.n_agents, axis=0) for bound in (one.low, one.high))
        return View((self.n_agents, *one.shape), low, high)

    @property
    def needs_fields(self) -> bool:
        """Whether paths are kept for each landmark, the grids being too many for all pairs."""
        few = len(self.grids) == 1 and self.largest <= MAX_ALL_PAIRS_CELLS
        return not few and needs_paths(self.reward_kind, self.observation_kind, self.action_kind)

    def world(self, fields: NDArray[np.int32]) -> World:
        """Return what the kernels look up; ``fields`` as in :func:`make_world`."""
        return make_world(
            self.grids,
            self.n_agents,
            self.n_landmarks,
            self.reward_kind,
            self.observation_kind,
            fields,
            self.action_kind,
            self.return_home,
        )

    def check_memory(self, n_rows: int, n_joint_actions: int = 0) -> None:
        """Check that the arrays for a number of rows fit in memory.

        Raises a ValueError if the observations or the joint actions' masks of one step, or the
        distance fields, take more than 1 GiB.
        """
        views = 1 if self.observation_kind == Observation.GLOBAL else self.n_agents
        size = 4 * n_rows * views * int(np.prod(self.view.shape))
        if size > MAX_BYTES:
            raise ValueError(
                f"observation={self.observation!r} of {n_rows} environment(s) with {self.n_agents} "
                f"agents on {self._where} would take {size} bytes a step, allowed are {MAX_BYTES}"
            )
        if n_rows * n_joint_actions > MAX_BYTES:
            raise ValueError(
                f"central_action: masks of {n_joint_actions} joint actions of {n_rows} rows "
                f"would take {n_rows * n_joint_actions} bytes a step, allowed are {MAX_BYTES}: "
                "use 'multi'"
            )
        size = 4 * n_rows * self.n_landmarks * self.largest
        if self.needs_fields and size > MAX_BYTES:
            raise ValueError(
                f"geodesic distances of {n_rows} environment(s) with {self.n_landmarks} landmarks "
                f"on {self._where} would take {size} bytes, allowed are {MAX_BYTES}"
            )

    @property
    def _where(self) -> str:
        """The grids, for messages."""
        if not self.is_pool:
            return repr(self.grid)
        return f"{len(self.grids)} grids of up to {self.largest} cells"


def _names(kinds: type[Reward] | type[Observation]) -> tuple[str, ...]:
    return tuple(kind.name.lower() for kind in kinds)
