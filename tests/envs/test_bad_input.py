"""What cannot be used is refused: a ValueError says which argument, which value, what may be."""

from __future__ import annotations

import contextlib
import copy
import json
import os
import re
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from model import OBSERVATIONS, REWARDS

import mapp_env
from mapp_env import mapp_v0
from mapp_env.engine.options import NOTHING
from mapp_env.engine.rows import Rows
from mapp_env.engine.simulation import Simulation
from mapp_env.engine.sources import Source
from mapp_env.engine.task import Task

REPOSITORY = Path(__file__).resolve().parents[2]

PAPER = mapp_env.make_grid("paper-7x7")
# Cell 8 is walled off from the depot, cell 0.
SPLIT = mapp_env.Grid.from_text("D..\n...\n##.\n.#.\n")

FACES: dict[str, Callable[..., Any]] = {
    "parallel": mapp_v0.parallel_env,
    "aec": mapp_v0.env,
    "central": lambda **arguments: gymnasium.make("mapp_env/Central-v0", **arguments),
    "vector": lambda **arguments: mapp_env.make_vec(2, **arguments),
}

BAD_COUNTS: list[Any] = [
    0, -1, 2.5, 3.0, True, 10**9, 10**30, "3", None, float("nan"), float("inf"), [3],
    np.float64(3.0), np.bool_(True),
]  # fmt: skip


