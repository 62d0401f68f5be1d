"""Compare the solvers: the costs they find, how soon, and how far from the best known.

Landmarks are drawn at random on `paper-7x7` and on generated grids. "best known" is the proven
optimum where the exact solver can handle the problem, otherwise the best of all methods and of a
search with another seed for three times as long; "proven" means that the cost meets a lower bound,
which ends a search early. One thread; times include computing the distances between landmarks, and
vary with the machine. Then, for agents that start apart, how long it takes to look up the cost of
every decision, and to prove an optimum.

    python benchmarks/solvers.py            # five minutes; quick: --seconds 0.2 --instances 1
    python benchmarks/solvers.py --grid rooms --objective makespan
    python benchmarks/solvers.py --many 1000    # solve_many on so many problems
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import importlib.util
import time
from collections.abc import Callable, Sequence
from functools import partial
from statistics import mean, median
from typing import NamedTuple

import numpy as np

from mapp_env import Problem, make_grid
from mapp_env.plans.plan import OBJECTIVES
from mapp_env.solvers import next_costs, next_costs_of, optimal_costs, solve_many
from mapp_env.solvers.earliest_arrival import assign_landmarks
from mapp_env.solvers.exact import MAX_EXACT_LANDMARKS, solve_exact
from mapp_env.solvers.pyvrp import solve_pyvrp
from mapp_env.solvers.search import solve_search
from mapp_env.solvers.solution import Solution, landmark_distances

SIZES = (  # side of the grid, landmarks, agents
    (7, 5, 3),
    (32, 20, 5),
    (64, 50, 10),
    (64, 100, 2),
    (64, 100, 3),
    (64, 100, 5),
)
REFERENCE = 3  # times as long as the others, where the exact solver cannot be used


class Found(NamedTuple):
    """A method's result."""

    cost: int
    seconds: float  # until it was found
    proven: bool = False  # to be the optimum


def draw_problem(kind: str, side: int, n_landmarks: int, n_agents: int, seed: int) -> Problem:
    """Return the problem for a seed."""
    options = {"rows": side, "cols": side, "seed": seed}
    grid = make_grid("paper-7x7") if side == 7 else make_grid(kind, **options)
    rng = np.random.default_rng([side, n_landmarks, seed])
    landmarks = rng.choice(grid.reachable, n_landmarks, replace=False).tolist()
    return Problem(grid, landmarks, n_agents)


def exact(problem: Problem, objective: str, seconds: float) -> Found:
    """Prove the optimum."""
    start = time.perf_counter()
    return Found(solve_exact(problem, objective).bound, time.perf_counter() - start, True)


def search(problem: Problem, objective: str, seconds: float, seed: int = 0) -> Found:
    """Run ruin and recreate for some seconds."""
    return watch(solve_search, problem, objective, seconds, seed)


def pyvrp(problem: Problem, objective: str, seconds: float) -> Found:
    """Run PyVRP for some seconds."""
    return watch(solve_pyvrp, problem, objective, seconds, 0)


def watch(
    solver: Callable[..., Solution], problem: Problem, objective: str, seconds: float, seed: int
) -> Found:
    """Return the lowest cost that a search reports, and when."""
    start = time.perf_counter()
    best: list[Found] = []
    solution = solver(
        problem,
        objective,
        time_limit=seconds,
        seed=seed,
        on_better=lambda cost: best.append(Found(cost, time.perf_counter() - start)),
    )
    return best[-1]._replace(proven=solution.optimal)


def earliest_arrival(problem: Problem, objective: str, seconds: float) -> Found:
    """Assign landmarks one at a time, each to the agent that can reach it first."""
    start = time.perf_counter()
    distances = landmark_distances(problem)
    n_agents = 1 if objective == "total_distance" else problem.n_agents
    nodes = np.arange(1, len(distances))[None]
    _, when = assign_landmarks(distances, np.zeros((1, n_agents), int), nodes, nodes > 0)
    # The maximum is reached at an agent's last landmark: from no earlier one is it home later.
    ends = when[0] if objective == "cover_time" else when[0] + distances[1:, 0]
    return Found(int(ends.max()), time.perf_counter() - start)


