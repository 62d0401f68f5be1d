"""The rules R1-R12 once more, as plain Python, written from the design and from nothing else.

This file is the second opinion the package is compared with, so it shares no code with it: a
grid is a tuple of text rows, distances are a breadth-first search over those rows, and one step
is a page of loops. Slow and obvious on purpose.
"""

from __future__ import annotations

import itertools
import math
import random
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

PAPER_ROWS = (
    ".......",
    ".##..#.",
    ".....#.",
    "..#D...",
    ".....#.",
    ".#.....",
    "...#...",
)

# (row, col) of left, right, up, down, wait, in the order of R3.
MOVES = ((0, -1), (0, 1), (-1, 0), (1, 0), (0, 0))

REWARDS = ("manhattan", "geodesic", "step")
OBSERVATIONS = ("global", "own_first", "planes", "geodesic", "distances")


def depot_of(rows: Sequence[str]) -> int:
    """Return the cell marked ``D``."""
    for row, line in enumerate(rows):
        for col, letter in enumerate(line):
            if letter == "D":
                return row * len(line) + col
    raise AssertionError("this grid has no depot")


def moved(rows: Sequence[str], cell: int, action: int) -> int:
    """Return the cell an agent on ``cell`` is on after ``action``; a bump leaves it there."""
    cols = len(rows[0])
    row = cell // cols + MOVES[action][0]
    col = cell % cols + MOVES[action][1]
    if not (0 <= row < len(rows) and 0 <= col < cols):
        return cell
    if rows[row][col] == "#":
        return cell
    return row * cols + col


def shortest(rows: Sequence[str], source: int) -> dict[int, int]:
    """Return the steps of a shortest path from ``source`` to every cell that it reaches."""
    steps = {source: 0}
    queue = deque([source])
    while queue:
        cell = queue.popleft()
        for action in range(4):
            neighbour = moved(rows, cell, action)
            if neighbour not in steps:
                steps[neighbour] = steps[cell] + 1
                queue.append(neighbour)
    return steps


def landmark_cells(rows: Sequence[str]) -> list[int]:
    """Return the cells where a landmark may stand: free, reachable, not the depot (R2)."""
    depot = depot_of(rows)
    return sorted(cell for cell in shortest(rows, depot) if cell != depot)