def refusal(name: str, value: Any, call: Callable[[], Any]) -> str:
    """Return the message of the ValueError of ``call``; it has to name argument and value."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011 (the message is looked at below)
        call()
    message = str(caught.value)
    assert re.search(rf"\b{name}\b", message), f"{name!r} is not in {message!r}"
    shown = str(value).strip("[]'\"")
    assert shown in message or repr(value) in message, f"{value!r} is not in {message!r}"
    return message


@contextlib.contextmanager
def little_memory() -> Iterator[None]:
    """Check that no more than a megabyte is taken meanwhile."""
    tracemalloc.start()
    try:
        yield
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 2**20


@pytest.mark.parametrize("value", BAD_COUNTS, ids=repr)
@pytest.mark.parametrize("name", ["n_agents", "n_landmarks", "max_cycles"])
@pytest.mark.parametrize("face", FACES)
def test_counts(face: str, name: str, value: Any) -> None:
    """Counts that are zero, negative, fractional, bool, absurd or no number are refused."""
    message = refusal(name, value, lambda: FACES[face](**{name: value}))
    assert re.search(r"\b1\b", message), "the message names the smallest allowed value"


@pytest.mark.parametrize("value", BAD_COUNTS, ids=repr)
def test_num_envs(value: Any) -> None:
    """make_vec refuses a number of rows that is not one, or absurd, before it allocates."""
    refusal("num_envs", value, lambda: mapp_env.make_vec(value))
    with little_memory():
        refusal("num_envs", value, lambda: mapp_env.make_vec(value))


def test_masks_of_joint_actions_that_do_not_fit() -> None:
    """More than 1 GiB of masks a step is refused, with what to do; all else is allowed."""
    with pytest.raises(ValueError, match=r"central_action.*1073745920 bytes.*use 'multi'"):
        mapp_env.make_vec(2**18 + 1, n_agents=6, central_action="joint")
    mapp_env.make_vec(2**12, n_agents=6, central_action="joint")


def test_most_rows() -> None:
    """A batch of 1,048,576 rows can be made; one row more is refused by name."""
    grid = mapp_env.Grid.from_text("D.\n")
    smallest: dict[str, Any] = {"grid": grid, "n_agents": 1, "n_landmarks": 1}
    assert mapp_env.make_vec(2**20, **smallest).num_envs == 1_048_576
    refusal("num_envs", 1_048_577, lambda: mapp_env.make_vec(2**20 + 1, **smallest))


@pytest.mark.parametrize("name", ["n_agents", "n_landmarks", "max_cycles"])
def test_absurd_counts_cost_nothing(name: str) -> None:
    """A count of a billion is refused before anything of that size is made."""
    mapp_v0.parallel_env()
    for face in FACES.values():
        refusal(name, 10**9, lambda face=face: face(**{name: 10**9}))
        with little_memory():
            refusal(name, 10**9, lambda face=face: face(**{name: 10**9}))


@pytest.mark.parametrize(
    "arguments",
    [
        {"n_agents": 16, "n_landmarks": 40},
        {"n_agents": 1, "n_landmarks": 1, "max_cycles": 1},
        {"n_agents": np.int64(2), "n_landmarks": np.int32(3), "max_cycles": np.uint8(9)},
    ],
)
def test_allowed_extremes(arguments: dict[str, Any]) -> None:
    """The bounds themselves are allowed, on every face, and NumPy integers count as integers."""
    for make in FACES.values():
        make(**arguments).reset(seed=0)


def test_most_landmarks() -> None:
    """Up to 256 landmarks are a problem; one more is refused by name wherever it can be asked."""
    grid = mapp_env.Grid(np.zeros((17, 17), bool))
    cells = grid.reachable[:257].tolist()
    assert len(mapp_env.Problem(grid, cells[:256], 2).landmarks) == 256
    assert mapp_env.sample_problems(grid, 2, 256).shape == (2, 256)
    env = mapp_v0.parallel_env(grid=grid, n_landmarks=256)
    env.reset(options={"landmarks": cells[:256]})
    assert env.state().shape == (3 + 2 * 256,)
    refusal("n_landmarks", 257, lambda: mapp_v0.parallel_env(grid=grid, n_landmarks=257))
    refusal("n_landmarks", 257, lambda: mapp_env.sample_problems(grid, 2, 257))
    with pytest.raises(ValueError, match=r"landmarks must hold 1\.\.256 cells"):
        mapp_env.Problem(grid, cells, 2)


LINE = mapp_env.Grid.from_text("D...")


def faces_and_problem(**arguments: Any) -> None:
    """Ask every face, and a problem, for something that all of them limit alike."""
    for make in FACES.values():
        make(grid=LINE, n_landmarks=2, **arguments)
    mapp_env.Problem(LINE, (1, 2), **arguments)


SHAPES = {4096: (64, 64), 4097: (17, 241)}  # of grids with so many cells

# Name, largest allowed value, and what takes it.
LIMITS: dict[str, tuple[str, int, Callable[[int], Any]]] = {
    "rows": ("walls", 2048, lambda n: mapp_env.Grid(np.zeros((n, 1), bool))),
    "columns": ("walls", 2048, lambda n: mapp_env.Grid(np.zeros((1, n), bool))),
    "rows of a text": ("rows", 2048, lambda n: mapp_env.Grid.from_text("..\n" * n)),
    "columns of a text": ("columns", 2048, lambda n: mapp_env.Grid.from_text("." * n)),
    "height": (
        "height",
        2048,
        lambda n: mapp_env.Grid.from_text(f"type octile\nheight {n}\nwidth 1\nmap\n" + ".\n" * n),
    ),
    "characters of a text": (
        "characters", 8 << 20, lambda n: mapp_env.Grid.from_text("D." + "\n" * (n - 2))
    ),
    **{
        f"{side} of {kind}": (
            side, 2048, lambda n, kind=kind, side=side: mapp_env.make_grid(kind, **{side: n})
        )
        for kind in ("maze", "random", "rooms", "warehouse")
        for side in ("rows", "cols")
    },
    "agents": ("n_agents", 16, lambda n: faces_and_problem(n_agents=n)),
    "agents of a universe": (
        "n_agents", 16, lambda n: mapp_env.solvers.solve_universe(LINE, 1, n_agents=n)
    ),
    "agents of many problems": (
        "n_agents", 16, lambda n: mapp_env.solvers.optimal_costs(LINE, [[1]], n_agents=n)
    ),
    "steps": ("max_cycles", 1_000_000, lambda n: faces_and_problem(max_cycles=n)),
    "steps assigned": (
        "max_cycles", 1_000_000, lambda n: setattr(mapp_v0.parallel_env(), "max_cycles", n)
    ),
    "cells with all distances": (
        "cells", 4096, lambda n: mapp_env.Grid(np.zeros(SHAPES[n], bool)).distances
    ),
    "seed of a draw": ("seed", 2**63 - 1, lambda n: mapp_env.sample_problems(LINE, 1, 1, seed=n)),
    "seed of a grid": ("seed", 2**128 - 1, lambda n: mapp_env.make_grid("rooms", seed=n)),
    "seed of a search": (
        "seed", 2**128 - 1, lambda n: mapp_env.solve(mapp_env.Problem(LINE, (1,)), seed=n)
    ),
    "seed of an episode": ("seed", 2**128 - 1, lambda n: mapp_v0.parallel_env().reset(seed=n)),
}  # fmt: skip


@pytest.mark.parametrize("case", LIMITS)
def test_limits_are_as_documented(case: str) -> None:
    """The largest value that is documented is taken; one more is refused by name."""
    name, limit, call = LIMITS[case]
    call(limit)
    with pytest.raises(ValueError, match=name) as caught:
        call(limit + 1)
    assert re.search(rf"\b({limit}|{limit + 1})\b", str(caught.value))


@pytest.mark.parametrize(
    ("arguments", "size"),
    [
        ({}, 4 * 13),
        ({"observation": "own_first"}, 3 * 4 * 13),
        ({"observation": "planes"}, 3 * 4 * 6 * 49),
        ({"grid": mapp_env.Grid(np.zeros((64, 65), bool)), "reward": "geodesic"}, 4 * 5 * 64 * 65),
    ],
)
def test_a_gibibyte_is_allowed(arguments: dict[str, Any], size: int) -> None:
    """As many rows as fit in 1 GiB of observations, or of distances, are allowed, and no more."""
    task = Task(**{"grid": PAPER, **arguments})
    rows = (1 << 30) // size
    task.check_memory(rows)
    with pytest.raises(ValueError, match=f"would take {(rows + 1) * size} bytes"):
        task.check_memory(rows + 1)


def test_the_largest_file_is_read(tmp_path: Path) -> None:
    """A map file of exactly eight mebibytes is read, one of a byte more is not."""
    path = tmp_path / "large.map"
    path.write_text("D." + "\n" * ((8 << 20) - 2))
    assert mapp_env.Grid.load(path) == mapp_env.Grid.from_text("D.")
    path.write_text("D." + "\n" * ((8 << 20) - 1))
    with pytest.raises(mapp_env.MapError, match=r"large\.map: has 8388609 bytes"):
        mapp_env.Grid.load(path)


def test_most_problems_drawn() -> None:
    """Up to ten million problems may be drawn at once, where there are so many."""
    for count, reason in (
        (10**7, "at most 3, the number of problems"),
        (10**7 + 1, "in 1..10000000"),
    ):
        with pytest.raises(ValueError, match=f"n_problems must be .*{reason}"):
            mapp_env.sample_problems(LINE, count, 1)


def test_more_landmarks_than_cells() -> None:
    """More landmarks than the grid has cells for are refused; exactly as many are fine."""
    grid = mapp_env.Grid.from_text("D..\n")
    refusal("n_landmarks", 3, lambda: mapp_v0.parallel_env(grid=grid, n_landmarks=3))
    env = mapp_v0.parallel_env(grid=grid, n_landmarks=2)
    env.reset(seed=0)
    assert sorted(env.state()[3:5].tolist()) == [1, 2]


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("reward", "sparse", REWARDS),
        ("reward", None, REWARDS),
        ("reward", 0, REWARDS),
        ("observation", "pixels", OBSERVATIONS),
        ("observation", ["global"], OBSERVATIONS),
        ("observation", "Global", OBSERVATIONS),
        ("render_mode", "video", ["human", "rgb_array", "ansi"]),
        ("render_mode", 1, ["human", "rgb_array", "ansi"]),
        ("allow_wait", "no", ["True", "False"]),
        ("allow_wait", 1, ["True", "False"]),
        ("allow_wait", None, ["True", "False"]),
        ("grid", "paper-8x8", ["paper-7x7"]),
        ("grid", "nope.map", ["paper-7x7", "map file", "there is no such file"]),
        ("grid", 7, []),
        ("grid", None, []),
    ],
    ids=repr,
)
@pytest.mark.parametrize("face", ["parallel", "vector"])
def test_unknown_names(face: str, name: str, value: Any, allowed: list[str]) -> None:
    """Unknown names are refused with the list of the known ones."""
    if face == "vector" and name == "render_mode" and value == "human":
        return
    message = refusal(name, value, lambda: FACES[face](**{name: value}))
    for word in allowed:
        assert word in message


def test_central_action_and_grid_names() -> None:
    """central_action and make_grid list what they know; 7 agents have no joint number."""
    refusal("central_action", "sum", lambda: FACES["central"](central_action="sum"))
    message = refusal("name", "atlantis", lambda: mapp_env.make_grid("atlantis"))
    assert "paper-7x7" in message


BAD_LANDMARKS: dict[str, Any] = {
    "duplicate": [0, 6, 20, 42, 42],
    "wall": [0, 6, 20, 42, 8],
    "depot": [0, 6, 20, 42, 24],
    "off the grid": [0, 6, 20, 42, 49],
    "negative": [0, 6, 20, 42, -1],
    "huge": [0, 6, 20, 42, 10**25],
    "wraps to cell 1": [0, 6, 20, 42, 2**32 + 1],
    "fractional": [0, 6, 20, 42, 47.5],
    "float": [0.0, 6.0, 20.0, 42.0, 48.0],
    "nan": [0, 6, 20, 42, float("nan")],
    "bool": [0, 6, 20, 42, True],
    "string": [0, 6, 20, 42, "48"],
    "none inside": [0, 6, 20, 42, None],
    "too few": [0, 6, 20, 42],
    "too many": [0, 6, 20, 42, 48, 47],
    "empty": [],
    "none": None,
    "number": 5,
    "text": "0 6 20 42 48",
    "triples": [(0, 0, 0)] * 5,
    "nested": [[[0, 6, 20, 42, 48]]],
    "pair off the grid": [(0, 0), (0, 6), (2, 6), (6, 0), (6, 7)],
    "pair with a negative": [(0, 0), (0, 6), (2, 6), (6, 0), (-1, 6)],
    "float array": np.array([0.5, 6, 20, 42, 48]),
    "bool array": np.array([True, False, True, False, True]),
    "same cell twice in two spellings": [0, 6, 20, (6, 6), 48],
}


# As an option, None is a way to say that nothing is asked for.
@pytest.mark.parametrize("case", [c for c in BAD_LANDMARKS if c != "none"])
@pytest.mark.parametrize("face", FACES)
def test_landmark_option(face: str, case: str, same: Any) -> None:
    """A problem that breaks R2 is refused by reset, and the running episode is not disturbed."""
    env, twin = FACES[face](), FACES[face]()
    for each in (env, twin):
        each.reset(seed=3)
    with pytest.raises(ValueError, match="landmark"):
        env.reset(options={"landmarks": copy.deepcopy(BAD_LANDMARKS[case])})
    played = []
    for each in (env, twin):
        if face == "parallel":
            played.append([each.state(), each.step(dict.fromkeys(each.agents, 1)), each.reset()])
        elif face == "aec":
            each.step(1)
            each.reset()
            played.append([each.state()])
        elif face == "central":
            played.append([each.step(7), each.reset()])
        else:
            played.append([each.step(np.ones((2, 3), dtype=int)), each.reset()])
    same(played[0], played[1])


@pytest.mark.parametrize("case", [c for c in BAD_LANDMARKS if c not in ("too few", "too many")])
def test_problem_landmarks(case: str) -> None:
    """Problem refuses the same landmarks at construction."""
    with pytest.raises(ValueError, match="landmark"):
        mapp_env.Problem(PAPER, BAD_LANDMARKS[case], n_agents=3)


def test_landmark_messages_name_the_value() -> None:
    """The message about a landmark names the offending cell."""
    for cell in (8, 24, 49):
        refusal("landmarks", cell, lambda c=cell: mapp_env.Problem(PAPER, (0, c), n_agents=3))


def test_unreachable_landmark() -> None:
    """A landmark behind walls is refused, as an option and in a Problem."""
    refusal("landmarks", 9, lambda: mapp_env.Problem(SPLIT, (1, 9), n_agents=2))
    env = mapp_v0.parallel_env(grid=SPLIT, n_landmarks=2)
    with pytest.raises(ValueError, match="9"):
        env.reset(options={"landmarks": [1, 9]})
    for seed in range(30):
        env.reset(seed=seed)
        assert 9 not in env.state()[3:5].tolist()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("n_agents", value) for value in BAD_COUNTS],
        *[("max_cycles", value) for value in BAD_COUNTS if value is not None],
    ],
    ids=repr,
)
def test_problem_counts(name: str, value: Any) -> None:
    """Problem refuses the same counts as the environments."""
    refusal(name, value, lambda: mapp_env.Problem(PAPER, (0, 6), **{name: value}))


def test_problem_of_another_kind() -> None:
    """A Problem whose grid or counts are not the environment's is refused, and so is no Problem."""
    env = mapp_v0.parallel_env()
    others = [
        mapp_env.Problem(PAPER, (0, 6, 20, 42), n_agents=3),
        mapp_env.Problem(PAPER, (0, 6, 20, 42, 48), n_agents=2),
        mapp_env.Problem(SPLIT, (1, 2, 3, 4, 5), n_agents=3),
        "paper",
        (0, 6, 20, 42, 48),
    ]
    for other in others:
        with pytest.raises(ValueError, match="problem"):
            env.reset(options={"problem": other})
    with pytest.raises(ValueError, match="grid"):
        mapp_env.Problem("paper-7x7", (0, 6), n_agents=3)  # type: ignore[arg-type]


