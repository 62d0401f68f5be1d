"""Pools, their options and landmark actions that cannot be used are refused by name, unharmed."""

from __future__ import annotations

import contextlib
import re
import tracemalloc
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest

import mapp_env
from mapp_env import mapp_v0

PAPER = mapp_env.make_grid("paper-7x7")
SMALL = mapp_env.Grid.from_text("D..\n...\n##.\n.#.\n")  # cell 9 is walled off
LINE = mapp_env.Grid.from_text("..D..")
POOL = [PAPER, SMALL, LINE]

FACES: dict[str, Callable[..., Any]] = {
    "parallel": mapp_v0.parallel_env,
    "aec": mapp_v0.env,
    "central": lambda **arguments: gymnasium.make("mapp_env/Central-v0", **arguments),
    "tuple": lambda **arguments: gymnasium.make("mapp_env/Tuple-v0", **arguments),
    "vector": lambda **arguments: mapp_env.make_vec(2, **arguments),
}

SETTINGS: dict[str, Any] = {"grid": POOL, "n_agents": 2, "n_landmarks": 3}


def make(face: str, **changes: Any) -> Any:
    """Return an environment over the pool."""
    return FACES[face](**{**SETTINGS, **changes})


def refusal(call: Callable[[], Any], *names: str) -> str:
    """Return the message of the ValueError of ``call``; it has to hold all of ``names``."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011 (the message is looked at below)
        call()
    for name in names:
        assert re.search(name, str(caught.value)), f"{name!r} is not in {str(caught.value)!r}"
    return str(caught.value)


@contextlib.contextmanager
def little_memory(limit: int = 2**22) -> Iterator[None]:
    """Check that no more than four megabytes are taken meanwhile."""
    tracemalloc.start()
    try:
        yield
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < limit


BAD_POOLS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "empty list": ([], (r"\bgrid\b", r"\[\]|empty|at least")),
    "empty tuple": ((), (r"\bgrid\b",)),
    "a number in it": ([PAPER, 7], (r"grid\[1\]", "7")),
    "none in it": ([PAPER, None], (r"grid\[1\]", "None")),
    "a pool in it": ([PAPER, [SMALL]], (r"grid\[1\]",)),
    "an array in it": ([np.zeros((3, 3), bool)], (r"grid\[0\]",)),
    "a set": ({1, 2}, (r"\bgrid\b",)),
    "a number": (7, (r"\bgrid\b", "7")),
    "only the depot is free": (
        [PAPER, LINE, mapp_env.Grid.from_text("D#.")], (r"grid\[2\]",)
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_POOLS)
@pytest.mark.parametrize("face", FACES)
def test_what_is_no_pool(face: str, case: str) -> None:
    """Empty pools, and anything but grids in one, are refused; the message says which."""
    pool, names = BAD_POOLS[case]
    refusal(lambda: make(face, grid=pool), *names)


@pytest.mark.parametrize("face", FACES)
def test_a_grid_without_room(face: str) -> None:
    """Landmarks that one grid of the pool has no room for are refused; which grid is said."""
    make(face, n_landmarks=4).reset(seed=0)
    message = refusal(lambda: make(face, n_landmarks=5), r"\bn_landmarks\b", r"\b4\b", r"\b5\b")
    assert "grid[2]" in message
    message = refusal(lambda: make(face, n_landmarks=8), r"\bn_landmarks\b", r"\b8\b")
    assert re.search(r"grid\[[12]\]", message)


@pytest.mark.parametrize("face", FACES)
@pytest.mark.parametrize(
    "changes",
    [
        {"actions": "landmarks"},
        {"observation": "distances"},
        {"reward": "geodesic"},
        {},
    ],
    ids=str,
)
def test_pools_whose_tables_do_not_fit(face: str, changes: dict[str, Any]) -> None:
    """A pool whose tables would take more than 1 GiB is refused before anything is allocated."""
    grid = mapp_env.Grid(np.zeros((64, 64), bool))
    grid.reachable  # noqa: B018 (its own tables are there before)
    pool = [grid] * 200_000
    with little_memory(2**26):
        refusal(lambda: make(face, grid=pool, **changes), r"\bgrid\b", str(2**30))


@pytest.mark.parametrize(
    "changes",
    [{"actions": "landmarks"}, {"observation": "distances"}, {"reward": "geodesic"}],
    ids=str,
)
def test_rows_whose_paths_do_not_fit(changes: dict[str, Any]) -> None:
    """A batch keeps paths as long as its largest grid: more than 1 GiB of them are refused."""
    pool = [LINE, mapp_env.Grid(np.zeros((64, 64), bool))]
    most = 2**30 // (4 * 4096 * 3)
    arguments = {**SETTINGS, "grid": pool, **changes}
    with little_memory(2**26):
        refusal(lambda: mapp_env.make_vec(most + 1, **arguments), "64|4096", str(2**30))
    mapp_env.make_vec(64, **arguments).reset(seed=0)


BAD_OPTIONS: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "beyond the last": ({"grid": 3}, (r"options\['grid'\]", r"\b3\b", r"0\.\.2")),
    "negative": ({"grid": -1}, (r"options\['grid'\]", "-1")),
    "huge": ({"grid": 10**25}, (r"options\['grid'\]",)),
    "wraps to 0": ({"grid": 2**32}, (r"options\['grid'\]",)),
    "fractional": ({"grid": 1.5}, (r"options\['grid'\]", "1.5")),
    "float": ({"grid": 1.0}, (r"options\['grid'\]", "1.0")),
    "bool": ({"grid": True}, (r"options\['grid'\]", "True")),
    "text": ({"grid": "paper-7x7"}, (r"options\['grid'\]", "paper-7x7")),
    "a grid": ({"grid": PAPER}, (r"options\['grid'\]",)),
    "landmarks without a grid": ({"landmarks": [0, 1, 3]}, (r"\bgrid\b", r"\blandmarks\b")),
    "landmarks of another grid": ({"grid": 2, "landmarks": [0, 1, 40]}, ("landmarks", "40")),
    "landmarks on a wall": ({"grid": 1, "landmarks": [1, 2, 6]}, ("landmarks", "6", "wall")),
    "landmarks cut off": ({"grid": 1, "landmarks": [1, 2, 9]}, ("landmarks", "9")),
    "landmarks on the depot": ({"grid": 1, "landmarks": [1, 2, 0]}, ("landmarks", "depot")),
    "too many landmarks": ({"grid": 0, "landmarks": [0, 1, 2, 3]}, ("landmarks", r"\b3\b")),
    "a problem on another grid": (
        {"problem": mapp_env.Problem(mapp_env.Grid.from_text("D...."), (1, 2, 3), 2)},
        (r"options\['problem'\]",),
    ),
    "a problem of another team": (
        {"problem": mapp_env.Problem(PAPER, (0, 1, 2), 3)}, (r"options\['problem'\]",)
    ),
    "a problem with other landmarks": (
        {"problem": mapp_env.Problem(PAPER, (0, 1), 2)}, (r"options\['problem'\]",)
    ),
    "a problem and a grid": (
        {"problem": mapp_env.Problem(PAPER, (0, 1, 2), 2), "grid": 0}, ("problem", "grid")
    ),
    "a problem and landmarks": (
        {"problem": mapp_env.Problem(PAPER, (0, 1, 2), 2), "landmarks": [0, 1, 2]},
        ("problem", "landmarks"),
    ),
    "no problem": ({"problem": "paper"}, (r"options\['problem'\]",)),
}  # fmt: skip


def play_on(env: Any, face: str) -> list[Any]:
    """Return what an environment says next, and after its next reset."""
    if face == "parallel":
        step: Any = env.step(dict.fromkeys(env.agents, 1))
    elif face == "aec":
        env.step(1)
        env.step(1)
        step = env.last()
    elif face == "vector":
        step = env.step(np.ones((2, 2), int))
    else:
        step = env.step(5 if face == "central" else (1, 1))
    return [step, env.reset(), env.unwrapped.task.grids]


@pytest.mark.parametrize("case", BAD_OPTIONS)
@pytest.mark.parametrize("face", FACES)
def test_bad_options(face: str, case: str, same: Any) -> None:
    """Options that name no problem of the pool are refused, and the episode is not disturbed."""
    options, names = BAD_OPTIONS[case]
    env, twin = make(face), make(face)
    for each in (env, twin):
        each.reset(seed=3)
    refusal(lambda: env.reset(options=dict(options)), *names)
    refusal(lambda: env.reset(seed=5, options=dict(options)), *names)
    same(play_on(env, face), play_on(twin, face))


GOOD = mapp_env.Problem(LINE, (0, 1, 3), 2)
BAD_ROWS: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "too few grids": ({"grid": [0]}, (r"options\['grid'\]", r"\b2\b")),
    "too many grids": ({"grid": [0, 1, 2]}, (r"options\['grid'\]", r"\b2\b")),
    "no grids": ({"grid": []}, (r"options\['grid'\]", r"\b2\b")),
    "a bad grid of a row": ({"grid": [0, 3]}, (r"options\['grid'\]", r"\b3\b")),
    "a negative grid of a row": ({"grid": [-1, 0]}, (r"options\['grid'\]", "-1")),
    "a fraction of a row": ({"grid": [0, 1.5]}, (r"options\['grid'\]",)),
    "floats": ({"grid": np.array([0.0, 1.0])}, (r"options\['grid'\]",)),
    "bools": ({"grid": np.array([True, False])}, (r"options\['grid'\]",)),
    "a table": ({"grid": np.array([[0, 1], [1, 0]])}, (r"options\['grid'\]",)),
    "too few problems": ({"problem": [GOOD]}, (r"options\['problem'\]", r"\b2\b")),
    "too many problems": ({"problem": [GOOD] * 3}, (r"options\['problem'\]", r"\b2\b")),
    "no problem of a row": ({"problem": [GOOD, None]}, (r"options\['problem'\]\[1\]",)),
    "another grid's of a row": (
        {"problem": [mapp_env.Problem(mapp_env.Grid.from_text("D...."), (1, 2, 3), 2), GOOD]},
        (r"options\['problem'\]\[0\]",),
    ),
    "another team's of a row": (
        {"problem": [GOOD, mapp_env.Problem(LINE, (0, 1, 3), 1)]},
        (r"options\['problem'\]\[1\]",),
    ),
    "landmarks of rows without grids": (
        {"landmarks": np.array([[0, 1, 2], [0, 1, 2]])}, ("landmarks", "grid")
    ),
    "landmarks of too few rows": (
        {"grid": [0, 0], "landmarks": np.array([[0, 1, 2]])}, ("landmarks",)
    ),
    "landmarks off a row's grid": (
        {"grid": [0, 2], "landmarks": np.array([[0, 1, 40], [0, 1, 40]])},
        (r"landmarks'\]\[1\]", "40"),
    ),
    "pairs off a row's grid": (
        {"grid": [0, 2], "landmarks": np.array([[[0, 0], [0, 1], [1, 0]]] * 2)},
        (r"landmarks'\]\[1\]",),
    ),
    "landmarks of a row on its depot": (
        {"grid": [1, 0], "landmarks": np.array([[0, 1, 2], [0, 1, 2]])},
        (r"landmarks'\]\[0\]", "depot"),
    ),
    "a landmark of a row twice": (
        {"grid": [0, 2], "landmarks": np.array([[0, 1, 2], [0, 1, 1]])}, (r"landmarks'\]\[1\]",)
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_ROWS)
def test_bad_options_of_rows(case: str, same: Any) -> None:
    """Options of each row that are not one a row, or not of its grid, are refused; none resets."""
    options, names = BAD_ROWS[case]
    env, twin = make("vector"), make("vector")
    for each in (env, twin):
        each.reset(seed=3)
    refusal(lambda: env.reset(options=dict(options)), *names)
    same(play_on(env, "vector"), play_on(twin, "vector"))


BAD_ACTIONS = [4, -1, 10**25, 2**32, 2**64, 1.5, 1.0, True, None, "1", [1], float("nan")]


@pytest.mark.parametrize("action", BAD_ACTIONS, ids=repr)
@pytest.mark.parametrize("home", [False, True])
@pytest.mark.parametrize("face", ["parallel", "aec", "central", "tuple", "vector"])
def test_landmark_actions_outside(face: str, home: bool, action: Any, same: Any) -> None:
    """Landmark actions are 0..K; all else is refused, and nothing has moved."""
    env, twin = (make(face, actions="landmarks", return_home=home) for _ in range(2))
    for each in (env, twin):
        each.reset(seed=3)
    if face == "parallel":
        refusal(lambda: env.step({"agent_0": 0, "agent_1": action}), "agent_1", r"0\.\.3")
    elif face == "aec":
        refusal(lambda: env.step(action), "agent_0", r"0\.\.3")
    elif face == "vector":
        plain = type(action) is int and abs(action) < 2**63
        actions = np.array([[0, 3], [2, 1]], int if plain else object)
        actions[1, 1] = action
        refusal(lambda: env.step(actions), "actions")
    else:
        refusal(lambda: env.step((0, action)), "action", r"0\.\.3")
    last = [0, 3] if face in ("central", "tuple") else None
    for each in (env, twin):
        if last is not None:
            each.said = each.step(last)
        elif face == "parallel":
            each.said = each.step({"agent_0": 0, "agent_1": 3}), each.state()
        elif face == "aec":
            each.step(0)
            each.step(3)
            each.said = each.last()
        else:
            each.said = each.step(np.array([[0, 3], [2, 1]]))
    same(env.said, twin.said)


@pytest.mark.parametrize("face", FACES)
def test_settings_that_are_none(face: str) -> None:
    """Unknown kinds of actions, flags that are none, waiting and joint numbers are refused."""
    message = refusal(lambda: make(face, actions="jumps"), r"\bactions\b", "jumps")
    assert "moves" in message
    assert "landmarks" in message
    for value in (None, 1, ["moves"]):
        refusal(lambda value=value: make(face, actions=value), r"\bactions\b")
    for value in (None, 1, "yes"):
        refusal(lambda value=value: make(face, return_home=value), r"\breturn_home\b", "True")
    refusal(lambda: make(face, actions="landmarks", allow_wait=True), r"\ballow_wait\b", "actions")
    if face in ("central", "vector"):
        refusal(
            lambda: make(face, actions="landmarks", central_action="joint"),
            r"\bcentral_action\b",
            "landmarks",
        )


@pytest.mark.parametrize("face", FACES)
def test_bad_starts_reach_no_environment(face: str) -> None:
    """A problem's starts are checked where it is made: an environment is given none that is bad."""
    for starts in ((6, 0), (9, 0), (1, 0), (0,), (0, 0, 0), (12, 0), (-1, 0)):
        refusal(
            lambda starts=starts: mapp_env.Problem(SMALL, (1, 2, 5), 2, starts=starts), "starts"
        )
    env = make(face)
    env.reset(options={"problem": mapp_env.Problem(SMALL, (1, 2, 5), 2, starts=(3, (2, 2)))})
