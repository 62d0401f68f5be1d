"""The command evaluate, and what policies see in commands."""

from __future__ import annotations

import json
import re
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import mapp_env
from mapp_env.commands import evaluate as command
from mapp_env.commands import main
from mapp_env.engine.observation import Observation
from mapp_env.solvers import regrets

REPOSITORY = Path(__file__).resolve().parents[2]
PAPER = mapp_env.make_grid()
LANDMARKS = (0, 6, 20, 42, 48)
CELLS = [str(cell) for cell in LANDMARKS]

seen: list[tuple[int, ...]] = []


class Looking:
    """Notes the shape of what it sees, and walks by what there is; its name is N."""

    def __init__(self, name: str) -> None:
        self.n_agents = int(name)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return (B, N) actions."""
        seen.append(observations.shape)
        total = np.floor(97 * np.abs(observations.astype(float))).sum(
            axis=tuple(range(1, observations.ndim))
        )
        return (total[:, None].astype(int) + np.arange(self.n_agents)) % 4


@pytest.fixture
def loader(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """Return the name of a loader of policies; the test runs in an empty folder."""
    monkeypatch.chdir(tmp_path)
    seen.clear()
    module = types.ModuleType("lookers")
    module.load = Looking  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "lookers", module)
    return "lookers:load"


def record(capsys: pytest.CaptureFixture[str], *words: str) -> Any:
    """Return the one JSON object that a command prints."""
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("kind", [each.name.lower() for each in Observation])
def test_policies_see_any_observation(
    capsys: pytest.CaptureFixture[str], loader: str, kind: str
) -> None:
    """Evaluated and rendered, a policy is given what the batched environment gives, of any kind."""
    policy = ["--policy", "2", "--policy-loader", loader, "--observation", kind, "--n-agents", "2"]
    wanted = mapp_env.make_vec(1, n_agents=2, observation=kind).single_observation_space.shape
    record(capsys, "evaluate", *policy, "--n-problems", "7", "--max-cycles", "3")
    assert seen == [(7, *wanted)] * 3
    seen.clear()
    found = record(
        capsys, "render", *policy, "--landmarks", *CELLS, "--max-cycles", "4", "--out", "a.gif"
    )
    assert set(seen) == {(1, *wanted)}
    problem = mapp_env.Problem(PAPER, LANDMARKS, 2)
    judged = mapp_env.evaluate(Looking("2"), [problem], observation=kind, max_cycles=4)
    assert found["success"] == judged["solved"][0]


def test_the_command_is_the_function(capsys: pytest.CaptureFixture[str], loader: str) -> None:
    """JSON holds every result of evaluate() on the problems drawn, and their means."""
    options = ["--policy", "3", "--policy-loader", loader, "--seed", "4", "--max-cycles", "60"]
    found = record(capsys, "evaluate", *options, "--n-landmarks", "2", "--n-problems", "40")
    rows = mapp_env.sample_problems(PAPER, 40, n_landmarks=2, seed=4)
    expected = mapp_env.evaluate(Looking("3"), rows, grid=PAPER, max_cycles=60)
    assert found["n_problems"] == 40
    assert 0 < found["solved"] == expected["solved"].mean() < 1
    assert found["problems"].keys() == expected.keys()
    for name, values in expected.items():
        listed = [value if np.isfinite(value) else None for value in values.tolist()]
        assert found["problems"][name] == listed, name
    mean = np.nanmean(expected["gap"])
    assert found["gap"] == pytest.approx(mean)
    assert main(["evaluate", *options, "--n-landmarks", "2", "--n-problems", "40"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("40 problems of 2 landmarks and 3 agents, 1 grid\nsolved ")
    assert f"gap {100 * mean:.2f} %" in text
    worst = int(np.nanargmax(expected["gap"]))
    assert f"problem {worst}, cover time {expected['cost'][worst]:.0f}, optimum" in text
    first = int((~expected["solved"]).argmax())
    cells = " ".join(map(str, rows[first]))
    assert f"the first is problem {first}: landmarks {cells}" in text
    assert "steps a decision: first decision " in text


def test_what_agents_do_is_chosen(capsys: pytest.CaptureFixture[str], loader: str) -> None:
    """Landmarks to walk towards, waiting and walking home are the environment's; home: makespan."""
    policy = ["--policy", "3", "--policy-loader", loader, "--n-problems", "5"]
    rows = mapp_env.sample_problems(PAPER, 5)
    for words, options in (
        (["--actions", "landmarks"], {"actions": "landmarks"}),
        (["--allow-wait"], {"allow_wait": True}),
        (["--return-home"], {"return_home": True}),
    ):
        found = record(capsys, "evaluate", *policy, *words)
        expected = mapp_env.evaluate(Looking("3"), rows, grid=PAPER, **options)
        assert found["problems"]["steps"] == expected["steps"].tolist()
        assert found["problems"]["optimum"] == expected["optimum"].tolist()
        assert found["objective"] == ("makespan" if "return_home" in options else "cover_time")
    render = ["render", "--policy", "3", "--policy-loader", loader, "--landmarks", *CELLS]
    found = record(capsys, *render, "--actions", "landmarks", "--out", "a.gif")
    problem = mapp_env.Problem(PAPER, LANDMARKS, max_cycles=50)
    judged = mapp_env.evaluate(Looking("3"), [problem], actions="landmarks")
    assert found["success"] == judged["solved"][0]


