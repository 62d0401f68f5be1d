"""One problem: a grid, the landmarks on it and how many agents there are; and drawing them."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapp_env.draws import draw_landmarks
from mapp_env.engine.rules import reset_row, step_row
from mapp_env.engine.state import WAIT, new_rows, split
from mapp_env.engine.world import make_world
from mapp_env.files import FileError
from mapp_env.grid import Grid
from mapp_env.records import MAX_PROBLEM_BYTES, Record, read_record, write_record
from mapp_env.validation import as_array, check_count, describe

MAX_AGENTS = 16
MAX_LANDMARKS = 256
MAX_CYCLES = 1_000_000

MAX_LISTED = 1_000_000  # problems of a grid that are listed to draw from; beyond, by rejection


@dataclass(frozen=True)
class Problem:
    """What is to be solved: a team visits every landmark of a grid.

    Parameters
    ----------
    grid : Grid
        The grid with its depot.
    landmarks : sequence of int or of (int, int)
        1 to 256 distinct cells, or their rows and columns: free, reachable from the depot and not
        the depot (rule R2). Their order is kept.
    n_agents : int
        1 to 16.
    max_cycles : int, optional
        Step limit of an episode on this problem; without it, the environment's own.
    starts : sequence of int or of (int, int), optional
        Where each agent stands at first: cells reachable from the depot, or the depot itself, none
        of them a landmark; several agents may share one. Without it all start on the depot.

    Attributes
    ----------
    start_cells : tuple of int
        Each agent's first cell, whether ``starts`` was given or not.

    Raises
    ------
    ValueError
        If any of them is invalid; the message names argument, value and what is allowed.
    """

    grid: Grid
    landmarks: tuple[int, ...]
    n_agents: int = 3
    max_cycles: int | None = None
    # Not compared: that all start on the depot may be said or left out.
    starts: tuple[int, ...] | None = field(default=None, compare=False)
    start_cells: tuple[int, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_grid("grid", self.grid)
        object.__setattr__(self, "landmarks", check_landmarks(self.grid, self.landmarks))
        object.__setattr__(self, "n_agents", check_count("n_agents", self.n_agents, 1, MAX_AGENTS))
        if self.max_cycles is not None:
            limit = check_count("max_cycles", self.max_cycles, 1, MAX_CYCLES)
            object.__setattr__(self, "max_cycles", limit)
        cells = (self.grid.depot,) * self.n_agents
        if self.starts is not None:
            cells = check_starts(self.grid, self.starts, self.n_agents, self.landmarks)
            object.__setattr__(self, "starts", cells)
        object.__setattr__(self, "start_cells", cells)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the problem as JSON, grid included, whole or not at all.

        Parameters
        ----------
        path : str or os.PathLike
            The file; replaced if it is there.

        Raises
        ------
        ValueError
            If the file cannot be written.
        """
        write_record(path, "problem", self.to_record(), MAX_PROBLEM_BYTES)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Problem:
        """Read a problem from a file that :meth:`save` wrote.

        Raises
        ------
        ValueError
            If it is not such a file, in any detail.
        """
        return cls.from_record(read_record(path, "problem", MAX_PROBLEM_BYTES))

    def after(self, joint_actions: ArrayLike) -> Problem | None:
        """Return the problem that is left after some steps by the rules.

        Its landmarks are those that are not visited, in the same order, its starts the cells where
        the agents stand. A step limit is lowered by the steps taken.

        Parameters
        ----------
        joint_actions : array_like of int, shape (T, N)
            0 left, 1 right, 2 up, 3 down, 4 wait for each agent at each step. Those after the last
            landmark is visited are not carried out.

        Returns
        -------
        Problem or None
            ``None`` if every landmark is visited.

        Raises
        ------
        ValueError
            If the shape is wrong, an action is not one, or landmarks are left when the step limit
            is reached.
        """
        actions = check_joint_actions(joint_actions, self.n_agents)
        n_landmarks = len(self.landmarks)
        world = make_world(self.grid, self.n_agents, n_landmarks)
        row = new_rows(1, self.n_agents, n_landmarks)[0]
        landmarks, cells = np.array(self.landmarks, np.int32), np.array(self.start_cells, np.int32)
        reset_row(row, landmarks, cells, world)
        limit = self.max_cycles or MAX_CYCLES + len(actions)
        for joint_action in actions:
            _, terminated, truncated = step_row(row, joint_action, limit, world)
            if terminated:
                return None
            if truncated:
                raise ValueError(
                    f"joint_actions must be less than the problem's step limit of {limit} if "
                    f"landmarks are left, got {len(actions)} steps"
                )
        state = split(row, self.n_agents, n_landmarks)
        return Problem(
            self.grid,
            tuple(landmarks[state.visited == 0].tolist()),
            self.n_agents,
            None if self.max_cycles is None else limit - len(actions),
            tuple(state.cells.tolist()),
        )

    def to_record(self) -> dict[str, Any]:
        """Return the problem as the fields of a file."""
        return {
            "grid": self.grid.to_text(),
            "landmarks": self.landmarks,
            "n_agents": self.n_agents,
            "max_cycles": self.max_cycles,
            "starts": self.starts,
        }

    @classmethod
    def from_record(cls, record: Record) -> Problem:
        """Return the problem that the fields of a file describe.

        Raises
        ------
        FileError
            If a field is missing, unknown or not as it must be.
        """
        text = record.text("grid", MAX_PROBLEM_BYTES)
        landmarks = record.cells("landmarks")
        n_agents = record.number("n_agents")
        max_cycles = record.number("max_cycles", null=None)
        starts = None if record.version < 2 else record.cells("starts", null=None)
        record.finish()
        try:
            return cls(Grid.from_text(text), landmarks, n_agents, max_cycles, starts)
        except ValueError as error:
            raise FileError(f"{record.where}: {error}") from error


