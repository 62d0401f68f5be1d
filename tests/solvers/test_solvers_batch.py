"""The optimum of many problems at once is the optimum of each."""

from __future__ import annotations

import numpy as np
import pytest

import mapp_env
from mapp_env import Grid, Problem, solve
from mapp_env.solvers import batch, optimal_costs, solution, solve_universe
from mapp_env.solvers.exact import solve_exact
from mapp_env.solvers.oracle import states as oracle_states

OBJECTIVES = ("cover_time", "makespan", "total_distance")
PAPER = mapp_env.make_grid()


def draw(grid: Grid, n_problems: int, n_landmarks: int, seed: int) -> np.ndarray:
    """Return landmark sets in random order, (P, K)."""
    rng = np.random.default_rng(seed)
    sets = [rng.choice(grid.reachable, n_landmarks, replace=False) for _ in range(n_problems)]
    return np.array(sets)


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize(("n_landmarks", "n_agents"), [(1, 1), (2, 16), (5, 3), (8, 2), (12, 4)])
def test_costs_are_those_of_solve(objective: str, n_landmarks: int, n_agents: int) -> None:
    """On a walled and on a large grid, whatever the order of the landmarks."""
    for grid in (PAPER, mapp_env.make_grid("rooms", rows=70, cols=70, seed=1)):
        landmarks = draw(grid, 15, n_landmarks, seed=n_landmarks)
        costs = optimal_costs(grid, landmarks, n_agents, objective)
        assert costs.dtype == np.int32
        expected = [
            solve(Problem(grid, row, n_agents), objective, "exact").cost
            for row in landmarks.tolist()
        ]
        assert costs.tolist() == expected


def test_universe_in_one_batch_is_the_universe() -> None:
    """All sets of three landmarks, shuffled within and among themselves."""
    landmarks, optimum = solve_universe(PAPER, 3, 2)
    rng = np.random.default_rng(0)
    order = rng.permutation(len(landmarks))
    shuffled = rng.permuted(landmarks[order], axis=1)
    assert (optimal_costs(PAPER, shuffled, 2) == optimum[order]).all()