METHODS: dict[str, Callable[[Problem, str, float], Found]] = {
    "exact": exact,
    "search": search,
    "pyvrp": pyvrp,
    "earliest arrival": earliest_arrival,
}


def compare(problems: Sequence[Problem], objective: str, seconds: float) -> list[str]:
    """Return one table line per method."""
    small = len(problems[0].landmarks) <= MAX_EXACT_LANDMARKS
    found: dict[str, list[Found]] = {}
    for name, method in METHODS.items():
        if name == "exact" and not small:
            continue
        if name == "pyvrp" and importlib.util.find_spec("pyvrp") is None:
            continue
        found[name] = [method(problem, objective, seconds) for problem in problems]
    best = [min(results).cost for results in zip(*found.values(), strict=True)]
    if small:
        if best != [result.cost for result in found["exact"]]:
            raise RuntimeError("a method found a cost below the optimum")
    else:
        longer = [search(problem, objective, REFERENCE * seconds, seed=1) for problem in problems]
        best = [min(one, other.cost) for one, other in zip(best, longer, strict=True)]
    lines = []
    for name, results in found.items():
        gaps = [result.cost / one - 1 for result, one in zip(results, best, strict=True)]
        lines.append(
            f"{name:<16} | {mean(result.cost for result in results):7.1f} "
            f"| {1000 * median(result.seconds for result in results):10.1f} "
            f"| {100 * mean(gaps):6.2f} | {sum(gap == 0 for gap in gaps):3d}/{len(gaps)} "
            f"| {sum(result.proven for result in results):4d}/{len(gaps)}"
        )
    return lines


# Landmarks, agents and states of a batch, whose costs are looked up; and how long that should take.
DECISIONS = ((5, 3, 10_000, 10.0), (8, 3, 2_000, None), (10, 3, 500, 400.0), (12, 3, 50, None))
APART = ((16, 5), (16, 16), (18, 5), (18, 16), (20, 5), (20, 16))  # landmarks, agents


def draw_starts(kind: str, side: int, n_landmarks: int, n_agents: int, seed: int) -> Problem:
    """Return the problem for a seed, each agent on a cell of its own."""
    problem = draw_problem(kind, side, n_landmarks, n_agents, seed)
    others = np.setdiff1d(problem.grid.reachable, problem.landmarks)
    starts = np.random.default_rng(seed).choice(others, n_agents, replace=False).tolist()
    return Problem(problem.grid, problem.landmarks, n_agents, starts=starts)


def time_decisions(kind: str) -> None:
    """Print what each choice of a next landmark costs to look up, for states of a batch."""
    print("\nlandmarks / agents |  us a state | at most | us from problems | us the optimum alone")
    print("|".join("-" * width for width in (19, 13, 9, 18, 22)))
    for n_landmarks, n_agents, n_states, most in DECISIONS:
        grid = draw_problem(kind, 16, n_landmarks, n_agents, 0).grid
        rng = np.random.default_rng(1)
        drawn = [
            rng.choice(grid.reachable, n_landmarks + n_agents, replace=False).tolist()
            for _ in range(n_states)
        ]
        problems = [
            Problem(grid, cells[:n_landmarks], n_agents, starts=cells[n_landmarks:])
            for cells in drawn
        ]
        ends, stands = np.hsplit(np.array(drawn), [n_landmarks])
        between = grid.distances[ends[:, :, None], ends[:, None]]
        starts = grid.distances[stands[:, :, None], ends[:, None]]
        seconds = [
            time_best(partial(next_costs_of, between, starts)),
            time_best(partial(next_costs, problems)),
            time_best(partial(optimal_costs, grid, ends, n_agents, starts=stands)),
        ]
        each, whole, alone = (1e6 * one / n_states for one in seconds)
        limit = "" if most is None else f"{most:g}"
        print(
            f"{n_landmarks:>9} / {n_agents:<6} | {each:11.2f} | {limit:>7} | {whole:16.2f} "
            f"| {alone:20.2f}",
            flush=True,
        )