def check_joint_actions(joint_actions: Any, n_agents: int) -> NDArray[np.int64]:
    """Return joint actions as an int64 array of shape (T, N).

    Raises a ValueError if the shape is wrong or an action is not one.
    """
    array = as_array(joint_actions)
    if array.shape in ((0,), (0, n_agents)):
        return np.empty((0, n_agents), np.int64)
    if array.ndim != 2 or array.shape[1] != n_agents or array.dtype.kind not in "iu":
        raise ValueError(
            f"joint_actions must be integers of shape (T, {n_agents}), "
            f"got {describe(joint_actions)}"
        )
    wrong = np.argwhere((array < 0) | (array > WAIT))
    if len(wrong):
        step, agent = wrong[0].tolist()
        raise ValueError(
            f"joint_actions[{step}, {agent}] must be in 0..{WAIT}, got {array[step, agent]}"
        )
    return np.ascontiguousarray(array, np.int64)


def check_grid(name: str, value: object) -> Grid:
    """Return ``value`` if it is a grid on which a landmark can stand.

    Raises a ValueError if it is not a :class:`Grid`, or nothing but the depot can be reached.
    """
    if not isinstance(value, Grid):
        raise ValueError(f"{name} must be a mapp_env.Grid, got {describe(value)}")
    if value.reachable.size == 0:
        raise ValueError(f"{name} must have a free cell reachable from its depot, got {value!r}")
    return value


def check_landmarks(
    grid: Grid, landmarks: object, count: int | None = None, name: str = "landmarks"
) -> tuple[int, ...]:
    """Return ``landmarks``, cells or their rows and columns, as cells that satisfy rule R2.

    There must be ``count`` of them, by default any number from 1 to 256; ``name`` is for messages.

    Raises a ValueError if the number is wrong, or a cell is off the grid, a wall, the depot,
    unreachable or named twice.
    """
    low, high = (1, MAX_LANDMARKS) if count is None else (count, count)
    cells: list[int] = []
    for index, value in enumerate(_check_list(landmarks, low, high, name)):
        label = f"{name}[{index}]"
        cell = _check_cell(grid, value, label)
        if cell == grid.depot:
            raise ValueError(f"{label} must not be the depot, got {describe(value)}")
        if cell in cells:
            raise ValueError(f"{label} must differ from the others, got {describe(value)} twice")
        cells.append(cell)
    return tuple(cells)


