"""Values that break careless checks: refused as ValueErrors by name, at once, leaving no trace."""

from __future__ import annotations

import copy
import importlib
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mapp_env
from mapp_env import mapp_v0
from mapp_env.engine.loops import step_and_observe

GRID = mapp_env.make_grid("paper-7x7")
PROBLEM = mapp_env.Problem(GRID, (0, 6, 20, 42, 48))


def deep_list(depth: int) -> list[Any]:
    """Return a list in a list in a list."""
    nested: list[Any] = []
    for _ in range(depth):
        nested = [nested]
    return nested


class BadRepr:
    """An object that cannot even be printed."""

    def __repr__(self) -> str:
        raise RuntimeError("no")


REFUSALS: dict[str, tuple[str, Callable[[], Any]]] = {
    "ragged joint actions": (
        "joint_actions",
        lambda: mapp_env.replay(PROBLEM, [[0, 1, 2], [0, 1]]),
    ),
    "deep joint actions": ("joint_actions", lambda: mapp_env.replay(PROBLEM, deep_list(100_000))),
    "empty joint actions of too many agents": (
        "joint_actions",
        lambda: mapp_env.replay(PROBLEM, np.zeros((0, 7), int)),
    ),
    "a number too long to print": (
        "n_agents",
        lambda: mapp_v0.parallel_env(n_agents=10**5000),
    ),
    "an object that cannot be printed": (
        "n_agents",
        lambda: mapp_v0.parallel_env(n_agents=BadRepr()),
    ),
    "a landmark as a float array": (
        r"landmarks\[0\]",
        lambda: mapp_env.Problem(GRID, [np.array(1.5)]),
    ),
    "a depot as a float array": ("depot", lambda: mapp_env.Grid(GRID.walls, depot=np.array(1.5))),
    "a deep landmark": (r"landmarks\[0\]", lambda: mapp_env.Problem(GRID, [deep_list(100_000)])),
    # One number over and over: to make ten million takes a third of the second by itself.
    "ten million landmarks": ("landmarks", lambda: mapp_env.Problem(GRID, [5] * 10**7)),
    "ragged walls": ("walls", lambda: mapp_env.Grid([[True], [True, False]])),
    "walls as a range": ("walls", lambda: mapp_env.Grid(range(10**8))),
    "a seed as a float array": (
        "seed",
        lambda: mapp_env.make_vec(4).reset(seed=np.array(1.5)),
    ),
    "excluded problems as a number": (
        "exclude",
        lambda: mapp_env.sample_problems(GRID, 5, exclude=5),
    ),
    "an excluded problem with a fractional cell": (
        r"exclude\[0\]",
        lambda: mapp_env.sample_problems(GRID, 5, exclude=[[1.5, 2, 3, 4, 5]]),
    ),
    "an excluded problem of another size": (
        r"exclude\[0\]",
        lambda: mapp_env.sample_problems(GRID, 5, exclude=[[1, 2]]),
    ),
    "distances from a number": ("cells", lambda: GRID.distances_from(5)),
    "a vertical tab in a map": ("text:1", lambda: mapp_env.Grid.from_text("..\x0b..")),
    "a header with a long number": (
        "text:3",
        lambda: mapp_env.Grid.from_text(f"type octile\nheight {'9' * 5000}\nmap\n..\n"),
    ),
    "a map of blanks": ("text:", lambda: mapp_env.Grid.from_text("x\n" + " " * 1_000_000 + "#")),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refused_by_name_at_once(case: str) -> None:
    """Each is a short ValueError that names the argument."""
    name, call = REFUSALS[case]
    with pytest.raises(ValueError, match=name) as refusal:
        call()
    assert len(str(refusal.value)) < 1000


BAD_ACTIONS = [99, -1, 1.5, float("nan"), None, "a", True, 10**5000]


@pytest.mark.parametrize("action", BAD_ACTIONS, ids=range(len(BAD_ACTIONS)))
@pytest.mark.parametrize("make", [mapp_v0.env, mapp_v0.raw_env])
def test_aec_refuses_a_bad_action_when_it_is_given(make: Callable[[], Any], action: Any) -> None:
    """The first agent's bad action is refused, and the same agent can then act well."""
    env = make()
    env.reset(seed=0)
    first = env.agent_selection
    with pytest.raises(ValueError, match=first):
        env.step(action)
    assert env.agent_selection == first
    for _ in range(3):
        env.step(1)
    assert env.agent_selection == first
    assert env.rewards[first] < 0


def test_landmark_pairs_are_not_taken_for_rows() -> None:
    """An array that may mean pairs or a cell for each row is refused; others say which they are."""
    envs = mapp_env.make_vec(2, n_landmarks=2)
    with pytest.raises(ValueError, match="landmarks"):
        envs.reset(options={"landmarks": np.array([[0, 6], [6, 0]])})
    observations, _ = envs.reset(options={"landmarks": [(0, 6), (6, 0)]})
    assert observations[:, 3:5].tolist() == [[6, 42], [6, 42]]
    pairs = np.array([[(0, 6), (6, 0)], [(0, 0), (2, 6)]])
    observations, _ = envs.reset(options={"landmarks": pairs})
    assert observations[:, 3:5].tolist() == [[6, 42], [0, 20]]
    for bad in ((-1, 1), (0, 7), (1, 1), (3, 3), (0, 0), (2**62, 2**62)):
        pairs[1, 1] = bad  # off the grid, a wall, the depot, twice
        with pytest.raises(ValueError, match=r"options\['landmarks'\]\[1\]"):
            envs.reset(options={"landmarks": pairs})
    with pytest.raises(ValueError, match="landmarks"):
        envs.reset(options={"landmarks": pairs.astype(float)})


def test_first_reset_needs_every_row() -> None:
    """Rows that never started cannot be left out of the first reset."""
    envs = mapp_env.make_vec(3)
    with pytest.raises(ValueError, match="reset_mask"):
        envs.reset(options={"reset_mask": np.array([True, False, True])})


@pytest.mark.parametrize("copier", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_copies_of_a_grid_are_frozen_too(copier: Callable[[Any], Any]) -> None:
    """No copy of a grid, its tables or an environment on it can be written to by accident."""
    assert GRID.moves.shape == (49, 4)
    grid = copier(GRID)
    assert grid == GRID
    for array in (grid.walls, grid.moves, grid.home, grid.distances, grid.reachable):
        assert not array.flags.writeable


def test_copies_of_an_env_need_no_new_compilation() -> None:
    """A copied environment's tables have the types that the kernels were compiled for."""
    env = mapp_v0.parallel_env(observation="geodesic")
    env.reset(seed=0)
    env.step(dict.fromkeys(env.agents, 1))
    before = len(getattr(step_and_observe, "signatures", ()))
    twin = pickle.loads(pickle.dumps(copy.deepcopy(env)))
    twin.step(dict.fromkeys(twin.agents, 1))
    assert len(getattr(step_and_observe, "signatures", ())) == before


def test_supersuit_finds_the_generator() -> None:
    """SuperSuit's frame skip, which reads the environment's generator, steps it."""
    supersuit = pytest.importorskip("supersuit")
    env = supersuit.frame_skip_v0(mapp_v0.parallel_env(), 2)
    env.reset(seed=0)
    _, rewards, _, _, _ = env.step(dict.fromkeys(env.agents, 1))
    assert set(rewards) == {"agent_0", "agent_1", "agent_2"}


PLAY = """
from mapp_env import mapp_v0
env = mapp_v0.parallel_env()
env.reset(options={"landmarks": [0, 6, 20, 42, 48]})
print(env.step({agent: 0 for agent in env.agents})[1]["agent_0"])
"""


def test_changed_rules_are_compiled_anew(tmp_path: Path) -> None:
    """After a rule is edited, an old cache does not serve the old rule through another file."""
    package = tmp_path / "mapp_env"
    shutil.copytree(
        Path(mapp_env.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__")
    )
    environ = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "nb")}

    def play() -> float:
        command = [sys.executable, "-c", PLAY]
        done = subprocess.run(
            command, env=environ, cwd=tmp_path, capture_output=True, text=True, check=True
        )
        return float(done.stdout)

    first = play()
    assert first == play()
    rules = package / "engine" / "rules.py"
    source = rules.read_text(encoding="utf-8")
    assert source.count("return -float(distance)") == 1
    rules.write_text(
        source.replace("return -float(distance)", "return -1000.0 - float(distance)"),
        encoding="utf-8",
    )
    assert play() == first - 1000


@pytest.mark.parametrize("copier", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_copies_of_a_grid_keep_its_depot(copier: Callable[[Any], Any]) -> None:
    """Wherever the depot is, a copy has it there, and so have problems and environments on it."""
    for depot in (0, 5, 11):
        grid = mapp_env.Grid(np.zeros((3, 4), bool), depot)
        assert copier(grid).depot == depot
        assert copier(grid) == grid
        assert copier(mapp_env.Problem(grid, (1,))).grid.depot == depot
        env = copier(mapp_v0.parallel_env(grid=grid, n_landmarks=1))
        assert env.reset(seed=0)[0]["agent_0"][:3].tolist() == [depot] * 3


def test_every_file_with_a_kernel_names_the_compiled_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever file with compiled code is edited, the name that the cache goes by is another."""
    package = tmp_path / "edited_env"
    shutil.copytree(
        Path(mapp_env.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__")
    )
    (package / "__init__.py").write_text("")  # compiled.py alone is imported
    monkeypatch.syspath_prepend(tmp_path)
    edited = importlib.import_module("edited_env.compiled")
    names = {edited._digest_sources()}
    files = [path for path in package.rglob("*.py") if "\n@kernel" in path.read_text("utf-8")]
    assert len(files) > 8
    for path in files:
        path.write_text(path.read_text("utf-8") + "\n# edited\n", encoding="utf-8")
        names.add(edited._digest_sources())
    assert len(names) == len(files) + 1