@pytest.mark.parametrize("value", ["now", 5, [1, 2]], ids=repr)
def test_options_that_are_no_dict(value: Any) -> None:
    """Options that are no dictionary are refused."""
    for make in (FACES["parallel"], FACES["vector"]):
        with pytest.raises(ValueError, match="options"):
            make().reset(options=value)


BAD_ACTIONS: dict[str, Any] = {
    "too large": 4,
    "negative": -1,
    "huge": 10**25,
    "wraps to 0": 2**32,
    "wraps to 0 too": 2**64,
    "unsigned": np.uint64(2**63 + 1),
    "fractional": 1.5,
    "float": 1.0,
    "nan": float("nan"),
    "infinite": float("inf"),
    "numpy float": np.float32(1),
    "bool": True,
    "numpy bool": np.bool_(True),
    "none": None,
    "string": "1",
    "list": [1],
    "array": np.array([1, 2]),
    "complex": 1j,
}


@pytest.mark.parametrize("case", BAD_ACTIONS)
@pytest.mark.parametrize("place", [0, 2])
def test_parallel_actions(case: str, place: int, same: Any) -> None:
    """ParallelEnv refuses what is no action, names the agent, and nothing has moved."""
    env, twin = mapp_v0.parallel_env(), mapp_v0.parallel_env()
    for each in (env, twin):
        each.reset(seed=3)
        each.step(dict.fromkeys(each.agents, 2))
    actions = dict.fromkeys(env.agents, 1)
    actions[f"agent_{place}"] = BAD_ACTIONS[case]
    for _ in range(2):
        with pytest.raises(ValueError, match=f"agent_{place}") as caught:
            env.step(actions)
        value = BAD_ACTIONS[case]
        assert str(value) in str(caught.value) or repr(value) in str(caught.value)
    same(env.state(), twin.state())
    good = dict.fromkeys(env.agents, 1)
    same(env.step(good), twin.step(good))