def test_a_folder_of_problems_is_judged(
    capsys: pytest.CaptureFixture[str], loader: str, tmp_path: Path
) -> None:
    """Files of other grids, numbers and starts: by name, each as it is."""
    given = [
        mapp_env.Problem(mapp_env.make_grid("rooms", rows=9, cols=9, seed=1), [0], 2),
        mapp_env.Problem(PAPER, LANDMARKS[:3], 2, max_cycles=5, starts=(48, 24)),
        mapp_env.Problem(PAPER, LANDMARKS, 2),
    ]
    (tmp_path / "some").mkdir()
    for index, problem in enumerate(given):
        problem.save(tmp_path / "some" / f"{index}.json")
    policy = ["--policy", "2", "--policy-loader", loader, "--observation", "geodesic"]
    found = record(capsys, "evaluate", *policy, "--problems", "some")
    expected = mapp_env.evaluate(Looking("2"), given, observation="geodesic")
    assert found["problems"]["steps"] == expected["steps"].tolist()
    assert found["problems"]["optimum"] == expected["optimum"].tolist()
    assert main(["evaluate", *policy, "--problems", "some"]) == 0
    assert "3 problems of 1 to 5 landmarks and 2 agents, 2 grids" in capsys.readouterr().out
    alone = record(capsys, "evaluate", *policy, "--problem", "some/1.json")
    assert alone["problems"]["steps"] == [5]


def test_beyond_proven_optima_there_is_a_bound(
    capsys: pytest.CaptureFixture[str], loader: str
) -> None:
    """Of many landmarks the line says what every plan costs at least; nothing is made up."""
    (Path("line.txt")).write_text("D" + 25 * "." + "\n", encoding="ascii")
    policy = ["--policy", "1", "--policy-loader", loader, "--n-agents", "1", "--grid", "line.txt"]
    cells = list(map(str, range(1, 23)))
    found = record(capsys, "evaluate", *policy, "--landmarks", *cells, "--max-cycles", "5")
    assert (found["cost"], found["gap"], found["regret"]) == (None, None, None)
    assert found["problems"]["bound"] == [22]
    assert found["problems"]["optimum"] == [None]


