"""The comparison: it trains what is missing, resumes what was stopped, and adds up right."""

import csv
import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from filelock import FileLock
from scipy import stats

from baselines import compare, independent_dqn, meta_dqn
from baselines.compare import Args
from baselines.learning import study, summary
from baselines.learning.config import parse_options
from baselines.learning.summary import MEASURES, Interval, format_interval, interval
from baselines.learning.training import Training
from baselines.policies import figures

WORDS = [
    *("--n-problems", "1", "--episodes-per-problem", "4", "--max-cycles", "15"),
    *("--learning-starts", "10", "--update-interval", "5", "--batch-size", "8"),
    *("--hidden-units", "8", "--evaluation-problems", "30", "--checkpoint-seconds", "0"),
]


def tiny(out, **changes):
    chosen = {"presets": ("paper",), "learners": ("meta", "shared"), "seeds": 2, "jobs": 2}
    return Args(out=out, **{**chosen, **changes})


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Keep to one thread, also for what comes after."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Return the folder of a tiny comparison, one of whose runs had been stopped half-way."""
    out = tmp_path_factory.mktemp("compared")
    stopped = out / "paper-shared-seed1"
    words = ["--preset", "paper", "--seed", "1", "--share-parameters", "--no-prefetch", *WORDS]
    options = parse_options(independent_dqn.Args, "", [*words, "--out", str(stopped)])
    advance, calls = Training.advance, []

    def interrupted(self):
        calls.append(None)
        if len(calls) == 40:
            os.kill(os.getpid(), signal.SIGTERM)
        return advance(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Training, "advance", interrupted)
        assert independent_dqn.main(options) == 128 + signal.SIGTERM
    # And one was killed before it had written what it is.
    begun = out / "paper-meta-seed1"
    begun.mkdir()
    (begun / "metrics.csv").write_text("episode\n")
    (begun / ".lock").touch()
    assert compare.main(tiny(out), WORDS) == 0
    return out


def test_finished_runs_are_not_repeated(compared, monkeypatch, capsys):
    """The second call starts no process and writes the same tables."""
    names = ("comparison.csv", "comparison.md")
    before = [(compared / name).read_bytes() for name in names]

    def refuse(*arguments, **options):
        raise AssertionError("a process was started")

    monkeypatch.setattr(study.subprocess, "Popen", refuse)
    assert compare.main(tiny(compared), WORDS) == 0
    assert "4 of 4 trainings were finished already" in capsys.readouterr().out
    assert [(compared / name).read_bytes() for name in names] == before
    assert (compared / "comparison.png").stat().st_size > 10_000


def test_stopped_run_is_resumed(compared, tmp_path):
    """It went on from its checkpoint, and ended as if it had never been stopped."""
    log = (compared / "paper-shared-seed1.log").read_text()
    assert "going on from episode" in log
    assert "going on" not in (compared / "paper-shared-seed0.log").read_text()
    words = ["--preset", "paper", "--seed", "1", "--share-parameters", "--no-prefetch", *WORDS]
    whole = parse_options(independent_dqn.Args, "", [*words, "--out", str(tmp_path / "whole")])
    assert independent_dqn.main(whole) == 0
    for name in ("metrics.csv", "policy.safetensors", "evaluation.csv"):
        resumed = compared / "paper-shared-seed1" / name
        assert resumed.read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_numbers_are_those_of_the_runs(compared):
    """The table's means are the interquartile means of what the runs wrote down."""
    with (compared / "comparison.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["preset"], row["learner"]) for row in rows] == [
        ("paper", "meta"),
        ("paper", "shared"),
    ]
    for row in rows:
        solved, steps, returns = [], [], []
        for seed in range(2):
            folder = compared / f"paper-{row['learner']}-seed{seed}"
            with (folder / "evaluation.csv").open() as file:
                alone = next(r for r in csv.DictReader(file) if r["policy"] == "network alone")
            solved.append(float(alone["solved %"]))
            steps.append(float(alone["unsolved = 15"]))
            with (folder / "metrics.csv").open() as file:
                returns.append(np.mean([float(r["reward"]) for r in csv.DictReader(file)]))
        # Of two values nothing is cut off.
        assert float(row["solved % IQM"]) == pytest.approx(np.mean(solved))
        assert float(row["cover time IQM"]) == pytest.approx(np.mean(steps))
        assert float(row["return IQM"]) == pytest.approx(np.mean(returns))
        assert int(row["return n"]) == int(row["seeds"]) == 2
        for name in ("solved %", "cover time", "return"):
            low, mean, high = (float(row[f"{name} {part}"]) for part in ("low", "IQM", "high"))
            assert low <= mean + 1e-9
            assert mean <= high + 1e-9
    table = (compared / "comparison.md").read_text().splitlines()
    assert len(table) == 4
    assert all(len(line.split("|")) == 3 + len(MEASURES) + 2 for line in table)


