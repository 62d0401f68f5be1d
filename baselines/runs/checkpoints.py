"""Checkpoints: everything a run needs to resume as if never interrupted.

A checkpoint is two files in the run's folder ``checkpoints``: ``<number>.safetensors`` holds the
arrays, ``<number>.json`` everything else, and the digests of both. Each is written beside its
place, forced to the disk and renamed; the JSON comes last, so that half a checkpoint never counts.
The last two are kept; other files are left alone. Nothing is pickled, and no code is
run from a file. The first one is written before the first step: where metrics.csv has rows and
there is none, they were deleted.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from baselines.runs.folder import CHECKPOINTS, METRICS_FILE, RunFolder, read_metrics
from mapp_env.files import make_folder, parse_json, read_bytes, write_bytes

FORMAT = "mapp_env checkpoint"
VERSION = 3
KEPT = 2
MAX_ARRAYS_BYTES = 4 << 30
MAX_STATE_BYTES = 64 << 20
NAME = re.compile(r"(\d{12})\.(json|safetensors)")


class Checkpoint(NamedTuple):
    """What was saved."""

    number: int  # grows from one checkpoint to the next
    arrays: dict[str, np.ndarray]
    state: dict[str, Any]  # JSON: counters, states of generators


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message names the file and what is wrong."""


class Saved(Protocol):
    """What a checkpoint holds."""

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that change, by name."""

    def state(self) -> dict[str, Any]:
        """Return all other state, as JSON-ready values."""

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Take over what the two above returned; a ValueError if something is not there."""


class Resumable(Saved, Protocol):
    """A training that can be saved, and carried on."""

    @property
    def number(self) -> int:
        """How far it is: 0 at the start, and more at each checkpoint."""

    def check_metrics(self, table: dict[str, list[float]]) -> None:
        """Raise a ValueError if metrics.csv tells of another point."""


class Checkpoints:
    """The checkpoints in a run's folder; any of a run with another config (JSON) is refused."""

    def __init__(self, run: Path, config: Mapping[str, Any]) -> None:
        self.folder = run / CHECKPOINTS
        self.config = _digest(_canonical(config))

    def numbers(self) -> list[int]:
        """Return the numbers of the checkpoints there are, ascending."""
        return sorted(number for number, suffix in self._files() if suffix == "json")

    def _files(self) -> list[tuple[int, str]]:
        """Return number and suffix of each file of ours."""
        if not self.folder.is_dir():
            return []
        paths = (path for path in self.folder.iterdir() if path.is_file())
        names = (NAME.fullmatch(path.name) for path in paths)
        return sorted((int(name[1]), name[2]) for name in names if name)

    def save(self, number: int, arrays: Mapping[str, np.ndarray], state: Mapping[str, Any]) -> None:
        """Write a checkpoint, then delete all but the last two.

        Raises a ValueError if it cannot be written; those written before are as they were.
        """
        make_folder(self.folder)
        content = safetensors.numpy.save(
            {name: np.asarray(array, order="C") for name, array in arrays.items()}
        )
        record = {
            "format": FORMAT,
            "version": VERSION,
            "number": number,
            "config_sha256": self.config,
            "arrays_sha256": _digest(content),
            "state": state,
        }
        record["sha256"] = _digest(_canonical(record))
        write_bytes(self._path(number, "safetensors"), content, MAX_ARRAYS_BYTES)
        write_bytes(self._path(number, "json"), _canonical(record), MAX_STATE_BYTES)
        self._delete_before(number)

    def _delete_before(self, number: int) -> None:
        """Delete all but the last checkpoints up to this one; newer ones could not be used."""
        kept = [n for n in self.numbers() if n <= number][-KEPT:]
        # The JSON first: what remains of a deletion cut short is no checkpoint.
        for other, suffix in self._files():
            if other < number and other not in kept:
                self._path(other, suffix).unlink(missing_ok=True)

    def load(self, number: int) -> Checkpoint:
        """Read a checkpoint.

        Raises a CheckpointError if a part is missing or changed, or it belongs to another run.
        """
        path = self._path(number, "json")
        try:
            text = read_bytes(path, MAX_STATE_BYTES, "a checkpoint", ValueError)
            record = parse_json(text, "its state", ValueError)
            if not isinstance(record, dict) or record.get("format") != FORMAT:
                raise ValueError("not a checkpoint")
            if record.get("version") != VERSION or record.get("number") != number:
                raise ValueError("of another version or number")
            same = _canonical(record) == text  # down to the last blank
            sha256 = record.pop("sha256", None)
            if not same or sha256 != _digest(_canonical(record)):
                raise ValueError("changed since it was written: its digest differs")
            if record["config_sha256"] != self.config:
                raise ValueError("belongs to a run with another config")
            state, arrays_sha256 = record["state"], record["arrays_sha256"]
            path = self._path(number, "safetensors")
            content = read_bytes(path, MAX_ARRAYS_BYTES, "a checkpoint", ValueError)
            if _digest(content) != arrays_sha256:
                raise ValueError("changed since it was written: its digest differs")
            arrays = safetensors.numpy.load(content)
        except (ValueError, KeyError, SafetensorError) as error:
            raise CheckpointError(f"{path}: {error}") from error
        return Checkpoint(number, arrays, state)

    def latest(self) -> tuple[Checkpoint | None, list[str]]:
        """Return the newest checkpoint that is whole, and what is wrong with newer ones.

        Raises a CheckpointError if there are checkpoints but none of them can be used; the start is
        no substitute.
        """
        problems: list[str] = []
        for number in reversed(self.numbers()):
            if problems and number == 0:
                break
            try:
                return self.load(number), problems
            except CheckpointError as error:
                problems.append(str(error))
        if problems:
            raise CheckpointError("no checkpoint can be used: " + "; ".join(problems))
        return None, problems

    def _path(self, number: int, suffix: str) -> Path:
        return self.folder / f"{number:012d}.{suffix}"