@pytest.mark.parametrize(
    "change",
    [
        lambda actions: {k: v for k, v in actions.items() if k != "agent_1"},
        lambda actions: {**actions, "agent_3": 1},
        lambda actions: {**{k: v for k, v in actions.items() if k != "agent_1"}, "agent_9": 1},
        lambda actions: {},
        lambda actions: None,
        lambda actions: list(actions.values()),
        lambda actions: 1,
        lambda actions: {0: 1, 1: 1, 2: 1},
    ],
)
def test_parallel_action_dictionaries(change: Callable[[Any], Any], same: Any) -> None:
    """A missing agent, an unknown agent, or no dictionary is refused, and nothing has moved."""
    env, twin = mapp_v0.parallel_env(), mapp_v0.parallel_env()
    for each in (env, twin):
        each.reset(seed=3)
    good = dict.fromkeys(env.agents, 1)
    with pytest.raises(ValueError, match="action"):
        env.step(change(dict(good)))
    same(env.step(good), twin.step(good))


def play_round(env: Any, action: Any) -> None:
    """Give every agent of an AEC environment the same action."""
    for _ in range(3):
        env.step(action)


def test_aec_actions(same: Any) -> None:
    """The AEC face refuses bad actions too, at the latest when the round is carried out."""
    for case in ("too large", "negative", "fractional", "bool", "string", "nan"):
        env = mapp_v0.env()
        env.reset(seed=1)
        before = env.state()
        with pytest.raises((ValueError, AssertionError)):
            play_round(env, BAD_ACTIONS[case])
        same(env.state(), before)


@pytest.mark.parametrize(
    "value",
    [64, -1, 10**25, 2**32, 2**64, 1.5, 1.0, float("nan"), True, np.bool_(False), None, "3",
     [0, 1, 2], np.array([0, 1, 2]), np.array([1.0]), {}],
    ids=repr,
)  # fmt: skip
def test_central_joint_actions(value: Any, same: Any) -> None:
    """Central-v0 with a joint number refuses everything but 0..63, and nothing has moved."""
    env, twin = (gymnasium.make("mapp_env/Central-v0", disable_env_checker=True) for _ in range(2))
    for each in (env, twin):
        each.reset(seed=3)
    with pytest.raises(ValueError, match="action"):
        env.step(value)
    for number in (0, 63, np.int64(27)):
        same(env.step(number), twin.step(number))


BAD_MULTI: dict[str, Any] = {
    "short": [0, 1],
    "long": [0, 1, 2, 3],
    "too large": [0, 1, 4],
    "negative": [0, -1, 2],
    "wraps": [0, 1, 2**32],
    "wraps 64": [0, 1, 2**64],
    "unsigned": np.array([0, 1, 2**63 + 1], dtype=np.uint64),
    "byte": np.array([0, 1, 255], dtype=np.uint8),
    "fractional": [0, 1.5, 2],
    "float": np.array([0.0, 1.0, 2.0]),
    "nan": [0, float("nan"), 2],
    "bool": np.array([True, False, True]),
    "none": None,
    "none inside": [0, None, 2],
    "string": "012",
    "strings": ["0", "1", "2"],
    "nested": [[0, 1, 2]],
    "number": 5,
    "object": np.array([0, 1, "2"], dtype=object),
}


@pytest.mark.parametrize("case", BAD_MULTI)
def test_central_multi_actions(case: str, same: Any) -> None:
    """Central-v0 with one action per agent refuses bad ones, and nothing has moved."""
    env, twin = (
        gymnasium.make("mapp_env/Central-v0", central_action="multi", disable_env_checker=True)
        for _ in range(2)
    )
    for each in (env, twin):
        each.reset(seed=3)
    with pytest.raises(ValueError, match="action"):
        env.step(BAD_MULTI[case])
    same(env.step(np.array([0, 1, 3])), twin.step(np.array([0, 1, 3])))


GOOD_BATCH = [[0, 1, 2], [3, 2, 1]]
BAD_BATCHES: dict[str, Any] = {
    "one row short": [[0, 1, 2]],
    "one row more": [*GOOD_BATCH, [0, 0, 0]],
    "one agent short": [[0, 1], [3, 2]],
    "one agent more": [[0, 1, 2, 3], [3, 2, 1, 0]],
    "flat": [0, 1, 2, 3, 2, 1],
    "numbers": [5, 6],
    "transposed": np.array(GOOD_BATCH).T,
    "deeper": [GOOD_BATCH],
    "ragged": [[0, 1, 2], [3, 2]],
    "too large": [[0, 1, 2], [3, 2, 4]],
    "negative": [[0, 1, 2], [-1, 2, 1]],
    "wraps 32": np.array([[0, 1, 2], [3, 2, 2**32]]),
    "wraps 64": np.array([[0, 1, 2], [3, 2, 2**64 - 1]], dtype=np.uint64),
    "byte": np.array([[0, 1, 2], [3, 2, 255]], dtype=np.uint8),
    "small byte": np.array([[0, 1, 2], [3, 2, -128]], dtype=np.int8),
    "fractional": [[0, 1, 2], [3, 2.5, 1]],
    "float": np.array(GOOD_BATCH, dtype=np.float64),
    "nan": [[0, 1, 2], [3, float("nan"), 1]],
    "bool": np.array([[True, False, True], [False, True, True]]),
    "none": None,
    "none inside": [[0, 1, 2], [3, None, 1]],
    "strings": np.array([["0", "1", "2"], ["3", "2", "1"]]),
    "object": np.array([[0, 1, 2], [3, "2", 1]], dtype=object),
    "text": "abc",
    "dict": {"agent_0": 1},
}


@pytest.mark.parametrize("case", BAD_BATCHES)
def test_batched_actions(case: str, same: Any) -> None:
    """make_vec refuses wrong shapes, types and values, and no row has moved, not even good ones."""
    venv, twin = mapp_env.make_vec(2), mapp_env.make_vec(2)
    for each in (venv, twin):
        each.reset(seed=3)
        each.step(np.array(GOOD_BATCH))
    for _ in range(2):
        with pytest.raises(ValueError, match="action"):
            venv.step(BAD_BATCHES[case])
    same(venv.step(np.array(GOOD_BATCH)), twin.step(np.array(GOOD_BATCH)))


