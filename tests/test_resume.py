"""A training that was killed and resumed is the one that was never interrupted, byte for byte."""

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from baselines import checkpoints, experiment, independent_dqn, meta_dqn, runs
from baselines.checkpoints import Checkpoints
from baselines.meta_dqn import Args, MetaLearner
from baselines.options import Options, preset_options

SHORT = {
    "n_problems": 2,
    "episodes_per_problem": 4,
    "learning_starts": 60,
    "batch_size": 8,
    "hidden_units": 16,
    "code_units": 8,
    "evaluation_problems": 0,
    "checkpoint_seconds": 0.0,
    "prefetch": False,  # no threads in a process that is forked
}
PRESETS = {
    "default": {"updates_per_episode": 6, "max_cycles": 20},
    "paper": {"memory_size": 40, "max_cycles": 20, "update_interval": 3},
    "double": {"updates_per_episode": 6, "max_cycles": 20, "double": True, "dueling": True},
    "independent": {"updates_per_episode": 4, "max_cycles": 20},
    "independent-paper": {"memory_size": 40, "max_cycles": 20, "update_interval": 5},
    "shared": {"updates_per_episode": 6, "max_cycles": 20, "share_parameters": True},
}


def options(kind: str, **changes: object) -> Options:
    """Return the options of a short training."""
    preset = "paper" if kind.endswith("paper") else "default"
    meta = kind in ("default", "paper", "double")
    chosen = Args if meta else independent_dqn.Args
    return preset_options(chosen, preset, **{**SHORT, **PRESETS[kind], **changes})


def run(args: Options) -> int:
    """Train in this process, without the table and the figures."""
    if isinstance(args, independent_dqn.Args):
        return independent_dqn.main(args)
    return experiment.run_experiment(args, meta_dqn.ALGORITHM, MetaLearner)


