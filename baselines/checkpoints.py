"""Checkpoints: all that a training needs to go on as if it had never stopped.

A checkpoint is two files in the run's folder ``checkpoints``: ``<number>.safetensors`` holds the
arrays, ``<number>.json`` everything else, and the digests of both. Each is written beside its
place, forced to the disk and renamed; the JSON comes last, so that half a checkpoint never counts.
The last two are kept. Nothing is pickled, and no code is run from a file.
"""

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors.numpy

from baselines.runs import RunFolder, parse_json, read_bytes, write_atomically

FOLDER = "checkpoints"
FORMAT = "mapp_env checkpoint"
VERSION = 1
KEPT = 2
MAX_ARRAYS_BYTES = 4 << 30
MAX_STATE_BYTES = 64 << 20
NAME = re.compile(r"(\d{12})\.json")


class Checkpoint(NamedTuple):
    """What was saved."""

    number: int  # grows from one checkpoint to the next: the steps played so far
    arrays: dict[str, np.ndarray]
    state: dict[str, Any]  # JSON: counters, states of generators


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message names the file and what is wrong."""


class Checkpoints:
    """The checkpoints of one run.

    Parameters
    ----------
    run
        The run folder.
    config
        What the run is, ready for JSON; a checkpoint of anything else is refused.
    """

    def __init__(self, run: Path, config: Mapping[str, Any]) -> None:
        self.folder = run / FOLDER
        self.config = _digest(_canonical(config))

    def numbers(self) -> list[int]:
        """Return the numbers of the checkpoints there are, ascending."""
        if not self.folder.is_dir():
            return []
        names = (NAME.fullmatch(path.name) for path in self.folder.iterdir())
        return sorted(int(name[1]) for name in names if name)

    def save(self, number: int, arrays: Mapping[str, np.ndarray], state: Mapping[str, Any]) -> None:
        """Write a checkpoint, then delete all but the last two.

        Raises
        ------
        OSError
            If it cannot be written; those written before are as they were.
        """
        self.folder.mkdir(exist_ok=True)
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
        write_atomically(self._path(number, "safetensors"), content)
        write_atomically(self._path(number, "json"), _canonical(record))
        self._delete_all_but(self.numbers()[-KEPT:])

    def _delete_all_but(self, kept: list[int]) -> None:
        names = {
            self._path(number, suffix) for number in kept for suffix in ("json", "safetensors")
        }
        # The JSON first: what remains of a deletion cut short is no checkpoint.
        for path in sorted(self.folder.iterdir()):
            if path not in names:
                path.unlink(missing_ok=True)

    def load(self, number: int) -> Checkpoint:
        """Read a checkpoint.

        Raises
        ------
        CheckpointError
            If a part is missing or changed, or it belongs to another run.
        """
        path = self._path(number, "json")
        try:
            text = read_bytes(path, MAX_STATE_BYTES)
            record = parse_json(text)
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
        except (ValueError, KeyError, RecursionError) as error:
            raise CheckpointError(f"{path}: {error}") from error
        path = self._path(number, "safetensors")
        try:
            content = read_bytes(path, MAX_ARRAYS_BYTES)
            if _digest(content) != arrays_sha256:
                raise ValueError("changed since it was written: its digest differs")
            arrays = safetensors.numpy.load(content)
        except Exception as error:  # safetensors raises its own error type, a plain Exception
            raise CheckpointError(f"{path}: {error}") from error
        return Checkpoint(number, arrays, state)

    def latest(self) -> tuple[Checkpoint | None, list[str]]:
        """Return the newest checkpoint that is whole, and what is wrong with newer ones.

        Raises
        ------
        CheckpointError
            If there are checkpoints but none of them can be used.
        """
        problems: list[str] = []
        for number in reversed(self.numbers()):
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


def part(arrays: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """Return the arrays whose names begin with a name and a dot, without these."""
    start = name + "."
    return {k.removeprefix(start): v for k, v in arrays.items() if k.startswith(start)}


def go_on(
    run: RunFolder,
    checkpoints: Checkpoints,
    restore: Callable[[dict[str, np.ndarray], dict[str, Any]], None],
) -> bool:
    """Bring a run to its newest whole checkpoint, or to its start if there is none.

    Parameters
    ----------
    run, checkpoints
        The run's folder and its checkpoints.
    restore
        Takes over a checkpoint's arrays and state.

    Returns
    -------
    bool
        Whether there was a checkpoint.

    Raises
    ------
    ValueError
        If there are checkpoints but none can be used, or metrics.csv has changed.
    """
    checkpoint, problems = checkpoints.latest()
    for problem in problems:
        print(f"not used: {problem}")
    if checkpoint is None:
        run.restart()
        print("no checkpoint had been written: from the start")
        return False
    try:
        run.rewind(checkpoint.state["metrics"])
        restore(checkpoint.arrays, checkpoint.state)
    except (KeyError, TypeError, RuntimeError, IndexError) as error:
        raise ValueError(
            f"checkpoint {checkpoint.number} does not fit this run: {error}"
        ) from error
    return True
