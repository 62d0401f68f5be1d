"""A training that was killed and resumed is the one that was never interrupted, byte for byte."""

import functools
import os
import re
import shutil
import signal
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from baselines import independent_dqn, meta_dqn
from baselines.learning import train
from baselines.learning.config import Options, preset_options
from baselines.learning.training import METRICS, Training, train_learner
from baselines.meta_dqn import Args, MetaLearner
from baselines.runs import folder as runs
from baselines.runs.checkpoints import Checkpoints
from baselines.runs.folder import RunFolder
from mapp_env import files

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
    "own-moves": {
        "updates_per_episode": 4,
        "max_cycles": 20,
        "memory_size": 100,
        "network": "geodesic",
        "replay": "imagined",
    },
}


def options(kind: str, **changes: object) -> Options:
    """Return the options of a short training."""
    preset = "paper" if kind.endswith("paper") else "default"
    meta = kind in ("default", "paper", "double")
    chosen = Args if meta else independent_dqn.Args
    return preset_options(chosen, preset, **{**SHORT, **PRESETS[kind], **changes})


def run(args: Options) -> int:
    """Train in this process, without the table and the figures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "finish", lambda *_: None)
        if isinstance(args, independent_dqn.Args):
            return independent_dqn.main(args)
        return train_learner(args, meta_dqn.ALGORITHM, MetaLearner)


class Killer:
    """Names what a training does, one thing after the other, and kills its process at one of them.

    That are steps, updates and rows, and of each file that is written: that it is begun, filled,
    forced to the disk and renamed, and its folder forced to the disk. Only the project's own writer
    is watched: compilers write files, too.
    """

    def __init__(self, moment: int | None) -> None:
        self.moment = moment
        self.names: list[str] = []
        self.file, self.step = "", 0  # the kind of file that is being written, and how far it is

    def tick(self, name: str) -> None:
        """Note a moment, and perhaps die of it."""
        if len(self.names) == self.moment:
            os.kill(os.getpid(), signal.SIGKILL)
        self.names.append(name)

    def hooked(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that says when it is called."""

        def call(*args: Any, **kwargs: Any) -> Any:
            self.tick(name)
            return function(*args, **kwargs)

        return call

    def writing(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that says when it is called to write a file."""

        def call(*args: Any, **kwargs: Any) -> Any:
            if self.file:
                self.tick(f"{self.file}: {self.step} {name}")
                self.step += 1
            return function(*args, **kwargs)

        return call

    def install(self, patch: pytest.MonkeyPatch) -> None:
        """Watch from now on."""
        replace = files._replace

        def watched(target: str, data: bytes) -> None:
            # Checkpoints are of one kind, whatever their number.
            self.file, self.step = re.sub(r"\d{12}", "N", Path(target).name), 0
            replace(target, data)
            self.file = ""

        # A killed process needs no fsync (only a dead machine does), and it is slow.
        system = {**vars(os), "fsync": lambda handle: None}
        calls = {n: self.writing(n, system[n]) for n in ("open", "fdopen", "fsync", "replace")}
        patch.setattr(files, "os", SimpleNamespace(**{**system, **calls}))
        patch.setattr(files, "_replace", watched)
        patch.setattr(runs, "os", SimpleNamespace(**system))
        unlink = Path.unlink

        def unlinked(path: Path, missing_ok: bool = False) -> None:
            if path.parent.name == "checkpoints":
                self.tick("unlink")
            unlink(path, missing_ok)

        patch.setattr(Path, "unlink", unlinked)
        for place, name in (
            *((Training, "advance"), (Checkpoints, "save"), (RunFolder, "log")),
            *((RunFolder, "restart"), (RunFolder, "write_config")),
        ):
            patch.setattr(place, name, self.hooked(name, getattr(place, name)))


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


def carry_on(args: Options) -> int:
    """Resume a training that was killed; if it was killed before it was one, start it again."""
    begun = (args.out / "config.json").exists()
    return run(type(args)(resume=args.out) if begun else args)


def results(folder: Path) -> dict[str, bytes]:
    """Return the files that must not differ, and the names of all there are."""
    names = [str(path.relative_to(folder)) for path in folder.rglob("*")]
    same = ("metrics.csv", "policy.safetensors")
    return {name: (folder / name).read_bytes() if name in same else b"" for name in sorted(names)}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Keep to one thread, also for what comes after."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return what gives a kind's training that nobody disturbs: its results and its moments."""

    @functools.cache
    def training(kind: str) -> tuple[dict[str, bytes], list[str]]:
        folder = tmp_path_factory.mktemp("whole") / "run"
        killer = Killer(None)
        with pytest.MonkeyPatch.context() as patch:
            killer.install(patch)
            assert run(options(kind, out=folder)) == 0
        return results(folder), killer.names

    return training


WRITTEN = ("config.json", "N.safetensors", "N.json", "policy.safetensors", "timing.json")


@pytest.mark.parametrize("group", ["between files", *WRITTEN])
def test_killed_at_each_kind_of_moment_and_resumed(group, whole, tmp_path):
    """Killed (SIGKILL) before each thing that a training does, and resumed: the same bytes."""
    expected, names = whole("default")
    rng = np.random.default_rng(len(group))
    kinds = sorted({name for name in names if name.partition(":")[0] in WRITTEN})
    between = sorted(set(names) - set(kinds))
    assert {kind.partition(":")[0] for kind in kinds} == set(WRITTEN)
    assert len(kinds) == 6 * len(WRITTEN)
    assert between == ["advance", "log", "restart", "save", "unlink", "write_config"]
    chosen = between if group == "between files" else [k for k in kinds if k.startswith(group)]
    moments = [int(rng.choice(np.flatnonzero(np.array(names) == kind))) for kind in chosen]
    moments += [names.index(chosen[-1])] * (group == "N.json")  # before the first checkpoint is one
    for index, moment in enumerate(moments):
        kind = names[moment]
        args = options("default", out=tmp_path / f"killed{index}")
        assert run_and_die(args, moment) == -signal.SIGKILL
        assert carry_on(args) == 0, kind
        assert results(args.out) == expected, kind


KINDS = ("default", "paper", "double", "independent", "independent-paper", "shared", "own-moves")


@pytest.mark.parametrize("kind", KINDS)
def test_killed_at_any_moment_and_resumed(kind, whole, tmp_path):
    """Killed again and again, at random, a third of the times within a save: the same bytes."""
    expected, names = whole(kind)
    rng = np.random.default_rng(len(kind))
    in_save = np.array([name.startswith("N.") for name in names])
    moments = [
        *rng.choice(np.flatnonzero(in_save), 2, replace=False),
        *rng.choice(np.flatnonzero(~in_save), 4, replace=False),
    ]
    for index, moment in enumerate(moments):
        args = options(kind, out=tmp_path / f"killed{index}")
        assert run_and_die(args, moment) == -signal.SIGKILL
        if index % 2 == 0 and (args.out / "config.json").exists():
            # Killed once more after the resumption, in whatever it does then.
            run_and_die(type(args)(resume=args.out), int(rng.integers(40)))
        assert carry_on(args) == 0
        assert results(args.out) == expected


def test_a_training_where_folders_cannot_be_synced(whole, tmp_path, monkeypatch):
    """On a share that forces no folder to the disk a training runs as anywhere."""
    fsync = os.fsync

    def of_files(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(22, "Invalid argument")
        fsync(handle)

    monkeypatch.setattr(os, "fsync", of_files)
    assert run(options("paper", out=tmp_path / "run")) == 0
    assert results(tmp_path / "run") == whole("paper")[0]


@pytest.mark.parametrize("kind", ["default", "independent"])
def test_without_a_second_thread_the_same(kind, tmp_path):
    """Drawing batches ahead in a second thread changes no byte."""
    run(options(kind, out=tmp_path / "one"))
    run(options(kind, out=tmp_path / "two", prefetch=True))
    assert results(tmp_path / "one") == results(tmp_path / "two")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_leave_a_checkpoint(number, tmp_path, monkeypatch, capsys):
    """Exit code 128 + signal, and the resumed run ends as if nothing had been."""
    whole, folder = tmp_path / "whole", tmp_path / "stopped"
    run(options("default", out=whole))
    advance, calls = Training.advance, []

    def interrupted(self):
        calls.append(None)
        if len(calls) == 97:
            os.kill(os.getpid(), number)
        return advance(self)

    with monkeypatch.context() as patch:
        patch.setattr(Training, "advance", interrupted)
        args = options("default", out=folder, checkpoint_seconds=1e9)
        assert run(args) == 128 + number
    assert "go on with --resume" in capsys.readouterr().out
    assert len(calls) == 97
    assert run(Args(resume=folder)) == 0
    assert (folder / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
    for name in ("metrics.csv", "policy.safetensors"):
        assert (folder / name).read_bytes() == (whole / name).read_bytes()


def stop_at(args: Options, count: int, *numbers: int) -> int:
    """Train until a number of steps and updates, then send signals; return the exit code."""
    advance, calls = Training.advance, []

    def stopped(self):
        calls.append(None)
        if len(calls) == count:
            for number in numbers:
                os.kill(os.getpid(), number)
        return advance(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Training, "advance", stopped)
        return run(args)


def test_a_second_signal_does_not_wait(tmp_path):
    """It ends a training at once, even in the middle of a step; the run can still be resumed."""
    whole, folder = tmp_path / "whole", tmp_path / "run"
    run(options("default", out=whole))
    remember, calls = MetaLearner.remember, []

    def interrupted(*args):
        calls.append(None)
        if len(calls) == 90:
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)
            raise AssertionError("the second one was swallowed")
        remember(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MetaLearner, "remember", interrupted)
        assert run(options("default", out=folder)) == 128 + signal.SIGTERM
    assert len(calls) == 90
    assert run(Args(resume=folder)) == 0
    assert results(folder) == results(whole)


def test_rows_after_the_checkpoint_come_again(tmp_path):
    """Stopped, killed long after, stopped again at once, and resumed: each episode has one row."""
    whole, folder = tmp_path / "whole", tmp_path / "run"
    args = options("default", out=folder, checkpoint_seconds=1e9)
    run(options("default", out=whole))
    assert stop_at(args, 50, signal.SIGTERM) == 143
    saved = (folder / "metrics.csv").read_bytes()
    assert run_and_die(Args(resume=folder), 120) == -signal.SIGKILL
    assert len((folder / "metrics.csv").read_bytes()) > len(saved)
    assert stop_at(Args(resume=folder), 1, signal.SIGTERM) == 143
    assert (folder / "metrics.csv").read_bytes() == saved
    assert run(Args(resume=folder)) == 0
    for name in ("metrics.csv", "policy.safetensors"):
        assert (folder / name).read_bytes() == (whole / name).read_bytes()


class Disk:
    """What a disk still holds of a folder after a power cut: what was forced to it, no more.

    Of a file its content when it was last forced to the disk, of a folder the names that it had
    then.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.contents: dict[int, bytes] = {}  # by inode
        self.names: dict[Path, dict[str, int]] = {}  # of each folder; inodes

    def fsync(self, handle: int) -> None:
        """Force a file or a folder to the disk."""
        path = Path(os.readlink(f"/proc/self/fd/{handle}"))
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            self.names[path] = {item.name: item.stat().st_ino for item in path.iterdir()}
        else:
            self.contents[os.fstat(handle).st_ino] = path.read_bytes()

    def after_a_cut(self, copy: Path) -> Path:
        """Make a folder of what is left."""
        self._copy(self.root, copy)
        return copy

    def _copy(self, folder: Path, copy: Path) -> None:
        copy.mkdir()
        for name, inode in self.names.get(folder, {}).items():
            if (folder / name).is_dir():
                self._copy(folder / name, copy / name)
            else:
                (copy / name).write_bytes(self.contents.get(inode, b""))


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs Linux")
def test_a_power_cut_at_any_moment(tmp_path, monkeypatch):
    """What was forced to the disk by then is enough to go on to the same bytes."""
    folder = tmp_path / "disk" / "runs" / "run"
    disk, copies = Disk(tmp_path / "disk"), []
    disk.root.mkdir()
    advance, calls, kept = Training.advance, [], []

    def watched(self):
        calls.append(None)
        if len(calls) in (1, 2, 45, 100, 190):
            copies.append(disk.after_a_cut(tmp_path / f"cut{len(calls)}") / "runs" / "run")
        return advance(self)

    def keep(handle: int) -> None:
        if not stat.S_ISDIR(os.fstat(handle).st_mode):
            kept.append(os.dup(handle))  # so that no other file gets this inode
        disk.fsync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", keep)
        patch.setattr(Training, "advance", watched)
        assert run(options("default", out=folder)) == 0
        copies.append(disk.after_a_cut(tmp_path / "end") / "runs" / "run")
    for handle in kept:
        os.close(handle)
    expected = results(folder)
    assert len(copies) == 6
    for copy in copies:
        assert run(Args(resume=copy)) == 0
        for name in ("metrics.csv", "policy.safetensors"):
            assert (copy / name).read_bytes() == expected[name]


# -- what is wrong with a checkpoint -----------------------------------------------------------


def test_damaged_checkpoints(tmp_path, capsys):
    """The one before is used, with a message; if none is whole the run is refused."""
    folder = tmp_path / "run"
    run(options("default", out=folder))
    expected = results(folder)
    _, last = sorted((folder / "checkpoints").glob("*.safetensors"))
    content = bytearray(last.read_bytes())
    content[len(content) // 2] ^= 1
    last.write_bytes(content)
    capsys.readouterr()
    assert run(Args(resume=folder)) == 0
    assert f"not used: {last}: changed since it was written" in capsys.readouterr().out
    assert results(folder) == expected
    for path in (folder / "checkpoints").glob("*.safetensors"):
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
    with pytest.raises(ValueError, match=r"config\.json': cannot be opened"):
        run(Args(resume=tmp_path))


def test_two_trainings_in_one_folder(tmp_path):
    """While one is open, a second one is refused; afterwards it is not."""
    folder = tmp_path / "run"
    run(options("default", out=folder))
    first = runs.RunFolder(folder, METRICS, resume=True)
    with pytest.raises(ValueError, match="another training is writing into it"):
        run(Args(resume=folder))
    first.close()
    assert run(Args(resume=folder)) == 0


def test_full_disk_ends_the_run_and_keeps_the_checkpoint(tmp_path, monkeypatch):
    """No space: a ValueError (exit code 1), the checkpoint before it still good."""
    folder = tmp_path / "run"
    whole = tmp_path / "whole"
    run(options("default", out=whole))
    replace, calls = files._replace, []

    def full(target, data):
        calls.append(target)
        if len(calls) > 60:
            raise OSError(28, "No space left on device")
        replace(target, data)

    with monkeypatch.context() as patch:
        patch.setattr(files, "_replace", full)
        with pytest.raises(ValueError, match=r"cannot be written: .*No space left"):
            run(options("default", out=folder))
    assert run(Args(resume=folder)) == 0
    assert results(folder) == results(whole)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """Return the folder of a training that was stopped in the middle of an episode."""
    folder = tmp_path_factory.mktemp("stopped") / "run"

    @functools.cache
    def training(kind: str) -> Path:
        args = options(kind, out=folder / kind, checkpoint_seconds=1e9)
        assert stop_at(args, 97, signal.SIGTERM) == 143
        for path in (folder / kind / "checkpoints").glob("000000000000.*"):
            path.unlink()
        return folder / kind

    return training


def paths_in(value: object) -> list[tuple[str, ...]]:
    """Return the way to each entry of nested objects."""
    if not isinstance(value, dict):
        return []
    return [(k, *rest) for k, v in value.items() for rest in [(), *paths_in(v)]]


@pytest.mark.parametrize("kind", ["default", "paper", "independent"])
def test_a_checkpoint_without_a_part_is_refused(kind, stopped, forge, tmp_path):
    """Whichever array or entry is missing, though the digests fit: by name, and nothing is cut."""
    folder = stopped(kind)
    metrics = (folder / "metrics.csv").read_bytes()
    arrays, state = {}, {}
    forge(folder, tmp_path / "as it is", lambda a, s: (arrays.update(a), state.update(s)))
    entries = [path for path in paths_in(state) if path[0] not in ("seconds",)]
    # Of independent learners the first one's each, and the others' together.
    names = [name for name in arrays if not name.startswith(("1.", "2."))]
    parts = [name.split(".") for name in arrays]
    groups = {".".join(words[:n]) for words in parts for n in range(1, len(words))}
    assert any(name.endswith(".exp_avg_sq") for name in names)
    assert any(group.endswith("optimiser") for group in groups)
    assert any(group.endswith("prepared") for group in groups) == (kind != "paper")
    assert ("progress", "steps") in entries

    def without(names: list[str]) -> Callable[[dict, dict], object]:
        return lambda arrays, state: [arrays.pop(name) for name in names]

    def lacking(path: tuple[str, ...]) -> Callable[[dict, dict], object]:
        return lambda arrays, state: functools.reduce(dict.get, path[:-1], state).pop(path[-1])

    changes = [without([name]) for name in names]
    changes += [without([n for n in arrays if n.startswith(f"{g}.")]) for g in sorted(groups)]
    changes += [lacking(path) for path in entries]
    for index, change in enumerate(changes):
        copy = forge(folder, tmp_path / str(index), change)
        with pytest.raises(ValueError, match=r"^checkpoint \d+ does not fit this run: "):
            run(type(options(kind))(resume=copy))
        assert (copy / "metrics.csv").read_bytes() == metrics
        shutil.rmtree(copy)
    # The forger's copy of what nobody changed is good.
    assert run(type(options(kind))(resume=tmp_path / "as it is")) == 0


OTHERS: dict[str, Callable[[dict, dict], object]] = {
    "other steps": lambda _, state: state["progress"].update(steps=state["progress"]["steps"] + 1),
    "fewer actions": lambda _, state: state["progress"]["actions"].pop(),
    "other actions": lambda _, state: state["progress"]["actions"].reverse(),
    "more actions": lambda _, state: state["progress"]["actions"].append([0, 0, 0]),
    "actions of nobody": lambda _, state: state["progress"]["actions"].append([0, 0]),
    "another reward": lambda _, state: state["progress"].update(reward=-1.0),
    "already over": lambda _, state: state["progress"].update(over=True, solved=True),
    "other episodes": lambda _, state: state["progress"].update(episodes=2),
    "other updates": lambda _, state: state["learner"].update(updates=3),
    "an observation": lambda _, state: state["observation"].reverse(),
    "another place": lambda _, state: state["metrics"].update(bytes=3),
    "no number": lambda _, state: state["progress"].update(steps=None),
    "true for one": lambda _, state: state["progress"].update(solved=0),
    "an entry more": lambda _, state: state.update(more=1),
    "an array more": lambda arrays, _: arrays.update(more=np.zeros(3)),
    "a weight more": lambda arrays, _: arrays.update({"network.more": np.zeros(3)}),
    "other steps of Adam": lambda arrays, _: arrays["optimiser.0.step"].__iadd__(1),
    "a moment of another shape": lambda arrays, _: arrays.update(
        {"optimiser.0.exp_avg": arrays["optimiser.0.exp_avg"][:1]}
    ),
    "weights of another type": lambda arrays, _: arrays.update(
        {name: arrays[name].astype(np.float64) for name in arrays if name.startswith("network.")}
    ),
    "values of fewer rows": lambda arrays, _: arrays.update({"here": arrays["here"][:1]}),
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_checkpoint_of_something_else_is_refused(name, stopped, forge, tmp_path):
    """What contradicts the rest of a checkpoint, or metrics.csv, is not continued silently."""
    folder = stopped("default")
    copy = forge(folder, tmp_path / "run", OTHERS[name])
    with pytest.raises(ValueError, match=r"^checkpoint \d+ does not fit this run: "):
        run(Args(resume=copy))
    assert (copy / "metrics.csv").read_bytes() == (folder / "metrics.csv").read_bytes()


@pytest.mark.parametrize("whole_folder", [False, True])
def test_deleted_checkpoints_are_no_start(whole_folder, tmp_path):
    """Rows without a checkpoint are not cut: the run is refused, and it is said what to do."""
    folder = tmp_path / "run"
    run(options("default", out=folder))
    before = (folder / "metrics.csv").read_bytes()
    shutil.rmtree(folder / "checkpoints")
    if not whole_folder:
        (folder / "checkpoints").mkdir()
    with pytest.raises(ValueError, match=r"checkpoints to go on from are gone: .* --out"):
        run(Args(resume=folder))
    assert (folder / "metrics.csv").read_bytes() == before


# -- others in the folder ----------------------------------------------------------------------


def test_foreign_things_in_checkpoints_are_left_alone(tmp_path):
    """Files and folders that are no checkpoints neither end a training nor are deleted."""
    folder = tmp_path / "run"
    assert stop_at(options("default", out=folder), 60, signal.SIGTERM) == 143
    place = folder / "checkpoints"
    (place / "notes.txt").write_text("mine")
    (place / "000000000001.json.bak").write_text("mine")
    (place / "best").mkdir()
    (place / "000000000003.json").mkdir()
    (place / "best" / "000000000001.json").write_text("mine")
    assert run(Args(resume=folder)) == 0
    names = sorted(path.name for path in place.iterdir())
    assert names[:3] == ["000000000001.json.bak", "000000000003.json", "000000000195.json"]
    assert names[-2:] == ["best", "notes.txt"]
    assert len(names) == 8
    assert (place / "best" / "000000000001.json").read_text() == "mine"


def test_a_deleted_lock_lets_nobody_in(tmp_path):
    """While a training is open another one is refused, though its lock file was deleted."""
    folder = tmp_path / "run"
    run(options("default", out=folder))
    first = RunFolder(folder, METRICS, resume=True)
    unfinished = folder / ".0123456789abcdef.tmp"
    unfinished.write_text("the first one is about to write this")
    (folder / ".lock").unlink()
    with pytest.raises(ValueError, match="another training is writing into it"):
        run(Args(resume=folder))
    assert unfinished.exists()
    first.close()
    assert run(Args(resume=folder)) == 0
    assert not unfinished.exists()


@pytest.mark.parametrize("replaced", [False, True])
def test_a_metrics_file_that_is_taken_away_is_noticed(replaced, tmp_path):
    """A training whose metrics.csv is deleted or replaced ends with an error that names it."""
    folder = tmp_path / "run"
    advance, calls = Training.advance, []

    def watched(self):
        calls.append(None)
        if len(calls) == 50:
            text = (folder / "metrics.csv").read_text()
            (folder / "metrics.csv").unlink()
            if replaced:
                (folder / "metrics.csv").write_text(text)
        return advance(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Training, "advance", watched)
        with pytest.raises(ValueError, match=r"metrics\.csv"):
            run(options("default", out=folder))
    assert len(calls) == 50