def test_the_pretrained_policy_is_judged(capsys: pytest.CaptureFixture[str], loader: str) -> None:
    """By default the baselines' policy plays 100 problems: solved, and next to no regret."""
    found = record(capsys, "evaluate", "--policy", "pretrained")
    assert (found["n_problems"], found["solved"]) == (100, 1.0)
    assert 0 <= found["gap"] < 0.05
    assert 0 <= found["regret"] < 0.05


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("evaluate", "--policy"),
        ("evaluate --policy 3 --observation smell", "--observation"),
        ("evaluate --policy 3 --problems nowhere", "problems: .*nowhere"),
        ("evaluate --policy 3 --problems some --n-problems 3", "--n-problems does not go with a f"),
        ("evaluate --policy 3 --problems some --grid rooms", "--grid does not go with a folder"),
        ("evaluate --policy 3 --problems some --seed 1", "--seed does not go with a folder"),
        ("evaluate --policy 3 --landmarks 1 --n-problems 3", "--n-problems is how many to draw"),
        ("evaluate --policy 3 --n-problems 0", "--n-problems must be an integer"),
        ("evaluate --policy 3 --n-problems 900000", "--n-problems must be at most 658008"),
        ("evaluate --policy 3 --starts 1 2 3", "--starts is for a problem that is given"),
        (
            "evaluate --policy 2 --n-agents 3",
            r"--policy must act with integers of shape \(100, 3\)",
        ),
        ("evaluate --policy 3 --max-cycles 0", "--max-cycles must be"),
        ("render --out a.gif --observation geodesic", "--observation is for --policy"),
        ("render --out a.gif --allow-wait", "--allow-wait is for --policy"),
        ("evaluate --policy 3 --actions landmarks --allow-wait", "allow-wait must be False"),
        ("render --out a.gif --show-regret --n-landmarks 21", "--show-regret is for up to 20 land"),
    ],
)
def test_refusals_are_one_line(
    capsys: pytest.CaptureFixture[str], loader: str, line: str, said: str
) -> None:
    """What cannot be judged gives exit status 2 and one line that names the option."""
    words = [*line.split(), *(["--policy-loader", loader] if "--policy " in line else [])]
    try:
        status = main(words)
    except SystemExit as leaving:
        status = int(leaving.code or 0)
    streams = capsys.readouterr()
    assert (status, streams.out) == (2, "")
    assert re.fullmatch(rf"error: [^\n]*({said})[^\n]*\n", streams.err), streams.err
    assert not Path("a.gif").exists()


def test_helps_examples_are_accepted(capsys: pytest.CaptureFixture[str], loader: str) -> None:
    """The examples of the help run, with a loader of that name."""
    lines = re.findall(r"^ *python -m mapp_env (.*)$", command.__doc__ or "", re.MULTILINE)
    assert len(lines) == 4
    Path("problems").mkdir()
    mapp_env.Problem(PAPER, LANDMARKS).save("problems/a.json")
    Path("mine.py").write_text(
        "import numpy\n"
        "class load:\n"
        "    def __init__(self, name): self.name = name\n"
        "    def act(self, seen): return numpy.ones((len(seen), 3), int)\n",
        encoding="ascii",
    )
    for line in lines:
        assert main(line.split()) == 0, line
        assert "solved" in capsys.readouterr().out


# -- lost steps in pictures --------------------------------------------------------------------


@pytest.mark.parametrize("out", ["a.gif", "a.png"])
def test_pictures_mark_lost_steps(
    capsys: pytest.CaptureFixture[str], loader: str, out: str
) -> None:
    """--show-regret tells which steps lost how much, as the solver says, and marks them."""
    options = ["render", "--policy", "3", "--policy-loader", loader, "--landmarks", *CELLS]
    options += ["--max-cycles", "12", "--out", out]
    plain = record(capsys, *options)
    with Image.open(out) as image:
        image.seek(getattr(image, "n_frames", 1) - 1)
        before = np.array(image.convert("RGB"))
    marked = record(capsys, *options, "--show-regret")
    assert {**plain, "bytes": 0} == {
        name: value for name, value in {**marked, "bytes": 0}.items() if name != "regrets"
    }
    problem = mapp_env.Problem(PAPER, LANDMARKS)
    moves = []
    mapp_env.evaluate(
        lambda given: moves.append(Looking("3").act(given)) or moves[-1], [problem], max_cycles=12
    )
    lost = regrets(problem, np.concatenate(moves))
    assert marked["regrets"] == lost.tolist()
    assert lost.any()
    with Image.open(out) as image:
        image.seek(getattr(image, "n_frames", 1) - 1)
        after = np.array(image.convert("RGB"))
    assert before.shape != after.shape or (before != after).any()
    assert main([*options, "--show-regret"]) == 0
    steps = ", ".join(f"{step + 1} ({lost[step]})" for step in np.flatnonzero(lost))
    assert f"steps lost: {lost.sum()}, by step: {steps}\n" in capsys.readouterr().out


def test_an_optimum_loses_nothing(capsys: pytest.CaptureFixture[str], loader: str) -> None:
    """The solver's own plan, drawn so, says that no step lost any."""
    assert main(["render", "--landmarks", *CELLS, "--out", "a.png", "--show-regret"]) == 0
    assert "steps lost: 0, by step: none" in capsys.readouterr().out
