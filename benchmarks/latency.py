"""Measure the latency of trained networks and of the solvers on one core.

Random problems of `paper-7x7`, three agents, five landmarks, cover time. "one problem" is the
median time from a problem to its plan, one problem after another; a network's "one step" is the
time to the next joint action alone. "in batches" is the time per problem when many are solved
together: for a network including the playing of its episodes, for the exact solver costs only.
Searches are timed until they find the optimum, although they cannot know that they have. Everything
is loaded and compiled beforehand; times vary with the machine.

    python benchmarks/latency.py                          # half a minute
    python benchmarks/latency.py --policies pretrained runs/mine
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import importlib.util
import time
from collections.abc import Callable
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch

from baselines.policies import load_policy, play
from baselines.policies.acting import Acting
from baselines.policies.evaluation import Optima, evaluate, find_optima
from baselines.policies.policy import pretrained_names
from baselines.policies.rules_of_thumb import rules_of_thumb
from baselines.policies.settings import Setting
from mapp_env import Problem, make_grid, sample_problems, solve
from mapp_env.solvers import optimal_costs
from mapp_env.solvers.pyvrp import solve_pyvrp
from mapp_env.solvers.search import solve_search

SETTING = Setting(make_grid())


class Row(NamedTuple):
    """A row of the table."""

    label: str
    one: float  # milliseconds
    each: float | None  # microseconds
    optimal: float | None  # percent of the problems


def time_one(function: Callable[[Any], object], given: object) -> float:
    """Return the seconds that a function takes."""
    start = time.perf_counter()
    function(given)
    return time.perf_counter() - start


def time_each(function: Callable[[Problem], object], problems: list[Problem]) -> float:
    """Return a function's median time in milliseconds."""
    return 1e3 * median(time_one(function, problem) for problem in problems)


def time_batch(function: Callable[[np.ndarray], object], landmarks: np.ndarray) -> float:
    """Return microseconds per problem, the best of three."""
    return 1e6 * min(time_one(function, landmarks) for _ in range(3)) / len(landmarks)


def time_search(solver: Callable[..., object], problem: Problem, optimum: int) -> float:
    """Return the milliseconds until a search finds the optimum; infinite if not within 0.2 s."""
    found = [float("inf")]
    start = time.perf_counter()

    def note(cost: int) -> None:
        if cost == optimum:
            found[0] = min(found[0], 1e3 * (time.perf_counter() - start))

    solver(problem, "cover_time", time_limit=0.2, seed=0, on_better=note)
    return found[0]


def policy_rows(
    label: str, policy: Acting, problems: list[Problem], many: np.ndarray, optima: Optima | None
) -> list[Row]:
    """Return the rows of a policy: one step, and whole episodes."""
    n, k = SETTING.n_agents, SETTING.n_landmarks
    starts = {
        problem: np.array([[*[problem.grid.depot] * n, *problem.landmarks, *[0] * k]], np.float32)
        for problem in problems
    }
    shortest = evaluate(policy, SETTING, many, optima).summary()["optimal %"]
    step = time_each(lambda problem: policy.act(starts[problem]), problems)
    whole = time_each(lambda problem: play(policy, [problem]), problems)
    each = time_batch(lambda landmarks: evaluate(policy, SETTING, landmarks), many)
    return [Row(f"{label}, one step", step, None, None), Row(label, whole, each, shortest)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--policies", nargs="*", default=pretrained_names(), help="networks")
    parser.add_argument("--problems", type=int, default=100, help="problems solved singly")
    parser.add_argument("--batch", type=int, default=20_000, help="problems solved together")
    args = parser.parse_args()
    torch.set_num_threads(1)
    grid, n_agents = SETTING.grid, SETTING.n_agents
    many = sample_problems(grid, args.batch, SETTING.n_landmarks, seed=1)
    problems = [SETTING.problem(tuple(row)) for row in many[: args.problems].tolist()]
    policies = {}
    for name in args.policies:
        try:
            policies[name] = load_policy(name)
            play(policies[name], problems[:1])  # refused if it is for another setting
        except ValueError as error:
            parser.error(f"--policies: {name}: {error}")
    optima = find_optima(SETTING, many)
    rows: list[Row] = []
    for name in args.policies:
        rows += policy_rows(name, policies[name], problems, many, optima)
    for label, rule in rules_of_thumb(SETTING).items():
        rows += policy_rows(label, rule, problems, many, optima)[1:]
    solve(problems[0])
    whole = time_each(solve, problems)
    each = time_batch(lambda landmarks: optimal_costs(grid, landmarks, n_agents), many)
    rows.append(Row("exact solver", whole, each, 100.0))
    costs = optimal_costs(grid, many, n_agents).tolist()
    for label, solver in (("search", solve_search), ("PyVRP", solve_pyvrp)):
        if label == "PyVRP" and importlib.util.find_spec("pyvrp") is None:
            continue
        time_search(solver, problems[0], costs[0])
        times = [time_search(solver, *case) for case in zip(problems, costs, strict=False)]
        rows.append(Row(label, median(times), None, 100.0 * float(np.isfinite(times).mean())))

    print("|                                | one problem, ms | in batches, us each | optimal % |")
    print("|--------------------------------|----------------:|--------------------:|----------:|")
    for row in rows:
        batched, shortest = ("-" if x is None else f"{x:.2f}" for x in (row.each, row.optimal))
        print(f"| {row.label:<30} | {row.one:15.3f} | {batched:>19} | {shortest:>9} |")


if __name__ == "__main__":
    main()
