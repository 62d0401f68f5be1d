"""The page for contributors is right: its diffs apply to this tree, and what they add works."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
PAGE = REPOSITORY / "docs" / "contributing.md"
KINDS = ("reward", "observation", "solver", "network", "learner")

# What is run in a copy that has the change, as plain Python: nothing is compiled.
CHECKS = {
    "reward": """
        import numpy as np
        from mapp_env import make_grid, make_vec, mapp_v0
        from mapp_env.engine.loops import visit_rows
        from baselines.learning.config import parse_options
        from baselines.meta_dqn import Args
        from baselines.replay.relabelled import relabelled_reward
        from model import Model, PAPER_ROWS, REWARDS
        landmarks, actions = (17, 25, 31), ((1, 1, 3), (2, 0, 3))
        model = Model(PAPER_ROWS, landmarks, 3, "count")
        env = mapp_v0.parallel_env(reward="count", n_landmarks=3)
        envs = make_vec(1, reward="count", n_landmarks=3)
        env.reset(options={"landmarks": landmarks}), envs.reset(options={"landmarks": landmarks})
        for joint in actions:
            model.step(joint)
            single = env.step(dict(zip(env.agents, joint)))[1]["agent_0"]
            assert single == envs.step(np.array([joint]))[1][0] == model.reward()
        assert "count" in REWARDS and parse_options(Args, "", ["--reward", "count"])
        world = relabelled_reward(make_grid(), 3, 3, "count").world
        cells, unvisited = np.array([[17, 0, 0]]), np.zeros((1, 3), bool)
        assert visit_rows(world, cells, np.array([landmarks]), unvisited)[1] == [-2.0]
    """,
    "observation": """
        from mapp_env import make_vec, mapp_v0
        from model import Model, PAPER_ROWS
        model = Model(PAPER_ROWS, (17, 42), 3, "step")
        env = mapp_v0.parallel_env(observation="flags", n_landmarks=2)
        env.reset(options={"landmarks": (17, 42)})
        model.step((2, 1, 3))
        seen = env.step(dict(zip(env.agents, (2, 1, 3))))[0]
        for index, agent in enumerate(seen):
            assert env.observation_space(agent).contains(seen[agent])
            assert seen[agent].tolist() == model.observation("flags", index)
        assert make_vec(2, observation="flags").reset(seed=0)[0].shape == (2, 3, 6)
    """,
    "solver": """
        from mapp_env import Problem, make_grid, solve
        problem = Problem(make_grid(), (0, 6, 42), 2)
        for objective in ("cover_time", "makespan", "total_distance"):
            plan = solve(problem, objective, method="dealing")
            plan.verify(problem)
            assert plan.solver == "dealing" and plan.cost >= solve(problem, objective).cost
    """,
    "network": """
        import torch
        from baselines.learning.config import parse_options
        from baselines.meta_dqn import Args
        from baselines.networks import build_network, spec_from_options
        from mapp_env import make_grid
        args = parse_options(Args, "", ["--network", "flat", "--hidden-units", "8"])
        network = build_network(spec_from_options(args, args.network, make_grid()))
        assert network(torch.zeros(2, 13)).shape == (2, 64)
    """,
    "learner": """
        from baselines import compare, double_dqn
        from baselines.learning.config import parse_options
        args = compare.Args(learners=("double",), presets=("default",))
        assert parse_options(double_dqn.Args, "", ["--seed", "3"]).double
        assert compare.LEARNERS["double"][0] is double_dqn
    """,
}


def diff_of(kind: str) -> str:
    """Return the diff that the page shows for a new one of a kind."""
    section = PAGE.read_text(encoding="utf-8").split(f"## Add a{'n' * (kind[0] == 'o')} {kind}\n")[
        1
    ]
    return re.findall(r"```diff\n(.*?)```", section, re.DOTALL)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_a_change_of_the_page_works(kind: str, tmp_path: Path) -> None:
    """Applied to a copy, the page's diff gives what it says, everywhere that takes its like."""
    skip = shutil.ignore_patterns("__pycache__", "*.safetensors", "images", "playground", "_build")
    for folder in ("mapp_env", "baselines", "docs"):
        shutil.copytree(REPOSITORY / folder, tmp_path / folder, ignore=skip)
    (tmp_path / "tests").mkdir()
    shutil.copy(REPOSITORY / "tests" / "model.py", tmp_path / "tests")
    environ = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    applied = subprocess.run(
        ["git", "apply", "-p1", "--verbose", "-"],
        cwd=tmp_path,
        input=diff_of(kind),
        env={**environ, "GIT_CEILING_DIRECTORIES": str(tmp_path.parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert applied.returncode == 0, applied.stderr
    code = "\n".join(line[8:] for line in CHECKS[kind].splitlines())
    paths = os.pathsep.join((str(tmp_path), str(tmp_path / "tests")))
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env={**environ, "PYTHONPATH": paths, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_a_change_is_a_branch_and_a_line() -> None:
    """No diff of the page changes more than one file of the package and one line of a table."""
    for kind in KINDS:
        changed = re.findall(r"^\+\+\+ b/(\S+)", diff_of(kind), re.MULTILINE)
        code = [path for path in changed if path.startswith(("mapp_env", "baselines"))]
        new = re.findall(r"^--- /dev/null\n\+\+\+ b/(\S+)", diff_of(kind), re.MULTILINE)
        assert len(code) <= 1 + len(new), kind