@pytest.mark.parametrize("allow_wait", [False, True])
def test_no_action_reaches_the_rules_unseen(allow_wait: bool, same: Any) -> None:
    """What steps the rules refuses bad actions itself, and nothing has moved: a face may err.

    The rules index a table with actions, so a negative one would be a segmentation fault.
    """
    task = Task(PAPER, allow_wait=allow_wait)
    simulations = [Simulation(task, 3) for _ in range(2)]
    batches = [Rows(task, 2, 1) for _ in range(2)]
    nobody = np.zeros(2, bool)
    for simulation in simulations:
        simulation.reset(NOTHING, np.random.default_rng(0))
    for rows in batches:
        rows.start(np.arange(2), Source(task).draw(np.array([1, 2], np.uint64)))
        rows.step(np.array([[0, 1, 2], [3, 2, 1]]), nobody)
    n_actions = 4 + allow_wait
    for bad in (n_actions, 8, 2**32, -1, -(2**63)):
        for place in range(3):
            actions = np.zeros((2, 3), np.int64)
            actions[1, place] = bad
            with pytest.raises(ValueError, match="actions must be in 0"):
                simulations[0].step(actions[1])
            with pytest.raises(ValueError, match="actions must be in 0"):
                batches[0].step(actions, nobody)
    for shape in ((2, 2), (2, 4), (1, 3), (3, 3)):
        with pytest.raises(ValueError, match="actions must be in 0"):
            batches[0].step(np.zeros(shape, np.int64), nobody)
    for count in (2, 4):
        with pytest.raises(ValueError, match="actions must hold"):
            simulations[0].step(np.zeros(count, np.int64))
    good = np.array([[0, 1, n_actions - 1], [3, 2, 1]])
    same(simulations[0].step(good[0]), simulations[1].step(good[0]))
    same(batches[0].step(good, nobody), batches[1].step(good, nobody))
    changed = good  # an array that was right once is looked at again
    changed[0, 0] = 8
    with pytest.raises(ValueError, match="actions must be in 0"):
        batches[0].step(changed, nobody)


def test_batched_message_names_the_value() -> None:
    """The message about a batch names an offending value and what is allowed."""
    venv = mapp_env.make_vec(2)
    venv.reset(seed=0)
    message = refusal("actions", 9, lambda: venv.step(np.array([[0, 1, 2], [3, 9, 1]])))
    assert "3" in message


@pytest.mark.parametrize(
    "landmarks",
    [
        np.array([[0, 6, 20, 42, 48]]),
        np.array([[0, 6, 20, 42, 48]] * 3),
        np.array([[0, 6, 20, 42, 48], [0, 6, 20, 42, 42]]),
        np.array([[0, 6, 20, 42, 48], [0, 6, 20, 42, 8]]),
        np.array([[0, 6, 20, 42, 48], [0, 6, 20, 42, 24]]),
        np.array([[0, 6, 20, 42, 48], [0, 6, 20, 42, 49]]),
        np.array([[0, 6, 20, 42, 48], [0, 6, 20, 42, -1]]),
        np.array([[0, 6, 20, 42, 48], [0, 6, 20, 42, 2**32 + 1]]),
        np.array([[0, 6, 20, 42], [0, 6, 20, 42]]),
        np.array([[0.0, 6, 20, 42, 48], [0, 6, 20, 42, 47.5]]),
        np.array([[0.0, 6, 20, 42, 48], [0, 6, 20, 42, 47]]),
        np.array([["0", "6", "20", "42", "48"]] * 2),
        np.array([[True, False, True, False, True]] * 2),
    ],
)
def test_batched_landmarks(landmarks: np.ndarray, same: Any) -> None:
    """Per-row landmarks of a wrong shape or breaking R2 in one row are refused, none is reset."""
    venv, twin = mapp_env.make_vec(2), mapp_env.make_vec(2)
    for each in (venv, twin):
        each.reset(seed=3)
    with pytest.raises(ValueError, match="landmark"):
        venv.reset(options={"landmarks": landmarks})
    same(venv.step(np.array(GOOD_BATCH)), twin.step(np.array(GOOD_BATCH)))


@pytest.mark.parametrize("shape", [(3, 5), (2, 4), (2, 5, 1), (1000, 5), (0, 5), (6,)], ids=repr)
@pytest.mark.parametrize("face", FACES)
def test_landmarks_of_a_wrong_shape(face: str, shape: tuple[int, ...]) -> None:
    """The message is one short line that says which shape was given, and what was wanted."""
    landmarks = np.ones(shape, int)
    with pytest.raises(ValueError, match=r"^options\['landmarks'\]") as caught:
        FACES[face]().reset(options={"landmarks": landmarks})
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 140
    if len(shape) > 1:
        assert f"shape {shape}" in message
        assert ("(2, 5)" if face == "vector" else "5 cells") in message


@pytest.mark.parametrize(
    "mask",
    [[True], np.array([True]), np.array([1, 0]), np.array([False, False]), "yes",
     np.array([[True, False]])],
    ids=repr,
)  # fmt: skip
def test_reset_masks(mask: Any, same: Any) -> None:
    """A reset_mask that is no boolean array of one flag per row is refused, nothing is reset.

    Gymnasium's own vector environment raises TypeError for a wrong type, so both are fine.
    """
    venv, twin = mapp_env.make_vec(2), mapp_env.make_vec(2)
    for each in (venv, twin):
        each.reset(seed=3)
    with pytest.raises((ValueError, TypeError), match="reset_mask"):
        venv.reset(options={"reset_mask": mask})
    same(venv.step(np.array(GOOD_BATCH)), twin.step(np.array(GOOD_BATCH)))


@pytest.mark.parametrize(
    "seed", [-1, 1.5, "0", True, [1], [1, 2, 3], [1, -1], [1, 0.5], float("nan")], ids=repr
)
def test_batched_seeds(seed: Any) -> None:
    """Seeds that are negative, no integers, or not one per row are refused."""
    with pytest.raises(ValueError, match="seed"):
        mapp_env.make_vec(2).reset(seed=seed)


@pytest.mark.parametrize("seed", [-1, 1.5, "0", True, [1], float("nan")], ids=repr)
@pytest.mark.parametrize("face", ["parallel", "aec", "central"])
def test_seeds(face: str, seed: Any) -> None:
    """The scalar faces refuse the same seeds; Gymnasium's own seed error counts as well."""
    env = FACES[face]()
    with pytest.raises((ValueError, gymnasium.error.Error), match=r"(?i)seed"):
        env.reset(seed=seed)