@dataclass
class Model:
    """One episode of one problem under R2-R12; drawing the problem is in tests/model_pools.py.

    Parameters
    ----------
    rows
        The grid: ``#`` wall, ``.`` free, ``D`` depot.
    landmarks
        Cells, in the order in which observations name them.
    starts
        Where the agents stand at first; all on the depot if it is None.
    actions
        What an action is: ``moves`` (R3) or ``landmarks`` (R11).
    sides
        Rows and columns to which the planes are padded with walls, if not the grid's own.
    """

    rows: tuple[str, ...]
    landmarks: tuple[int, ...]
    n_agents: int
    reward_kind: str = "manhattan"
    allow_wait: bool = False
    max_cycles: int = 50
    starts: tuple[int, ...] | None = None
    actions: str = "moves"
    return_home: bool = False
    sides: tuple[int, int] | None = None

    cells: list[int] = field(init=False)
    visited: list[bool] = field(init=False)
    history: list[list[int]] = field(init=False)
    claimed: list[list[int]] = field(init=False)
    claim_step: list[int] = field(init=False)
    steps: int = field(init=False, default=0)
    covered_at: int | None = field(init=False, default=None)
    terminated: bool = field(init=False, default=False)
    truncated: bool = field(init=False, default=False)

    def __post_init__(self) -> None:
        depot = depot_of(self.rows)
        self.home = shortest(self.rows, depot)
        self.from_landmark = [shortest(self.rows, landmark) for landmark in self.landmarks]
        self.cells = [depot] * self.n_agents if self.starts is None else list(self.starts)
        self.visited = [False] * len(self.landmarks)
        self.history = [[cell] for cell in self.cells]
        self.claimed = [[] for _ in range(self.n_agents)]
        self.claim_step = [0] * self.n_agents

    @property
    def n_actions(self) -> int:
        """Four moves, or five when waiting is allowed; or the landmarks and one more."""
        if self.actions == "landmarks":
            return len(self.landmarks) + 1
        return 5 if self.allow_wait else 4

    @property
    def ended(self) -> bool:
        """Whether the episode is over."""
        return self.terminated or self.truncated

    @property
    def solved(self) -> bool:
        """Whether nothing is left to do: all visited and, with ``return_home``, all at home."""
        at_home = all(self.home[cell] == 0 for cell in self.cells)
        return all(self.visited) and (at_home or not self.return_home)

    def move_of(self, cell: int, action: int) -> int:
        """Return the move, 4 to stay, that an agent on ``cell`` makes by an action."""
        if self.actions == "moves":
            return action
        if action == len(self.landmarks) and not self.return_home:
            return 4
        steps = self.home if action == len(self.landmarks) else self.from_landmark[action]
        for move in range(4):
            if steps[moved(self.rows, cell, move)] < steps[cell]:
                return move
        return 4

    def step(self, actions: Sequence[int]) -> tuple[float, bool, bool]:
        """Carry out one joint action; return (reward, terminated, truncated)."""
        assert not self.ended
        assert len(actions) == self.n_agents
        self.steps += 1
        self.cells = [
            moved(self.rows, cell, self.move_of(cell, action))
            for cell, action in zip(self.cells, actions, strict=True)
        ]
        for agent in range(self.n_agents):  # ascending: on one step the lowest index claims
            self.history[agent].append(self.cells[agent])
            for index, landmark in enumerate(self.landmarks):
                if landmark == self.cells[agent] and not self.visited[index]:
                    self.visited[index] = True
                    self.claimed[agent].append(landmark)
                    self.claim_step[agent] = self.steps
        if all(self.visited) and self.covered_at is None:
            self.covered_at = self.steps
        if self.solved:
            self.terminated = True
        elif self.steps >= self.max_cycles:
            self.truncated = True
        return self.reward(), self.terminated, self.truncated

    def reward(self) -> float:
        """Return the team reward of the present situation (R6, R12)."""
        if self.solved:
            return 0.0
        if all(self.visited):
            return self.reward_of_the_way_home()
        if self.reward_kind == "step":
            return -1.0
        total = 0
        for index, landmark in enumerate(self.landmarks):
            if not self.visited[index]:
                total += min(self.distance(cell, index, landmark) for cell in self.cells)
        return -float(total)

    def reward_of_the_way_home(self) -> float:
        """Return what R12 gives once nothing but the way home is left."""
        if self.reward_kind == "step":
            return -1.0
        if self.reward_kind == "geodesic":
            return -float(sum(self.home[cell] for cell in self.cells))
        cols, depot = len(self.rows[0]), depot_of(self.rows)
        return -float(
            sum(
                abs(cell // cols - depot // cols) + abs(cell % cols - depot % cols)
                for cell in self.cells
            )
        )

    def distance(self, cell: int, index: int, landmark: int) -> int:
        """Return how far ``cell`` is from a landmark in the measure of the reward."""
        if self.reward_kind == "geodesic":
            return self.from_landmark[index][cell]
        cols = len(self.rows[0])
        return abs(cell // cols - landmark // cols) + abs(cell % cols - landmark % cols)

    def global_observation(self) -> list[float]:
        """Return R9: agents' cells, landmarks' cells, visited flags."""
        return [float(n) for n in [*self.cells, *self.landmarks, *map(int, self.visited)]]

    def own_first(self, agent: int) -> list[float]:
        """Return R9 with the agent's own cell first, then the others'."""
        others = [cell for other, cell in enumerate(self.cells) if other != agent]
        numbers = [self.cells[agent], *others, *self.landmarks, *map(int, self.visited)]
        return [float(n) for n in numbers]

    def planes(self, agent: int) -> list[list[list[float]]]:
        """Return the planes wall, depot, self, share of the others, unvisited, visited."""
        n_rows, cols, depot = len(self.rows), len(self.rows[0]), depot_of(self.rows)
        height, width = self.sides or (n_rows, cols)
        others = [cell for other, cell in enumerate(self.cells) if other != agent]
        seen = dict(zip(self.landmarks, self.visited, strict=True))

        def values(row: int, col: int) -> list[float]:
            if row >= n_rows or col >= cols:
                return [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
            cell = row * cols + col
            return [
                float(self.rows[row][col] == "#"),
                float(cell == depot),
                float(cell == self.cells[agent]),
                others.count(cell) / max(1, len(others)),
                float(seen.get(cell) is False),
                float(seen.get(cell) is True),
            ]

        return [
            [[values(row, col)[plane] for col in range(width)] for row in range(height)]
            for plane in range(6)
        ]

    def geodesic_features(self, agent: int) -> list[float]:
        """Return, per landmark: unvisited, own way, nearest other's way, rank, four changes."""
        cell, features = self.cells[agent], []
        scale = len(self.rows) + len(self.rows[0])
        for index, steps in enumerate(self.from_landmark):
            own = steps[cell]
            others = [
                (steps[place], other) for other, place in enumerate(self.cells) if other != agent
            ]
            n_cells = len(self.rows) * len(self.rows[0])
            features += [
                float(not self.visited[index]),
                own / scale,
                min(others)[0] / scale if others else n_cells / scale,
                sum(pair < (own, agent) for pair in others) / max(1, len(others)),
            ]
            features += [float(steps[moved(self.rows, cell, a)] - own) for a in range(4)]
        return features

    def distance_features(self, agent: int) -> list[float]:
        """Return own ways, the others' ways, landmark to landmark, to the depot, unvisited."""
        scale = len(self.rows) + len(self.rows[0])
        team = [agent, *(other for other in range(self.n_agents) if other != agent)]
        ways = [steps[self.cells[one]] for one in team for steps in self.from_landmark]
        ways += [steps[landmark] for steps in self.from_landmark for landmark in self.landmarks]
        ways += [self.home[landmark] for landmark in self.landmarks]
        return [*(way / scale for way in ways), *(float(not seen) for seen in self.visited)]

    def observation(self, kind: str, agent: int) -> list[float] | list[list[list[float]]]:
        """Return what an agent sees in any of the kinds."""
        if kind == "global":
            return self.global_observation()
        if kind == "own_first":
            return self.own_first(agent)
        if kind == "distances":
            return self.distance_features(agent)
        if kind == "planes":
            return self.planes(agent)
        return self.geodesic_features(agent)

    def action_mask(self, agent: int) -> list[int]:
        """Return 1 for each action that does not bump, or is no walk to a visited landmark."""
        if self.actions == "landmarks":
            return [*(int(not seen) for seen in self.visited), 1]
        cell = self.cells[agent]
        return [
            int(action == 4 or moved(self.rows, cell, action) != cell)
            for action in range(self.n_actions)
        ]

    def metrics(self) -> dict[str, float | bool]:
        """Return R8 scored: routes cut at the last claim and closed by a shortest path.

        With ``return_home`` (R12) everything is as it was really walked.
        """
        if self.covered_at is None or not self.terminated:
            inf = math.inf
            return {
                "success": False,
                "cover_time": inf,
                "makespan": inf,
                "total_distance": inf,
            }
        if self.return_home:
            walked = [a != b for route in self.history for a, b in itertools.pairwise(route)]
            return {
                "success": True,
                "cover_time": float(self.covered_at),
                "makespan": float(self.steps),
                "total_distance": float(sum(walked)),
            }
        arrivals, distances = [0], [0]
        for agent in range(self.n_agents):
            if not self.claimed[agent]:
                continue
            cut = self.claim_step[agent]
            route = self.history[agent][: cut + 1]
            way_home = self.home[route[-1]]
            arrivals.append(cut + way_home)
            distances.append(sum(a != b for a, b in itertools.pairwise(route)))
            distances.append(way_home)
        return {
            "success": True,
            "cover_time": float(self.covered_at),
            "makespan": float(max(arrivals)),
            "total_distance": float(sum(distances)),
        }


def joint_number(actions: Sequence[int], n_actions: int) -> int:
    """Return the Central environment's number of a joint action: first agent most significant."""
    number = 0
    for action in actions:
        number = number * n_actions + int(action)
    return number


def lively_action(model: Model, rng: random.Random) -> list[int]:
    """Return a joint action that is half random, half a step towards an unvisited landmark.

    Where all are visited, and the agents have to go home, it is half a step home. Purely random
    walks rarely finish an episode, purely greedy ones rarely bump or run out.
    """
    actions = []
    for agent, cell in enumerate(model.cells):
        action = rng.randrange(model.n_actions)
        wanted = [i for i, seen in enumerate(model.visited) if not seen]
        if (wanted or model.return_home) and rng.random() < 0.6:
            index = wanted[(agent + model.steps // 9) % len(wanted)] if wanted else None
            if model.actions == "landmarks":
                actions.append(len(model.landmarks) if index is None else index)
                continue
            steps = model.home if index is None else model.from_landmark[index]
            closer = [a for a in range(4) if steps[moved(model.rows, cell, a)] < steps[cell]]
            if closer:
                action = rng.choice(closer)
        actions.append(action)
    return actions


@dataclass(frozen=True)
class Case:
    """One problem with its settings, and the joint actions of one episode."""

    rows: tuple[str, ...]
    landmarks: tuple[int, ...]
    n_agents: int
    reward: str
    allow_wait: bool
    max_cycles: int
    actions: tuple[tuple[int, ...], ...]

    def model(self) -> Model:
        """Return a fresh episode of this problem in the model."""
        return Model(
            self.rows,
            self.landmarks,
            self.n_agents,
            self.reward,
            self.allow_wait,
            self.max_cycles,
        )

    @property
    def text(self) -> str:
        """The grid as text."""
        return "\n".join(self.rows) + "\n"

    def settings(self) -> dict[str, object]:
        """Return the package's arguments for this case, all but the grid."""
        return {
            "n_agents": self.n_agents,
            "n_landmarks": len(self.landmarks),
            "max_cycles": self.max_cycles,
            "reward": self.reward,
            "allow_wait": self.allow_wait,
        }


def random_rows(rng: random.Random, n_rows: int, n_cols: int, least: int) -> tuple[str, ...]:
    """Return a random grid with at least ``least`` cells for landmarks."""
    for attempt in range(1000):
        walls = rng.choice((0.0, 0.15, 0.3, 0.45)) if attempt < 20 else 0.1 if attempt < 60 else 0
        letters = ["#" if rng.random() < walls else "." for _ in range(n_rows * n_cols)]
        letters[rng.randrange(len(letters))] = "D"
        rows = tuple("".join(letters[r * n_cols : (r + 1) * n_cols]) for r in range(n_rows))
        if len(landmark_cells(rows)) >= least:
            return rows
    raise AssertionError(f"no {n_rows}x{n_cols} grid has {least} cells for landmarks")


SHAPES = (
    (7, 7), (1, 9), (12, 1), (2, 5), (5, 3), (4, 11), (12, 12), (3, 3), (9, 6), (1, 2), (6, 8),
)  # fmt: skip


def random_case(seed: int) -> Case:
    """Return case number ``seed``: shapes, rewards and counts all take turns."""
    rng = random.Random(seed * 7919 + 1)
    n_rows, n_cols = SHAPES[seed % len(SHAPES)]
    n_agents = rng.randint(1, 5)
    n_landmarks = rng.randint(1, min(8, n_rows * n_cols - 1))
    max_cycles = rng.choice((1, 8, 20, 50, 50, 80))
    if seed % 12 == 7:
        n_agents = 16
    if seed % 12 == 10:
        n_rows, n_cols, n_landmarks, max_cycles = 17, 14, 64, 120
        n_agents = 16
    rows = random_rows(rng, n_rows, n_cols, n_landmarks)
    landmarks = tuple(rng.sample(landmark_cells(rows), n_landmarks))
    model = Model(
        rows,
        landmarks,
        n_agents,
        REWARDS[seed % len(REWARDS)],
        bool(seed // 3 % 2),
        max_cycles=max_cycles,
    )
    actions = []
    while not model.ended:
        actions.append(tuple(lively_action(model, rng)))
        model.step(actions[-1])
    return Case(
        rows, landmarks, n_agents, model.reward_kind, model.allow_wait, max_cycles, tuple(actions)
    )


def symmetries() -> Iterator[tuple[int, int, int, int]]:
    """Yield the eight symmetries of the square as matrices (a, b, c, d) on (row, col)."""
    for sign_row in (1, -1):
        for sign_col in (1, -1):
            yield sign_row, 0, 0, sign_col
            yield 0, sign_row, sign_col, 0


@dataclass(frozen=True)
class Transform:
    """One symmetry of the square, applied to a grid, to its cells and to the actions."""

    rows: tuple[str, ...]
    cell: tuple[int, ...]  # (C,) new cell of each old cell
    action: tuple[int, ...]  # (5,) new action of each old action


def transform(rows: Sequence[str], matrix: tuple[int, int, int, int]) -> Transform:
    """Return ``rows`` under the symmetry ``matrix``, and what becomes of cells and actions."""
    a, b, c, d = matrix
    n_rows, n_cols = len(rows), len(rows[0])
    raw = [(a * row + b * col, c * row + d * col) for row in range(n_rows) for col in range(n_cols)]
    top, left = min(row for row, _ in raw), min(col for _, col in raw)
    places = [(row - top, col - left) for row, col in raw]
    new_rows = max(row for row, _ in places) + 1
    new_cols = max(col for _, col in places) + 1
    letters = [[""] * new_cols for _ in range(new_rows)]
    for old, (row, col) in enumerate(places):
        letters[row][col] = rows[old // n_cols][old % n_cols]
    return Transform(
        rows=tuple("".join(line) for line in letters),
        cell=tuple(row * new_cols + col for row, col in places),
        action=tuple(MOVES.index((a * dr + b * dc, c * dr + d * dc)) for dr, dc in MOVES),
    )
