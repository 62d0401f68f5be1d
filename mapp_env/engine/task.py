"""A task: everything an environment is told when it is made, validated, and the tables it needs."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.observation import PATH_OBSERVATIONS, Observation, View, view, view_distances
from mapp_env.engine.rules import PATH_REWARDS, Reward, reward_distances
from mapp_env.engine.state import N_ACTIONS, NO_DISTANCES, World, cell_table
from mapp_env.grid import MAX_ALL_PAIRS_CELLS, Grid
from mapp_env.grids import find_grid
from mapp_env.problem import MAX_AGENTS, MAX_CYCLES, MAX_LANDMARKS, check_grid
from mapp_env.validation import check_choice, check_count, check_flag

RENDER_MODES = ("human", "rgb_array", "ansi")

MAX_BYTES = 1 << 30
"""Largest array of one kind (observations, distance fields) that an environment may need."""


class GridLike:
    """A field that is given a grid, its name or its path, and holds the grid."""

    @overload
    def __get__(self, task: None, owner: type) -> str: ...

    @overload
    def __get__(self, task: Task, owner: type) -> Grid: ...

    def __get__(self, task: Task | None, owner: type) -> str | Grid:
        return "paper-7x7" if task is None else task.__dict__["grid"]

    def __set__(self, task: Task, grid: str | os.PathLike[str] | Grid) -> None:
        task.__dict__["grid"] = find_grid(grid)


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

    def __post_init__(self) -> None:
        values = {
            "n_agents": check_count("n_agents", self.n_agents, 1, MAX_AGENTS),
            "n_landmarks": check_count("n_landmarks", self.n_landmarks, 1, MAX_LANDMARKS),
            "max_cycles": check_count("max_cycles", self.max_cycles, 1, MAX_CYCLES),
            "reward": check_choice("reward", self.reward, _names(Reward)),
            "observation": check_choice("observation", self.observation, _names(Observation)),
            "allow_wait": check_flag("allow_wait", self.allow_wait),
            "render_mode": check_choice("render_mode", self.render_mode, (None, *RENDER_MODES)),
        }
        check_grid("grid", self.grid)
        for name, value in values.items():
            object.__setattr__(self, name, value)
        room = self.grid.reachable.size
        if self.n_landmarks > room:
            raise ValueError(
                f"n_landmarks must be at most {room}, the cells of {self.grid!r} that can be "
                f"reached from its depot; got {self.n_landmarks}"
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
    def n_actions(self) -> int:
        """Number of actions an agent has: 4, or 5 with waiting."""
        return N_ACTIONS + self.allow_wait

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
        return view(self.observation_kind, self.grid, self.n_agents, self.n_landmarks)

    @cached_property
    def state_view(self) -> View:
        """Shape and bounds of the global observation."""
        return view(Observation.GLOBAL, self.grid, self.n_agents, self.n_landmarks)

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
        """Whether paths are kept for each landmark, the grid being too large for all pairs."""
        wanted = self.reward_kind in PATH_REWARDS or self.observation_kind in PATH_OBSERVATIONS
        return wanted and self.grid.n_cells > MAX_ALL_PAIRS_CELLS

    def world(self, fields: NDArray[np.int32]) -> World:
        """Return what the kernels look up; ``fields`` as in :func:`make_world`."""
        sizes = self.n_agents, self.n_landmarks
        return make_world(self.grid, *sizes, self.reward_kind, self.observation_kind, fields)

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
                f"agents on {self.grid!r} would take {size} bytes a step, allowed are {MAX_BYTES}"
            )
        if n_rows * n_joint_actions > MAX_BYTES:
            raise ValueError(
                f"central_action: masks of {n_joint_actions} joint actions of {n_rows} rows "
                f"would take {n_rows * n_joint_actions} bytes a step, allowed are {MAX_BYTES}: "
                "use 'multi'"
            )
        size = 4 * n_rows * self.n_landmarks * self.grid.n_cells
        if self.needs_fields and size > MAX_BYTES:
            raise ValueError(
                f"geodesic distances of {n_rows} environment(s) with {self.n_landmarks} landmarks "
                f"on {self.grid!r} would take {size} bytes, allowed are {MAX_BYTES}"
            )


def make_world(
    grid: Grid,
    n_agents: int,
    n_landmarks: int,
    reward: Reward = Reward.STEP,
    observation: Observation = Observation.GLOBAL,
    fields: NDArray[np.int32] = NO_DISTANCES[:0],
) -> World:
    """Return what the rules look up on a grid; sizes are not checked here.

    ``fields``, shape (B * K, C), is where shortest paths from the rows' landmarks will stand; if it
    is empty, those of all pairs do. Raises a ValueError if shortest paths are looked up, without
    fields, on a grid too large for all pairs.
    """
    return World(
        n_agents,
        n_landmarks,
        int(reward),
        int(observation),
        cell_table(grid),
        *reward_distances(reward, grid, fields),
        *view_distances(observation, grid, fields),
    )


def _names(kinds: type[Reward] | type[Observation]) -> tuple[str, ...]:
    return tuple(kind.name.lower() for kind in kinds)