def test_other_options_are_not_compared_with_these(compared):
    """A folder with runs of other options is refused by the option's name, and left alone."""
    words = [*WORDS, "--discount", "0.5"]
    with pytest.raises(ValueError, match=r"paper-meta-seed0 holds another training: discount"):
        compare.main(tiny(compared), words)
    with pytest.raises(ValueError, match="set for each training"):
        compare.main(tiny(compared), ["--seed", "3"])
    default = tiny(compared, presets=("default",))
    with pytest.raises(ValueError, match="--updates-per-episode: set for each training"):
        compare.main(default, ["--updates-per-episode", "3"])
    with pytest.raises(ValueError, match="evaluation_problems must be at least 1"):
        compare.main(tiny(compared), [*WORDS, "--evaluation-problems", "0"])


def test_what_is_no_run_is_left_alone(tmp_path):
    """A folder of that name with something else in it is neither used nor cleared."""
    other = tmp_path / "paper-meta-seed0"
    other.mkdir()
    (other / "thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match=r"holds something else: thesis\.tex"):
        compare.main(tiny(tmp_path), WORDS)
    assert (other / "thesis.tex").read_text() == "years of work"


def test_what_another_is_about_to_train_is_left_alone(tmp_path):
    """A folder whose lock is held is not cleared, however little is in it so far."""
    begun = tmp_path / "paper-meta-seed0"
    begun.mkdir()
    (begun / "metrics.csv").write_text("episode\n")
    with FileLock(begun / ".lock"), pytest.raises(ValueError, match="another training is writing"):
        compare.main(tiny(tmp_path), WORDS)
    assert (begun / "metrics.csv").exists()


def test_updates_of_the_default_preset_can_be_fewer(tmp_path):
    """They are set for that preset alone."""
    args = tiny(tmp_path, presets=("default", "paper"), default_updates=7)
    runs = args.plan([])
    updates = {run.group[0]: run.options.updates_per_episode for run in runs}
    assert updates == {"default": 7, "paper": 0}
    with pytest.raises(ValueError, match=r"default_updates has no effect with presets .*paper"):
        tiny(tmp_path, default_updates=7)


def test_options_without_effect_in_a_training_are_refused(tmp_path):
    """Every training takes what is handed to all: else by the name of both options, beforehand."""
    with pytest.raises(ValueError, match="tried_actions has no effect with replay 'stored'"):
        compare.main(tiny(tmp_path), [*WORDS, "--tried-actions", "4"])
    assert not any(tmp_path.iterdir())


def test_failed_training_is_reported(tmp_path, monkeypatch):
    """What a training said last is said again, with its name.

    It is one's own training: none of its modules is looked for in the working folder.
    """
    (tmp_path / "torch.py").write_text("raise SystemExit('not the library')\n")
    monkeypatch.chdir(tmp_path)
    words = [*WORDS, "--n-landmarks", "60"]
    args = tiny(tmp_path / "study", learners=("meta",), seeds=1)
    with pytest.raises(ValueError, match=r"failed: paper-meta-seed0: error: .*landmarks"):
        compare.main(args, words)
    assert not (tmp_path / "study" / "comparison.md").exists()


def test_a_signal_stops_all_trainings(tmp_path, monkeypatch, capsys):
    """Exit code 143, no process left behind, and the comparison can go on."""
    started, start = [], study.Run.start

    def starting(run):
        process = start(run)
        started.append(process)
        os.kill(os.getpid(), signal.SIGTERM)
        return process

    monkeypatch.setattr(study.Run, "start", starting)
    assert compare.main(tiny(tmp_path, learners=("meta",)), WORDS) == 128 + signal.SIGTERM
    assert len(started) == 1
    assert started[0].returncode is not None
    assert "the same command goes on" in capsys.readouterr().out
    # Whatever state it was stopped in is one that a later call takes up.
    tiny(tmp_path, learners=("meta",)).plan(WORDS)
    shutil.rmtree(tmp_path)


# -- statistics --------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [2, 5, 10])
def test_interval_contains_the_mean(n):
    """The interquartile mean is SciPy's, lies in its interval, and comes out the same again."""
    values = np.random.default_rng(n).normal(size=n)
    found = interval(values)
    assert found.mean == stats.trim_mean(values, 0.25)
    assert found.low <= found.mean <= found.high
    assert found.n == n
    assert interval(values) == found
    curves = interval(np.random.default_rng(n).normal(size=(n, 30)))
    assert curves.mean.shape == curves.low.shape == (30,)
    assert (curves.low <= curves.mean).all()
    assert (curves.mean <= curves.high).all()


def test_interval_covers_as_it_should():
    """Of many samples of 20 from a known distribution about 95 % of the intervals cover it."""
    rng = np.random.default_rng(0)
    covered = [(f := interval(rng.normal(size=20))).low <= 0.0 <= f.high for _ in range(60)]
    assert 0.8 < np.mean(covered) <= 1.0


def test_few_values_have_no_interval():
    """One value has a mean and no interval, none has neither, equal ones have a point."""
    assert interval(np.array([3.0])).mean == 3.0
    assert np.isnan(interval(np.array([3.0])).low)
    assert np.isnan(interval(np.array([])).mean)
    assert interval(np.full(5, 2.0))[:3] == (2.0, 2.0, 2.0)
    assert format_interval(interval(np.array([])), 5) == "-"
    assert format_interval(interval(np.array([3.0])), 1) == "3.00"
    assert format_interval(Interval(*map(np.array, (2.0, 1.0, 3.0)), 4), 5) == (
        "2.00 [1.00, 3.00] (4 of 5)"
    )


@pytest.mark.parametrize("name", ["presets", "learners"])
def test_empty_and_double_choices_are_refused(name):
    """There is something to compare, and nothing twice."""
    first = getattr(Args(), name)[:1]
    for value in ((), first * 2):
        with pytest.raises(ValueError, match=f"^{name} must be one or more"):
            Args(**{name: value})


def test_every_learner_takes_the_presets():
    """Each learner's options start from each preset and keep to it."""
    for script, own in compare.LEARNERS.values():
        for preset in ("default", "paper"):
            options = parse_options(script.Args, "", ["--preset", preset, *own])
            assert options.preset == preset
            assert getattr(options, "share_parameters", False) == bool(own)
    assert meta_dqn.ALGORITHM != independent_dqn.ALGORITHM


# -- what is read, and what is drawn -----------------------------------------------------------


def finished_run(out, seed, solved, learner="meta"):
    """Return a run with files as if it had been trained for 150 episodes and evaluated."""
    args = tiny(out / f"{learner}{seed}", learners=(learner,), seeds=seed + 1)
    run = next(run for run in args.plan(WORDS) if run.seed == seed)
    run.folder.mkdir(parents=True)
    header = "policy,problems,solved %,gap %,optimal %,unsolved = 15\n"
    gap = "nan" if solved == 0 else "8.0"
    (run.folder / "evaluation.csv").write_text(
        f"{header}nearest landmark,30,100,1,2,3\nnetwork alone,30,{solved},{gap},1.5,{9 + seed}\n"
    )
    (run.folder / "timing.json").write_text('{"seconds_total": 90.0}')
    rows = [f"{i + 1},1,15,{-i},{i % 2},1,0,0," for i in range(150)]
    text = "episode,problem,steps,reward,solved,epsilon,guidance,updates,loss\n"
    (run.folder / "metrics.csv").write_text(text + "\n".join(rows) + "\n")
    return run


def test_an_outcome_is_what_the_files_say(tmp_path):
    """Figures are those of the network alone, the return that of the last hundred episodes."""
    outcome = finished_run(tmp_path, 0, 50.0).outcome()
    assert outcome.measures == {
        "solved %": 50.0,
        "gap %": 8.0,
        "optimal %": 1.5,
        "cover time": 9.0,
        "return": -np.arange(50, 150).mean(),
        "minutes": 1.5,
    }
    assert outcome.returns.tolist() == [-float(i) for i in range(150)]


def test_who_solves_nothing_has_no_gap(tmp_path):
    """The gap is summed up over those that have one, and it is said of how many."""
    outcomes = [
        finished_run(tmp_path, seed, solved).outcome()
        for seed, solved in enumerate((0.0, 50.0, 70.0))
    ]
    (group,) = summary.summarise(outcomes)
    assert group.measures["gap %"].n == 2
    assert group.measures["gap %"].mean == 8.0
    assert group.measures["solved %"].n == 3
    assert "8.00 [8.00, 8.00] (2 of 3)" in summary.format_study(compare.COLUMNS, [group])


def test_interval_is_the_interquartile_means():
    """One value far out moves neither the mean nor its interval."""
    values = np.random.default_rng(0).normal(size=40)
    values[0] = 1e6
    found = interval(values)
    assert -1 < found.low < found.mean < found.high < 1


def test_all_learners_have_the_updates_asked_for(tmp_path):
    """The budget of the default preset is the same for every learner."""
    args = tiny(tmp_path, presets=("default",), learners=tuple(compare.LEARNERS), seeds=1)
    for default_updates in (7, 32):
        runs = replace(args, default_updates=default_updates).plan([])
        assert [run.group[1] for run in runs] == list(compare.LEARNERS)
        assert {r.options.updates_per_episode for r in runs} == {default_updates}


def test_curves_are_those_of_the_episodes(tmp_path, monkeypatch):
    """Drawn are running means over the seeds, at the episodes that they end with, in per cent."""
    outcomes = [
        finished_run(tmp_path, seed, 50.0, learner).outcome()
        for learner in ("meta", "shared")
        for seed in (0, 1)
    ]
    drawn = []
    monkeypatch.setattr(figures, "_save", lambda figure, path: drawn.append(figure) or path)
    compare.draw(tmp_path, summary.summarise(outcomes))
    returns, solved, shares, gaps = drawn[0].axes
    for axes in (returns, solved):
        assert [line.get_label() for line in axes.lines] == ["meta", "shared"]
    for line in returns.lines:
        assert line.get_xdata().tolist() == list(range(30, 151))
        assert line.get_ydata()[0] == pytest.approx(-np.arange(30).mean())
        assert line.get_ydata()[-1] == pytest.approx(-np.arange(120, 150).mean())
    for line in solved.lines:
        assert line.get_ydata() == pytest.approx(np.full(121, 50.0))
    assert {float(x) for line in shares.lines for x in np.ravel(line.get_xdata())} == {50.0}
    assert {float(x) for line in gaps.lines for x in np.ravel(line.get_xdata())} == {8.0}


def test_hidden_files_of_others_are_left_alone(tmp_path):
    """Only what a training itself had begun to write is cleared away."""
    other = tmp_path / "paper-meta-seed0"
    other.mkdir()
    (other / f".{'a' * 16}.tmp").write_text("{")
    (other / ".notes").write_text("years of work")
    with pytest.raises(ValueError, match=r"holds something else: \.notes"):
        compare.main(tiny(tmp_path), WORDS)
    assert (other / ".notes").read_text() == "years of work"