def check_starts(
    grid: Grid, starts: object, n_agents: int, landmarks: Sequence[int], name: str = "starts"
) -> tuple[int, ...]:
    """Return ``starts``, cells or their rows and columns, as cells where agents may begin.

    Raises a ValueError if there is not one for each agent, or one is off the grid, a wall,
    unreachable from the depot or a landmark.
    """
    cells: list[int] = []
    for index, value in enumerate(_check_list(starts, n_agents, n_agents, name)):
        label = f"{name}[{index}]"
        cell = _check_cell(grid, value, label)
        if cell in landmarks:
            raise ValueError(f"{label} must not be a landmark, got {describe(value)}")
        cells.append(cell)
    return tuple(cells)


def _check_list(value: object, low: int, high: int, name: str) -> Sequence[object]:
    """Return ``value`` if it is a sequence of so many items."""
    given = value
    if isinstance(value, np.ndarray):
        value = list(value) if value.ndim > 0 else None
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise ValueError(
            f"{name} must be a sequence of cells or of (row, col) pairs, got {describe(given)}"
        )
    if not low <= len(value) <= high:
        allowed = str(low) if low == high else f"{low}..{high}"
        raise ValueError(f"{name} must hold {allowed} cells, got {describe(given)}")
    return value


def _check_cell(grid: Grid, value: object, name: str) -> int:
    """Return the cell meant by ``value`` if an agent can stand there."""
    cell = grid.cell(name, value)
    if grid.walls.flat[cell]:
        raise ValueError(f"{name} must be a free cell, got {describe(value)}, a wall")
    if grid.home[cell] < 0:
        raise ValueError(f"{name} must be reachable from the depot, got {describe(value)}")
    return cell


def sample_problems(
    grid: Grid,
    n_problems: int,
    n_landmarks: int = 5,
    seed: int = 0,
    exclude: Iterable[Sequence[int]] = (),
) -> NDArray[np.int32]:
    """Draw distinct problems of a grid, each equally likely.

    Parameters
    ----------
    grid : Grid
        The grid.
    n_problems, n_landmarks : int
        How many problems, and landmarks in each.
    seed : int
        Seed of the draw.
    exclude : iterable of sequence of int
        Landmark sets to leave out, in any order: the problems something was trained on, say.

    Returns
    -------
    ndarray of int32, shape (n_problems, n_landmarks)
        Landmark cells, ascending in each row; no two rows are equal.

    Raises
    ------
    ValueError
        If there are not that many problems.
    """
    check_grid("grid", grid)
    check_count("n_landmarks", n_landmarks, 1, MAX_LANDMARKS)
    check_count("n_problems", n_problems, 1, 10_000_000)
    check_count("seed", seed, 0, 2**63 - 1)
    if not isinstance(exclude, Iterable):
        raise ValueError(f"exclude must be a sequence of landmark sets, got {describe(exclude)}")
    taken = {
        tuple(sorted(check_landmarks(grid, landmarks, n_landmarks, f"exclude[{index}]")))
        for index, landmarks in enumerate(exclude)
    }
    if n_landmarks > grid.reachable.size:
        raise ValueError(
            f"n_landmarks must be at most {grid.reachable.size}, the cells of this grid that may "
            f"hold one; got {n_landmarks}"
        )
    total = math.comb(grid.reachable.size, n_landmarks)
    if n_problems > total - len(taken):
        raise ValueError(
            f"n_problems must be at most {total - len(taken)}, the number of problems with "
            f"{n_landmarks} landmarks on this grid that are not excluded; got {n_problems}"
        )
    rng = np.random.default_rng(seed)
    if total <= MAX_LISTED and total <= 4 * (n_problems + len(taken)):
        # So few problems that drawing until enough distinct ones turn up could take long.
        every = combinations(grid.reachable.tolist(), n_landmarks)
        left = np.array([landmarks for landmarks in every if landmarks not in taken], np.int32)
        return left[rng.permutation(len(left))[:n_problems]]
    problems = np.empty((n_problems, n_landmarks), dtype=np.int32)
    drawn = np.empty(n_landmarks, dtype=np.int32)
    for row in problems:
        while True:
            draw_landmarks(rng.integers(2**64, dtype=np.uint64), grid.reachable, drawn)
            landmarks = tuple(drawn.tolist())
            if landmarks not in taken:
                break
        taken.add(landmarks)
        row[:] = drawn
    return problems