def test_parts_are_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the work between two interrupts nor the cells kept at a time change an answer."""
    landmarks = draw(PAPER, 100, 4, seed=3)
    whole = optimal_costs(PAPER, landmarks)
    monkeypatch.setattr(batch, "CHUNK_WORK", 3 * 3**4)
    monkeypatch.setattr(batch, "MAX_ALL_PAIRS_CELLS", 20)
    sizes = []

    def cell_distances(grid: Grid, cells: np.ndarray) -> np.ndarray:
        sizes.append(len(cells))
        return solution.cell_distances(grid, cells)

    monkeypatch.setattr(batch, "cell_distances", cell_distances)
    assert (optimal_costs(PAPER, landmarks) == whole).all()
    assert len(sizes) == 25
    assert max(sizes) <= 20


def test_no_problems_no_costs() -> None:
    """Zero rows are fine."""
    assert optimal_costs(PAPER, np.empty((0, 5), int)).shape == (0,)


@pytest.mark.parametrize(
    ("landmarks", "message"),
    [
        ([0, 6, 20], r"landmarks must be integers of shape \(P, K\)"),
        ([[0, 6], [0]], r"landmarks must be integers of shape \(P, K\)"),
        ([[0.0, 6.0]], r"landmarks must be integers of shape \(P, K\).* float64 of shape \(1, 2\)"),
        ([[]], r"landmarks must be integers of shape \(P, K\)"),
        ([[True, False]], r"landmarks must be integers of shape \(P, K\)"),
        (np.zeros((2, 13), int), r"K in 1\.\.12, got int64 of shape \(2, 13\)"),
        (None, r"landmarks must be integers of shape \(P, K\).*None"),
        ([[0, 6], [6, 6]], r"landmarks\[1\] must be distinct cells .* got \[6, 6\]"),
        ([[0, 24]], r"landmarks\[0\] must be .* not the depot, got \[0, 24\]"),
        ([[0, 8]], r"landmarks\[0\] must be distinct cells reachable"),
        ([[0, 49]], r"landmarks\[0\] must be distinct cells reachable"),
        ([[0, -1]], r"landmarks\[0\] must be distinct cells reachable"),
        (np.array([[2**64 - 1, 0]], np.uint64), r"landmarks\[0\] must be distinct cells"),
    ],
)
def test_rows_that_are_no_problems_are_refused(landmarks: object, message: str) -> None:
    """A wrong shape, type or cell is refused; the message names the row."""
    with pytest.raises(ValueError, match=message):
        optimal_costs(PAPER, landmarks)


@pytest.mark.parametrize(
    ("options", "name"),
    [({"n_agents": 0}, "n_agents"), ({"objective": "time"}, "objective"), ({"grid": 3}, "grid")],
)
def test_other_arguments_are_named(options: dict[str, object], name: str) -> None:
    """Number of agents, objective and grid are checked as everywhere."""
    with pytest.raises(ValueError, match=f"^{name} must be"):
        optimal_costs(**{"grid": PAPER, "landmarks": [[0, 6]], **options})  # type: ignore[arg-type]


# -- from any starts -----------------------------------------------------


def draw_starts(grid: Grid, landmarks: np.ndarray, n_agents: int, seed: int) -> np.ndarray:
    """Return cells for the agents of each problem, none of them a landmark of it, (P, N)."""
    rng = np.random.default_rng(seed)
    cells = np.append(grid.reachable, grid.depot)
    return np.array([rng.choice(np.setdiff1d(cells, row), n_agents) for row in landmarks])


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize(("n_landmarks", "n_agents"), [(1, 1), (2, 16), (5, 3), (8, 2), (12, 4)])
def test_costs_from_starts_are_those_of_the_exact_solver(
    objective: str, n_landmarks: int, n_agents: int
) -> None:
    """On a walled and on a large grid, and on one whose pairs of cells are all listed."""
    sizes = {PAPER: 40, mapp_env.make_grid("rooms", rows=70, cols=70, seed=1): 10}
    for grid, n_problems in sizes.items():
        landmarks = draw(grid, n_problems, n_landmarks, seed=n_landmarks)
        starts = draw_starts(grid, landmarks, n_agents, seed=n_agents)
        costs = optimal_costs(grid, landmarks, n_agents, objective, starts)
        assert costs.dtype == np.int32
        problems = zip(landmarks.tolist(), starts.tolist(), strict=True)
        expected = [
            solve_exact(Problem(grid, cells, n_agents, starts=own), objective).bound
            for cells, own in problems
        ]
        assert costs.tolist() == expected


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_starts_on_the_depot_are_as_without(objective: str) -> None:
    """Two ways of computing the same: agents that are alike, and agents with costs of their own."""
    landmarks = draw(PAPER, 200, 6, seed=5)
    starts = np.full((200, 3), PAPER.depot)
    costs = optimal_costs(PAPER, landmarks, 3, objective, starts)
    assert (costs == optimal_costs(PAPER, landmarks, 3, objective)).all()


def test_parts_from_starts_are_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the work between two interrupts nor the cells kept at a time change an answer."""
    landmarks = draw(PAPER, 60, 4, seed=3)
    starts = draw_starts(PAPER, landmarks, 3, seed=4)
    whole = optimal_costs(PAPER, landmarks, 3, "makespan", starts)
    monkeypatch.setattr(oracle_states, "CHUNK_WORK", 3**6)
    assert (optimal_costs(PAPER, landmarks, 3, "makespan", starts) == whole).all()
    monkeypatch.setattr(oracle_states, "MAX_ALL_PAIRS_CELLS", 20)
    assert (optimal_costs(PAPER, landmarks, 3, "makespan", starts) == whole).all()


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        ([[1, 2, 3]], r"starts must be integers of shape \(2, 3\), .* got int64 of shape \(1, 3\)"),
        ([[1, 2], [3, 4]], r"starts must be integers of shape \(2, 3\)"),
        ([[1, 2, 3.0], [1, 2, 3]], r"starts must be integers of shape \(2, 3\).*float64"),
        (24, r"starts must be integers of shape \(2, 3\), .*got 24"),
        ([[1, 2, 3], [1, 2, 6]], r"starts\[1\] must be .* none of them a landmark.*\[1, 2, 6\]"),
        ([[1, 2, 8], [1, 2, 3]], r"starts\[0\] must be cells reachable from the depot"),
        ([[1, 2, -1], [1, 2, 3]], r"starts\[0\] must be cells reachable from the depot"),
        ([[1, 2, 49], [1, 2, 3]], r"starts\[0\] must be cells reachable from the depot"),
    ],
)
def test_wrong_starts_are_refused(starts: object, message: str) -> None:
    """A wrong shape, type or cell is refused; the message names the row."""
    with pytest.raises(ValueError, match=message):
        optimal_costs(PAPER, [[0, 5], [0, 6]], 3, starts=starts)