@pytest.mark.parametrize(
    "actions",
    [
        [[0, 1, 4]], [[0, 1, 5]], [[0, 1]], [0, 1, 2], [[0, 1.5, 2]], [[0, float("nan"), 2]],
        [[True, False, True]], [[0, -1, 2]], None, "abc", [[0, 1, 2**32]], [[0, None, 1]],
    ],
    ids=repr,
)  # fmt: skip
def test_replayed_actions(actions: Any) -> None:
    """Replaying refuses what is no list of joint actions; 4 (wait) alone is one without asking."""
    problem = mapp_env.Problem(PAPER, (0, 6), n_agents=3)
    if actions == [[0, 1, 4]]:
        assert mapp_env.replay(problem, actions).success is False
        return
    with pytest.raises(ValueError, match="action"):
        mapp_env.replay(problem, actions)
    with pytest.raises(ValueError, match="problem"):
        mapp_env.replay("paper-7x7", [[0, 1, 2]])  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [v for v in BAD_COUNTS if v != "3"], ids=repr)
def test_sampling_counts(value: Any) -> None:
    """sample_problems refuses the same counts, and more problems than there are."""
    refusal("n_problems", value, lambda: mapp_env.sample_problems(PAPER, value))
    refusal("n_landmarks", value, lambda: mapp_env.sample_problems(PAPER, 3, n_landmarks=value))


def test_sampling_more_than_there_are() -> None:
    """A grid with 3 problems gives 3, and refuses a fourth."""
    grid = mapp_env.Grid.from_text("D...\n")
    rows = mapp_env.sample_problems(grid, 3, n_landmarks=1)
    assert sorted(rows.ravel().tolist()) == [1, 2, 3]
    refusal("n_problems", 4, lambda: mapp_env.sample_problems(grid, 4, n_landmarks=1))


@pytest.mark.parametrize("value", [0, -1, 2.5, True, None, "9", 10**30], ids=repr)
@pytest.mark.parametrize("face", [*FACES, "tuple"])
def test_assigned_max_cycles(face: str, value: Any) -> None:
    """Assigning a bad max_cycles is refused and leaves the old one, on every face."""
    make = FACES.get(face, lambda **more: gymnasium.make("mapp_env/Tuple-v0", **more))
    env = make(max_cycles=12).unwrapped
    refusal("max_cycles", value, lambda: setattr(env, "max_cycles", value))
    assert env.max_cycles == 12


def test_stepping_without_an_episode() -> None:
    """Stepping before the first reset raises something that says so, on every face."""
    for face, action in (
        ("parallel", {"agent_0": 0, "agent_1": 0, "agent_2": 0}),
        ("central", 0),
        ("vector", np.zeros((2, 3), dtype=int)),
    ):
        with pytest.raises((ValueError, RuntimeError, gymnasium.error.ResetNeeded), match="reset"):
            FACES[face]().step(action)


BAD_TEXTS: dict[str, tuple[str, str]] = {
    # text, what the message has to contain
    "empty": ("", ""),
    "blank": ("\n\n", ""),
    "ragged": ("D..\n..\n...\n", "2"),
    "unknown letter": ("D..\n...\n.x.\n", "3"),
    "digit": ("D1.\n", "1"),
    "letter outside ASCII": ("D..\n.é.\n", "2"),
    "two depots in a row": ("...\n...\nD.D\n", "3"),
    "two depots side by side": ("...\n...\n.DD\n", "3"),
    "two depots": ("D..\n...\n..D\n", "3"),
    "walls only": ("###\n###\n", ""),
    "2049 wide": ("." * 2049 + "\n", "2049"),
    "2049 high": (".\n" * 2049, ":2049: has more than 2048 rows"),
    "null": ("D.\0\n", "1"),
    "inner blank line": ("D..\n\n...\n", "2"),
    "header lies about height": ("type octile\nheight 3\nwidth 3\nmap\n...\n...\n", "3"),
    "header lies about width": ("type octile\nheight 2\nwidth 4\nmap\n...\n...\n", "4"),
    "header is absurd": ("type octile\nheight 1000000000\nwidth 9\nmap\n...\n", "1000000000"),
    "header of 2049 rows": (
        "type octile\nheight 2049\nwidth 1\nmap\n" + ".\n" * 2049,
        ":4: height must be in 1..2048, got '2049'",
    ),
    "millions of lines": ("D." + "\n." * 4_000_000, ":2049: has more than 2048 rows"),
    "millions of words": ("type octile" + " x" * 4_000_000, ":1: expected a header line"),
    "header is negative": ("type octile\nheight -2\nwidth 3\nmap\n...\n...\n", "-2"),
    "header is no number": ("type octile\nheight two\nwidth 3\nmap\n...\n...\n", "two"),
    "header is fractional": ("type octile\nheight 2.0\nwidth 3\nmap\n...\n...\n", "2.0"),
    "header without map": ("type octile\nheight 2\nwidth 3\n", ""),
    "header without width": ("type octile\nheight 2\nmap\n...\n...\n", "width"),
    "header twice": ("type octile\nheight 2\nheight 2\nwidth 3\nmap\n...\n...\n", "height"),
    "blank first column": (" ..\n D.\n", ":1: column 1 is ' '"),
    "blank last column": (".. \nD. \n", ":1: column 3 is ' '"),
    "tabs in the last column": ("..\t\nD.\t", ":1: column 3 is '\\t'"),
    "blank first row": ("  \n..\nD.\n", ":1: column 1 is ' '"),
    "blank last row": ("..\nD.\n  ", ":3: column 1 is ' '"),
    "blank rows alone": ("  \n  \n", ":1: column 1 is ' '"),
    "blank rows below a header": (
        "type octile\nheight 2\nwidth 3\nmap\n   \n   \n",
        ":5: column 1 is ' '",
    ),
    "rows after the end": ("type octile\nheight 1\nwidth 3\nmap\n...\n...\n", ""),
}


@pytest.mark.parametrize("case", BAD_TEXTS)
def test_malformed_maps(case: str, tmp_path: Path) -> None:
    """A malformed map is refused; the message names line and, for files, path."""
    text, hint = BAD_TEXTS[case]
    path = tmp_path / "bad one.map"
    path.write_text(text, encoding="utf-8")
    calls: list[tuple[Callable[[], Any], str]] = [
        (lambda: mapp_env.Grid.from_text(text), hint),
        (lambda: mapp_env.Grid.load(path), hint),
        (lambda: mapp_env.Grid.load(str(path)), "bad one.map"),
        (lambda: mapp_v0.parallel_env(grid=str(path)), "bad one.map"),
    ]
    for call, wanted in calls:
        with pytest.raises(ValueError) as caught:  # noqa: PT011
            call()
        assert wanted in str(caught.value)
        if case in ("ragged", "unknown letter", "inner blank line") or case.startswith(
            "two depots"
        ):
            assert re.search(rf":{hint}:|\bline {hint}\b", str(caught.value))
        assert len(str(caught.value)) < 600