def time_best(call: Callable[[], object], times: int = 3) -> float:
    """Return the seconds of the fastest of some calls, of this thread alone."""
    seconds = []
    for _ in range(times + 1):  # the first compiles
        start = time.thread_time()
        call()
        seconds.append(time.thread_time() - start)
    return min(seconds[1:])


def time_apart(kind: str, instances: int) -> None:
    """Print how long the exact solver takes for agents that all start apart."""
    print("\n32x32, agents apart | objective      | exact: ms, median | longest")
    print("|".join("-" * width for width in (20, 16, 19, 9)))
    for n_landmarks, n_agents in APART:
        for objective in OBJECTIVES:
            seconds = []
            for seed in range(instances):
                problem = draw_starts(kind, 32, n_landmarks, n_agents, seed)
                start = time.thread_time()
                solve_exact(problem, objective)
                seconds.append(time.thread_time() - start)
            print(
                f"{n_landmarks:>9} / {n_agents:<7} | {objective:<14} "
                f"| {1000 * median(seconds):17.0f} | {1000 * max(seconds):7.0f}",
                flush=True,
            )


def measure_many(count: int, kind: str) -> None:
    """Print what `solve_many` takes for each of many problems, each on a map of its own."""
    problems = [draw_problem(kind, 32, 20, 5, seed) for seed in range(count)]
    solve_many(problems[:20])  # compile and load kernels
    print(f"{count} problems of 32x32 / 20 / 5 on {kind} grids, cover time\n")
    print("solve_many with        | ms each, in all | mean cost | of these proven")
    print("|".join("-" * width for width in (23, 17, 11, 16)))
    for options in ({"time_limit": 0.001}, {"iterations": 500}, {"time_limit": 0.02}):
        start = time.perf_counter()
        plans = solve_many(problems, **options)
        each = 1000 * (time.perf_counter() - start) / count
        name = ", ".join(f"{option}={value}" for option, value in options.items())
        proven = sum(plan.status == "optimal" for plan in plans)
        cost = mean(plan.cost for plan in plans)
        print(f"{name:<22} | {each:15.2f} | {cost:9.2f} | {proven:4d}/{count}", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=1.0, help="seconds per search")
    parser.add_argument("--instances", type=int, default=3, help="problems per size")
    parser.add_argument("--grid", default="random", help="generator of the larger grids")
    parser.add_argument("--objective", choices=OBJECTIVES, help="only this one")
    parser.add_argument("--many", type=int, metavar="P", help="only solve_many, on P problems")
    args = parser.parse_args()
    if args.many is not None:
        measure_many(args.many, args.grid)
        return
    # Compile and load kernels before timing.
    for objective in OBJECTIVES:
        compare([draw_problem(args.grid, 7, 3, 2, 0)], objective, 0.01)
    print(
        f"{args.seconds:g} s for each search, {args.instances} problems of each size, 7x7 on "
        f"paper-7x7, larger ones on {args.grid} grids\n"
    )
    print(
        "grid / landmarks / agents | objective      | method           |    cost "
        "| ms to best |  gap % | best  | proven"
    )
    print("|".join("-" * width for width in (26, 16, 18, 9, 12, 8, 7, 8)))
    for side, n_landmarks, n_agents in SIZES:
        size = f"{side}x{side} / {n_landmarks} / {n_agents}"
        problems = [
            draw_problem(args.grid, side, n_landmarks, n_agents, seed)
            for seed in range(args.instances)
        ]
        for objective in OBJECTIVES:
            # One agent's tour, whatever the number of agents: once for a number of landmarks.
            repeated = objective == "total_distance" and n_landmarks == 100 and n_agents > 2
            if repeated or args.objective not in (None, objective):
                continue
            for line in compare(problems, objective, args.seconds):
                print(f"{size:<25} | {objective:<14} | {line}", flush=True)
    time_decisions(args.grid)
    time_apart(args.grid, args.instances)


if __name__ == "__main__":
    main()
