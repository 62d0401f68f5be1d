"""Solve one problem with a trained policy and compare it with the proven optimum.

Command::

    python baselines/solve.py --policy pretrained --landmarks 0 6 20 42 48 --picture routes.png

Output: the routes, their costs and the gap to the optimum; with ``--picture`` a figure of the
policy's routes and the optimal ones, with ``--animation`` both played side by side, with ``--plan``
the policy's plan as a JSON file that ``mapp_env.Plan.load`` reads. Exit code 1 if the policy does
not solve the problem.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import torch

from baselines.learning.config import run_script
from baselines.policies import play
from baselines.policies.settings import load_run
from mapp_env import Plan, Problem, solve


@dataclass
class Args:
    """Options of solving one problem."""

    landmarks: tuple[int, ...] = ()
    """the landmarks' cells: row * columns + column"""
    policy: str = "pretrained"
    """a pretrained policy's name, a run folder or a weights file"""
    picture: Path | None = None
    """where to draw the routes beside the optimum: a .png, .svg or .pdf file"""
    plan: Path | None = None
    """where to write the policy's plan: a JSON file"""
    animation: Path | None = None
    """where to play the policy beside the optimum: an animated .gif file"""
    device: str = "cpu"
    """where the network computes, as PyTorch names it"""


def describe(label: str, plan: Plan) -> str:
    """Return a plan's costs in a line."""
    if not plan.success:
        visited = sum(len(claims) for claims in plan.claims)
        return f"{label}: not solved, {visited} landmarks visited"
    return (
        f"{label}: cover time {plan.cover_time}, makespan {plan.makespan}, "
        f"total distance {plan.total_distance}"
    )


def report(problem: Problem, plans: dict[str, Plan], optimum: Plan) -> None:
    """Print plans beside the optimum, and the routes of the last one."""
    for label, plan in plans.items():
        line = describe(label, plan)
        if plan.success and optimum.status == "optimal":
            line += f"; gap {100 * (plan.cover_time / optimum.cost - 1):.1f} %"
        print(line)
    print(describe(proof(optimum), optimum))
    for agent, tour in enumerate(list(plans.values())[-1].tours):
        print(f"agent {agent}: {' '.join(map(str, tour)) or 'stays at the depot'}")


def proof(plan: Plan) -> str:
    """Return what the solver's plan is called."""
    return "optimum" if plan.status == "optimal" else "best known"


def save(args: Args, problem: Problem, plans: dict[str, Plan], optimum: Plan) -> None:
    """Write what was asked for, of the last plan and the optimum."""
    beside = {**plans, proof(optimum): optimum}
    if args.plan is not None:
        list(plans.values())[-1].save(args.plan)
        print(f"plan: {args.plan}")
    if args.picture is not None:
        # Only here: drawing takes longer to import than all the rest to run.
        from mapp_env.rendering import compare_plans

        compare_plans(problem, beside, args.picture)
        print(f"picture: {args.picture}")
    if args.animation is not None:
        from mapp_env.rendering import animate_plans

        size = animate_plans(args.animation, problem, beside)
        print(f"animation: {args.animation}, {size:,} bytes")


def main(args: Args) -> int:
    """Solve one problem; return the exit code."""
    torch.set_num_threads(1)
    policy, setting, _ = load_run(args.policy, args.device)
    problem = setting.problem(args.landmarks)
    start = time.perf_counter()
    (plan,) = play(policy, [problem])
    seconds = time.perf_counter() - start
    optimum = solve(problem)
    report(problem, {"policy": plan}, optimum)
    print(
        f"policy {1000 * seconds:.0f} ms, {optimum.solver} solver {1000 * optimum.seconds:.0f} ms"
    )
    save(args, problem, {"policy": plan}, optimum)
    return 0 if plan.success else 1


if __name__ == "__main__":
    run_script(main, Args, __doc__)