READ_TEXTS: dict[str, str] = {
    "as it is": "..#\nD..",
    "line break at the end": "..#\nD..\n",
    "empty lines at both ends": "\n\n..#\nD..\n\n\n",
    "line breaks of Windows": "..#\r\nD..\r\n",
    "line breaks of old": "..#\rD..",
    "byte order mark": "\ufeff..#\nD..\n",
    "byte order mark before a header": "\ufefftype octile\nheight 2\nwidth 3\nmap\n..#\nD..\n",
    "blanks after a row": "..#  \nD..\n",
    "a tab after a row": "..#\nD..\t",
    "header in another order": "type tile\nwidth 3\nheight 2\nmap\n..@\nDGG",
}


@pytest.mark.parametrize("case", READ_TEXTS)
def test_maps_that_are_read(case: str, tmp_path: Path) -> None:
    """What editors leave in a text is no fault, given as a string or in a file."""
    grid = mapp_env.Grid([[False, False, True], [False] * 3], depot=3)
    assert mapp_env.Grid.from_text(READ_TEXTS[case]) == grid
    (tmp_path / "a.map").write_bytes(READ_TEXTS[case].encode("utf-8"))
    assert mapp_env.Grid.load(tmp_path / "a.map") == grid


@pytest.mark.parametrize(
    ("header", "free", "walls"),
    [("", ".G", "#@TO"), ("type octile\nheight 1\nwidth 3\nmap\n", ".GSE", "#@TOW")],
    ids=["plain", "MovingAI"],
)
def test_every_letter_of_a_map(header: str, free: str, walls: str) -> None:
    """Water is a wall, swamps and stations are free; no other letter, but a depot's, is a cell."""
    for letter in map(chr, range(33, 127)):
        if letter in free + walls:
            grid = mapp_env.Grid.from_text(f"{header}D.{letter}")
            assert grid.walls.tolist() == [[False, False, letter in walls]], letter
        else:
            with pytest.raises(mapp_env.MapError):
                mapp_env.Grid.from_text(f"{header}D.{letter}")


def test_a_text_is_indented_like_the_code_around_it(tmp_path: Path) -> None:
    """A string that starts with a line break may be indented; a file, and other strings, not."""
    text = """
        ..#
        D..
    """
    assert mapp_env.Grid.from_text(text).to_text() == "..#\nD.."
    (tmp_path / "a.map").write_text(text)
    for call in (
        lambda: mapp_env.Grid.load(tmp_path / "a.map"),
        lambda: mapp_env.Grid.from_text(text[1:]),
        lambda: mapp_env.Grid.from_text("\n  ..#\n D..\n"),
    ):
        with pytest.raises(ValueError, match=r":[12]: column 1 is ' '"):
            call()


@pytest.mark.parametrize(("encoding", "named"), [
    ("utf-16", "UTF-16's byte order mark"), ("latin-1", "the byte 0xe9"),
])  # fmt: skip
def test_other_encodings_are_named(encoding: str, named: str, tmp_path: Path) -> None:
    """A map file in another encoding is refused, and the message says why."""
    (tmp_path / "a.map").write_bytes("D.\xe9".encode(encoding))
    with pytest.raises(mapp_env.MapError, match=rf"a\.map:1: holds {named}"):
        mapp_env.Grid.load(tmp_path / "a.map")


@pytest.mark.parametrize("value", [None, 5, b"D..\n", ["D.."]], ids=repr)
def test_texts_that_are_no_text(value: Any) -> None:
    """Grid.from_text refuses what is no string."""
    with pytest.raises(ValueError, match="text"):
        mapp_env.Grid.from_text(value)


@pytest.mark.parametrize("depot", [1, 49, -1, 2.5, True, "D", (9, 9), (0,), float("nan")], ids=repr)
def test_depots(depot: Any) -> None:
    """A depot on a wall, off the grid or no cell is refused."""
    text = "\n".join([".#....."] + ["......."] * 6) + "\n"
    with pytest.raises(ValueError, match="depot"):
        mapp_env.Grid.from_text(text, depot=depot)