class Killer:
    """Counts what a training does, and kills its process at a chosen moment.

    Moments are the steps and updates, and within saves each file that is begun, written, forced to
    the disk or renamed.
    """

    def __init__(self, moment: int | None) -> None:
        self.moment, self.count = moment, 0
        self.saving: list[int] = []

    def tick(self, in_save: bool) -> None:
        """Count a moment."""
        if self.count == self.moment:
            os.kill(os.getpid(), signal.SIGKILL)
        if in_save:
            self.saving.append(self.count)
        self.count += 1

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Count from now on."""

        def hooked(function, in_save):
            def call(*args, **kwargs):
                self.tick(in_save)
                return function(*args, **kwargs)

            return call

        advance = experiment.Training.advance
        monkeypatch.setattr(experiment.Training, "advance", hooked(advance, False))
        for name in ("replace", "fdopen", "chmod"):
            monkeypatch.setattr(runs.os, name, hooked(getattr(os, name), True))
        # A killed process needs no fsync (only a dead machine does), and it is slow.
        monkeypatch.setattr(runs.os, "fsync", hooked(lambda handle: None, True))
        monkeypatch.setattr(
            Checkpoints, "_delete_all_but", hooked(Checkpoints._delete_all_but, True)
        )


def run_and_die(args: Options, moment: int) -> int:
    """Train in a forked process that is killed at a moment; return its exit status."""
    child = os.fork()
    if child == 0:
        status = 70
        try:
            with open(os.devnull, "w") as nowhere:
                sys.stdout = sys.stderr = nowhere
                with pytest.MonkeyPatch.context() as patch:
                    Killer(moment).install(patch)
                    status = run(args)
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def results(folder: Path) -> dict[str, bytes]:
    """Return the files that must not differ."""
    return {name: (folder / name).read_bytes() for name in ("metrics.csv", "policy.safetensors")}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Keep to one thread, also for what comes after."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


KINDS = [
    *(("default", 34), ("paper", 8), ("double", 8)),
    *(("independent", 8), ("independent-paper", 6), ("shared", 6)),
]


@pytest.mark.parametrize(("kind", "kills"), KINDS)
def test_killed_at_any_moment_and_resumed(kind, kills, tmp_path, monkeypatch):
    """Killed (SIGKILL) again and again, a third of the times within a save: the same bytes."""
    whole = options(kind, out=tmp_path / "whole")
    with pytest.MonkeyPatch.context() as patch:
        killer = Killer(None)
        killer.install(patch)
        assert run(whole) == 0
    rng = np.random.default_rng(len(kind))
    moments = np.concatenate(
        [
            rng.choice(killer.saving, kills // 3 + 1, replace=False),
            rng.choice(killer.count, kills - kills // 3 - 1, replace=False),
        ]
    )
    expected = results(tmp_path / "whole")
    for index, moment in enumerate(moments.tolist()):
        folder = tmp_path / f"killed{index}"
        assert run_and_die(options(kind, out=folder), moment) == -signal.SIGKILL
        if index % 4 == 0 and (folder / "config.json").exists():
            # Killed once more after the resumption, in whatever it does then.
            run_and_die(type(whole)(resume=folder), int(rng.integers(40)))
        if not (folder / "config.json").exists():
            continue  # killed before there was a run
        assert run(type(whole)(resume=folder)) == 0
        assert results(folder) == expected


@pytest.mark.parametrize("kind", ["default", "independent"])
def test_without_a_second_thread_the_same(kind, tmp_path):
    """Preparing batches ahead in a second thread changes no byte."""
    run(options(kind, out=tmp_path / "one"))
    run(options(kind, out=tmp_path / "two", prefetch=True))
    assert results(tmp_path / "one") == results(tmp_path / "two")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_leave_a_checkpoint(number, tmp_path, monkeypatch, capsys):
    """Exit code 128 + signal, and the resumed run ends as if nothing had been."""
    whole, folder = tmp_path / "whole", tmp_path / "stopped"
    run(options("default", out=whole))
    advance, calls = experiment.Training.advance, []

    def interrupted(self):
        calls.append(None)
        if len(calls) == 97:
            os.kill(os.getpid(), number)
        return advance(self)

    with monkeypatch.context() as patch:
        patch.setattr(experiment.Training, "advance", interrupted)
        args = options("default", out=folder, checkpoint_seconds=1e9)
        assert run(args) == 128 + number
    assert "go on with --resume" in capsys.readouterr().out
    assert len(calls) == 97
    assert run(Args(resume=folder)) == 0
    assert (folder / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
    assert results(folder) == results(whole)


def test_damaged_checkpoints(tmp_path, capsys):
    """The one before is used, with a message; if none is whole the run is refused."""
    folder = tmp_path / "run"
    run(options("default", out=folder))
    expected = results(folder)
    _, last = sorted((folder / checkpoints.FOLDER).glob("*.safetensors"))
    content = bytearray(last.read_bytes())
    content[len(content) // 2] ^= 1
    last.write_bytes(content)
    capsys.readouterr()
    assert run(Args(resume=folder)) == 0
    assert f"not used: {last}: changed since it was written" in capsys.readouterr().out
    assert results(folder) == expected
    for path in (folder / checkpoints.FOLDER).glob("*.safetensors"):
        path.unlink()
    with pytest.raises(ValueError, match="no checkpoint can be used"):
        run(Args(resume=folder))


def test_changed_metrics_are_refused(tmp_path):
    """A metrics.csv that is not the one that was written is not continued."""
    folder = tmp_path / "run"
    run(options("default", out=folder))
    text = (folder / "metrics.csv").read_text()
    (folder / "metrics.csv").write_text(text.replace("1,1,", "1,2,", 1))
    with pytest.raises(ValueError, match=r"metrics\.csv: changed since the checkpoint"):
        run(Args(resume=folder))


def test_another_config_is_refused(tmp_path):
    """A checkpoint does not go on under other options, nor a run of another algorithm."""
    folder = tmp_path / "run"
    run(options("default", out=folder))
    config = folder / "config.json"
    text = config.read_text()
    config.write_text(text.replace('"discount": 0.95', '"discount": 0.9'))
    with pytest.raises(ValueError, match="belongs to a run with another config"):
        run(Args(resume=folder))
    config.write_text(text.replace('"meta_dqn"', '"other"'))
    with pytest.raises(ValueError, match="a run of 'other', not of meta_dqn"):
        run(Args(resume=folder))
    config.write_text(text.replace('"discount"', '"diskount"'))
    with pytest.raises(ValueError, match="options are not those of this version"):
        run(Args(resume=folder))


def test_resume_takes_no_other_options(tmp_path):
    """A resumed run goes on with its own options; what is no run is refused."""
    with pytest.raises(ValueError, match="leave out seed"):
        run(Args(resume=tmp_path, seed=3))
    with pytest.raises(ValueError, match="leave out out"):
        run(Args(resume=tmp_path, out=tmp_path / "x"))
    with pytest.raises(ValueError, match=r"config\.json: "):
        run(Args(resume=tmp_path))


def test_two_trainings_in_one_folder(tmp_path):
    """While one is open, a second one is refused; afterwards it is not."""
    folder = tmp_path / "run"
    run(options("default", out=folder))
    first = runs.RunFolder(folder, experiment.METRICS, resume=True)
    with pytest.raises(ValueError, match="another training is writing into it"):
        run(Args(resume=folder))
    first.close()
    assert run(Args(resume=folder)) == 0


def test_full_disk_ends_the_run_and_keeps_the_checkpoint(tmp_path, monkeypatch):
    """No space: a ValueError (exit code 1), the checkpoint before it still good."""
    folder = tmp_path / "run"
    whole = tmp_path / "whole"
    run(options("default", out=whole))
    write, calls = checkpoints.write_atomically, []

    def full(path, content):
        calls.append(path)
        if len(calls) > 60:
            raise OSError(28, "No space left on device")
        write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "write_atomically", full)
        with pytest.raises(ValueError, match=r"cannot be written: .*No space left"):
            run(options("default", out=folder))
    assert run(Args(resume=folder)) == 0
    assert results(folder) == results(whole)