def _canonical(content: Mapping[str, Any]) -> bytes:
    """Return JSON that is the same for the same content."""
    return (json.dumps(content, sort_keys=True, allow_nan=False) + "\n").encode()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def joined(parts: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the arrays of all parts, each named after its part, a dot and its own name."""
    return {f"{part}.{name}": array for part, own in parts.items() for name, array in own.items()}


def part(arrays: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """Return one of the parts that :func:`joined` put together."""
    start = name + "."
    return {k.removeprefix(start): v for k, v in arrays.items() if k.startswith(start)}


def take(arrays: dict[str, np.ndarray], name: str, like: np.ndarray) -> np.ndarray:
    """Return a copy of an array; a ValueError unless it is there, of another's shape and type."""
    found = arrays.get(name)
    if found is None or found.shape != like.shape or found.dtype != like.dtype:
        got = "nothing" if found is None else f"{found.dtype} of shape {found.shape}"
        raise ValueError(f"{name} must be {like.dtype} of shape {like.shape}, got {got}")
    return found.copy()


def save(run: RunFolder, checkpoints: Checkpoints, training: Resumable) -> None:
    """Write a checkpoint of a training; raise ValueError, OSError if it cannot be written."""
    state = {**training.state(), "metrics": run.position()}
    checkpoints.save(training.number, training.arrays(), state)


def go_on(run: RunFolder, checkpoints: Checkpoints, training: Resumable) -> bool:
    """Bring a training, at its start, to its newest whole checkpoint; return whether there is one.

    Raises a ValueError if there are checkpoints but none can be used, they were deleted, something
    is missing in the newest whole one, or metrics.csv has changed; metrics.csv is as it was then.
    """
    checkpoint, problems = checkpoints.latest()
    for problem in problems:
        print(f"not used: {problem}")
    if checkpoint is None:
        if any(read_metrics(run.folder).values()):
            raise ValueError(
                f"{run.folder}: {METRICS_FILE} has rows, and the checkpoints to go on from are "
                "gone: begin anew with --out in another folder"
            )
        run.restart()
        print("no checkpoint had been written: from the start")
        return False
    try:
        position = checkpoint.state["metrics"]
        table = run.rows_at(position)
        training.restore(checkpoint.arrays, checkpoint.state)
        check_restored(checkpoint, training)
        training.check_metrics(table)
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError, IndexError) as error:
        raise ValueError(
            f"checkpoint {checkpoint.number} does not fit this run: {error}"
        ) from error
    run.rewind(position)
    return True


def check_restored(checkpoint: Checkpoint, training: Resumable) -> None:
    """Raise a ValueError if a training's next checkpoint would not hold what was just restored."""
    state = {**training.state(), "metrics": checkpoint.state["metrics"]}
    saved = _entries(checkpoint)
    found = _entries(Checkpoint(training.number, training.arrays(), state))
    differing = sorted(k for k in saved.keys() | found.keys() if saved.get(k) != found.get(k))
    if differing:
        raise ValueError(f"missing or different: {', '.join(differing)}")


def _entries(checkpoint: Checkpoint) -> dict[str, object]:
    """Return everything in a checkpoint by name, in a form that is equal only if all bits are."""
    number, arrays, state = checkpoint
    texts = {f"state {name}": _canonical({name: value}) for name, value in state.items()}
    parts = {name: (a.dtype, a.shape, a.tobytes()) for name, a in arrays.items()}
    return {"number": number, **texts, **parts}