NASTY = """
import json, os, sys
import resource
resource.setrlimit(resource.RLIMIT_AS, (3 * 2**30, 3 * 2**30))
import mapp_env
from mapp_env import mapp_v0
from mapp_env.engine.task import Task
results = {}
for path in sys.argv[1:]:
    for call in (mapp_env.Grid.load, lambda p: mapp_v0.parallel_env(grid=p)):
        try:
            call(path)
            kind, message = "nothing", ""
        except Exception as error:
            kind = "ValueError" if isinstance(error, ValueError) else repr(error)
            message = str(error)
        results.setdefault(path, []).append([kind, message])
print(json.dumps(results))
"""


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs POSIX")
def test_nasty_files(tmp_path: Path) -> None:
    """Pipes, devices, folders, 10 GB files and binaries: ValueError with the path.

    They are opened in a process of their own, which a reader that blocks or swallows memory
    would hang or kill.
    """
    os.mkfifo(tmp_path / "pipe.map")
    with open(tmp_path / "huge.map", "wb") as huge:
        huge.write(b"D..\n")
        huge.truncate(10 * 2**30)
    (tmp_path / "folder.map").mkdir()
    (tmp_path / "binary.map").write_bytes(bytes(range(256)) * 8)
    (tmp_path / "utf16.map").write_bytes("D..\n".encode("utf-16"))
    (tmp_path / "one-line.map").write_bytes(b"." * 8_000_000)
    (tmp_path / "link.map").symlink_to("/dev/zero")
    (tmp_path / "loop.map").symlink_to(tmp_path / "loop.map")
    names = sorted(str(path) for path in tmp_path.iterdir())
    paths = [*names, "/dev/zero", str(tmp_path / "absent.map"), str(tmp_path / "bad\n.map")]
    done = subprocess.run(
        [sys.executable, "-c", NASTY, *paths],
        capture_output=True,
        text=True,
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    results = json.loads(done.stdout)
    assert len(results) == 11
    faults = [
        (path, kind, message)
        for path, attempts in results.items()
        for kind, message in attempts
        if kind != "ValueError"
        or not (Path(path).name in message or repr(path)[1:-1] in message)
        or len(message) >= 600
    ]
    assert faults == []


def test_null_in_a_path() -> None:
    """A path with a null byte is a ValueError too, and so is a path that is none."""
    with pytest.raises(ValueError, match="x"):
        mapp_env.Grid.load("x\0.map")
    with pytest.raises(ValueError, match="path"):
        mapp_env.Grid.load(5)  # type: ignore[arg-type]


def test_unknown_argument() -> None:
    """A misspelt argument is refused by name, not swallowed."""
    for make in FACES.values():
        with pytest.raises(TypeError, match="n_agent"):
            make(n_agent=3)


@pytest.mark.parametrize(
    "slip",
    [
        "mapp_env.parallel_env()",
        "mapp_env.parallel_env(n_agents=2)",
        "mapp_env.env()",
        "mapp_env.raw_env()",
        "mapp_env.mapp_v0()",
        "mapp_env.central_env()",
        "mapp_env.vector_env(4)",
    ],
)
def test_what_is_not_an_environment_says_what_makes_one(slip: str) -> None:
    """Whoever looks for an environment at the top of the package is told what to write, and can."""
    names = {"mapp_env": mapp_env, "gymnasium": gymnasium, "num_envs": 4}
    with pytest.raises((AttributeError, TypeError)) as caught:
        eval(slip, names)
    said = re.fullmatch(r".*mapp_env.*: an environment is made by (.*)", str(caught.value))
    assert said is not None, str(caught.value)
    eval(said[1], names).close()
    with pytest.raises(AttributeError, match=r"module 'mapp_env' has no attribute 'maps'$"):
        _ = mapp_env.maps


@pytest.mark.parametrize("face", ["parallel", "central", "tuple", "vector"])
def test_a_refused_reset_changes_nothing(face: str) -> None:
    """After a reset whose options are refused, seed and all, the next is as if it had not been."""
    makers = {**FACES, "tuple": lambda: gymnasium.make("mapp_env/Tuple-v0")}
    env, twin = (makers[face]() for _ in range(2))
    for each in (env, twin):
        each.reset(seed=1)
    for options in ({"landmarks": [24, 0, 1, 2, 3]}, {"problem": 3}, 5):
        with pytest.raises(ValueError, match="options"):
            env.reset(seed=2, options=options)
    for _ in range(2):
        seen, expected = env.reset()[0], twin.reset()[0]
        if face == "parallel":
            seen, expected = seen["agent_0"], expected["agent_0"]
        assert np.array_equal(seen, expected)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_refused_step_of_a_batch_changes_nothing(mode: str) -> None:
    """After actions that are refused, also when rows have ended, the batch goes on as without."""
    envs, twin = (
        mapp_env.make_vec(3, max_cycles=2, autoreset_mode=mode, render_mode="ansi")
        for _ in range(2)
    )
    for each in (envs, twin):
        each.reset(seed=1)
    actions = np.ones((3, 3), np.int64)
    for step in range(2 if mode == "Disabled" else 5):
        before = envs.render()
        with pytest.raises(ValueError, match="actions"):
            envs.step(actions + 3)
        assert envs.render() == before
        results = [each.step((actions + step) % 4)[:4] for each in (envs, twin)]
        assert all(map(np.array_equal, *results))


def test_rows_of_a_map_begin_below_one_another() -> None:
    """Indentation that all rows share is none; a row that begins elsewhere is refused."""
    assert mapp_env.Grid.from_text("\n   D.\n   ..\n").walls.shape == (2, 2)
    for text in ("  D.\n ..\n", " D.\n  ..\n", "D.\n  ..\n"):
        with pytest.raises(ValueError, match="text:"):
            mapp_env.Grid.from_text(text)


def test_grids_of_other_depots_are_others() -> None:
    """Walls alone make no grid: with another depot it is unequal, and its problems are refused."""
    here, there = (mapp_env.Grid(np.zeros((3, 3), bool), depot) for depot in (0, 8))
    assert here != there
    assert mapp_env.Problem(here, (4,)) != mapp_env.Problem(there, (4,))
    env = mapp_v0.parallel_env(grid=here, n_landmarks=1)
    with pytest.raises(ValueError, match=r"options\['problem'\]"):
        env.reset(options={"problem": mapp_env.Problem(there, (4,))})


def test_a_cell_twice_in_a_row_of_a_batch() -> None:
    """Landmarks of each row are distinct, wherever in the row the same cell stands again."""
    envs = mapp_env.make_vec(2, n_landmarks=3)
    for row in ([6, 6, 0], [6, 0, 6], [0, 6, 6]):
        with pytest.raises(ValueError, match=r"options\['landmarks'\]\[1\]"):
            envs.reset(options={"landmarks": np.array([[0, 1, 2], row])})


def test_no_step_before_the_first_reset() -> None:
    """Without an episode there is none to step, not even with no actions; after one, nothing is."""
    env = mapp_v0.parallel_env(max_cycles=1)
    for actions in ({}, {"agent_0": 0}):
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(actions)
    env.reset(seed=0)
    env.step(dict.fromkeys(env.agents, 0))
    assert env.step({}) == ({}, {}, {}, {}, {})


def test_nothing_is_reached_from_a_wall() -> None:
    """Distances from a wall are -1 to every cell, the wall itself included."""
    grid = mapp_env.Grid.from_text("D#.\n...")
    assert grid.distances_from([1]).tolist() == [[-1] * 6]
    assert grid.distances_from([0, 1])[0].tolist() == [0, -1, 4, 1, 2, 3]
    assert grid.distances[1].tolist() == [-1] * 6


@pytest.mark.parametrize("face", FACES)
def test_a_reset_takes_one_wish(face: str) -> None:
    """A problem and landmarks at once are refused, also if they say the same."""
    env = FACES[face]()
    cells = (0, 6, 20, 42, 48)
    options = {"problem": mapp_env.Problem(PAPER, cells), "landmarks": cells}
    with pytest.raises(ValueError, match="'problem' or 'landmarks', got both"):
        env.reset(seed=0, options=options)


@pytest.mark.parametrize("pair", [(0, -1), (1, -1), (1, -7), (-1, 0), (7, 0), (0, 7), (3, 10**9)])
def test_pairs_beside_the_grid(pair: tuple[int, int]) -> None:
    """A row or column beside the grid is no cell, and means none of a neighbouring row."""
    with pytest.raises(ValueError, match=r"landmarks\[0\] must be a cell .* within 7 x 7"):
        mapp_env.Problem(PAPER, [pair])
    with pytest.raises(ValueError, match="depot must be a cell"):
        mapp_env.Grid(PAPER.walls, pair)
