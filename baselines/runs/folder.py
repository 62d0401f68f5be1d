"""Run folders: what a training leaves behind, written so that a stopped run stays readable.

A run folder holds

=================== ==============================================================
config.json         every option, the training problems, versions, commit
metrics.csv         one row per finished episode; flushed at every row
policy.safetensors  the network's weights (``policy.load_policy`` reads them)
timing.json         where the time went; the only file with wall times of the run
checkpoints/        the last two checkpoints (``checkpoints.Checkpoints``)
evaluation.csv/.md  the table over unseen problems
fig*.png            the paper's figures 2, 3 and 4
=================== ==============================================================

metrics.csv holds no wall time: two runs with one seed write the same bytes. Files are written by
``mapp_env.files``: whole or not at all.
"""

import contextlib
import csv
import hashlib
import json
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from filelock import FileLock, Timeout

import mapp_env
from mapp_env.files import (
    UNFINISHED,
    make_folder,
    read_bytes,
    remove_unfinished,
    unique_fields,
    write_bytes,
)

try:
    import fcntl
except ImportError:  # Windows, where nobody can delete a file that is open
    fcntl = None  # type: ignore[assignment]

CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.csv"
WEIGHTS_FILE = "policy.safetensors"
TIMING_FILE = "timing.json"
CHECKPOINTS = "checkpoints"
LOCK_FILE = ".lock"
MAX_TEXT_BYTES = 64 * 1024 * 1024  # no file of ours comes near; refuse to read more
MAX_HEADER_BYTES = 1024  # of metrics.csv

VERSIONED = ("numpy", "numba", "torch", "gymnasium", "pettingzoo", "safetensors")


class RunFolder:
    """The folder of one training, locked while it is open.

    Parameters
    ----------
    folder
        Where; it must not exist, or be empty, unless a run is resumed. (A training that was killed
        before its config was written has left nothing.)
    columns
        The columns of metrics.csv.
    resume
        Whether to go on in a folder that a training has left.

    Raises
    ------
    ValueError
        If the folder holds something already (or, to resume, no run), cannot be made, or another
        training has it open.
    """

    def __init__(self, folder: Path, columns: Sequence[str], resume: bool = False) -> None:
        self.folder = folder
        self.columns = tuple(columns)
        if resume and not (folder / CONFIG_FILE).is_file():
            raise ValueError(f"resume must be a run folder, got {str(folder)!r}")
        try:
            make_folder(folder)
            occupied = not resume and foreign_entry(folder) is not None
        except OSError as error:
            raise ValueError(f"out must be a folder that can be made: {error}") from error
        if occupied:
            raise ValueError(
                f"out must be a new or empty folder, got {str(folder)!r}, which is not empty"
            )
        self._lock = FileLock(folder / LOCK_FILE)
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise ValueError(f"{folder}: another training is writing into it") from None
        except OSError as error:
            raise ValueError(f"{folder}: cannot be written into: {error}") from error
        try:
            self._open(resume)
        except OSError as error:
            self._lock.release()
            raise ValueError(f"{folder}: cannot be written into: {error}") from error
        except ValueError:
            self._lock.release()
            raise

    def _open(self, resume: bool) -> None:
        """Open metrics.csv, and clear away what a killed training was about to write."""
        mode = "r+" if resume else "a+"
        self._metrics = self.path(METRICS_FILE).open(mode, newline="", encoding="utf-8")
        self._writer = csv.writer(self._metrics, lineterminator="\n")
        try:
            self._hold()
            for folder in (self.folder, self.path(CHECKPOINTS)):
                if folder.is_dir():
                    remove_unfinished(folder)
            if not resume:
                self.restart()
        except BaseException:
            self._metrics.close()
            raise

    def _hold(self) -> None:
        """Lock metrics.csv as well: of a lock file that was deleted others have another one."""
        if fcntl is None:
            return
        try:
            fcntl.flock(self._metrics, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            raise ValueError(f"{self.folder}: another training is writing into it") from None
        except OSError:  # a file system without such locks
            pass

    def path(self, name: str) -> Path:
        """Where the file called `name` is in this run."""
        return self.folder / name

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Write config.json: `config`, and what it ran on."""
        self.write_json(CONFIG_FILE, {**config, "environment": describe_environment()})

    def write_json(self, name: str, content: object) -> None:
        """Write a JSON file in one piece."""
        text = json.dumps(content, indent=2, allow_nan=False) + "\n"
        write_bytes(self.path(name), text.encode(), MAX_TEXT_BYTES)

    def log(self, row: Mapping[str, object]) -> None:
        """Append one row to metrics.csv and hand it to the operating system at once."""
        self._write_row([row[column] for column in self.columns])

    def _write_row(self, values: Sequence[object]) -> None:
        self._writer.writerow([f"{v:.9g}" if isinstance(v, float) else v for v in values])
        self._metrics.flush()

    def position(self) -> dict[str, Any]:
        """Force metrics.csv to the disk; return what is in it, for a checkpoint.

        Raises
        ------
        ValueError
            If there is another file in its place.
        OSError
            If there is none.
        """
        path = self.path(METRICS_FILE)
        os.fsync(self._metrics.fileno())
        if not os.path.samestat(os.fstat(self._metrics.fileno()), path.stat()):
            raise ValueError(f"{path}: is no longer the file that this training writes")
        content = read_metrics_file(self.folder)
        return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}

    def rows_at(self, position: Mapping[str, Any]) -> dict[str, list[float]]:
        """Return what was in metrics.csv when a checkpoint was written, by columns.

        Raises
        ------
        ValueError
            If it has changed since.
        """
        path = self.path(METRICS_FILE)
        content = read_metrics_file(self.folder)[: position["bytes"]]
        if hashlib.sha256(content).hexdigest() != position["sha256"]:
            raise ValueError(f"{path}: changed since the checkpoint was written")
        return parse_metrics(path, content)

    def rewind(self, position: Mapping[str, Any]) -> None:
        """Cut metrics.csv back to where a checkpoint was written; what came later comes again."""
        self._metrics.truncate(position["bytes"])
        self._metrics.seek(position["bytes"])

    def restart(self) -> None:
        """Cut metrics.csv back to its header."""
        self._metrics.seek(0)
        self._metrics.truncate(0)
        self._write_row(self.columns)

    def close(self) -> None:
        """Close metrics.csv and release the folder."""
        with contextlib.suppress(OSError):  # a row that has no room: that was said when it came
            self._metrics.close()
        self._lock.release()


def foreign_entry(folder: Path) -> str | None:
    """Return the name of something in a folder that was there before any training, None if all is.

    A training that is killed before its config is written leaves its lock, the file that was to be
    the config, and a metrics.csv without rows.
    """
    for path in sorted(folder.iterdir()):
        if path.name == METRICS_FILE and path.is_file() and path.stat().st_size < MAX_HEADER_BYTES:
            if b"\n" not in path.read_bytes()[:-1]:
                continue
        elif path.name == LOCK_FILE or UNFINISHED.fullmatch(path.name):
            continue
        return path.name
    return None


def default_folder(algorithm: str, preset: str, seed: int) -> Path:
    """Name a run folder after what is run and the time."""
    return Path("runs") / f"{algorithm}-{preset}-seed{seed}-{datetime.now():%Y%m%d-%H%M%S}"


def read_config(folder: Path) -> dict[str, Any]:
    """Read a run's config.json.

    Raises
    ------
    ValueError
        If the file is missing, too large, not a JSON object, or has an entry twice.
    """
    path = folder / CONFIG_FILE
    try:
        config = parse_json(read_bytes(path, MAX_TEXT_BYTES, "a config file", ValueError))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a readable config: {error}") from error
    if not isinstance(config, dict):
        raise ValueError(f"{path}: not a readable config: it is not a JSON object")
    return config


def read_metrics(folder: Path) -> dict[str, list[float]]:
    """Read a run's metrics.csv by columns; an empty field is NaN, a torn last row is left out.

    Raises
    ------
    ValueError
        If the file is missing, too large, or not a table of numbers.
    """
    return parse_metrics(folder / METRICS_FILE, read_metrics_file(folder))


def read_metrics_file(folder: Path) -> bytes:
    """Read a run's metrics.csv as it is.

    Raises
    ------
    ValueError
        If the file is missing or too large.
    """
    return read_bytes(folder / METRICS_FILE, MAX_TEXT_BYTES, "a metrics file", ValueError)


def parse_metrics(path: Path, content: bytes) -> dict[str, list[float]]:
    """Return the columns of a metrics.csv; as :func:`read_metrics`."""
    text = content.decode("utf-8", errors="replace")
    lines = text[: text.rfind("\n") + 1].splitlines()
    if not lines:
        raise ValueError(f"{path}: no header line")
    columns = lines[0].split(",")
    if len(set(columns)) != len(columns):
        raise ValueError(f"{path}, line 1: a column is there twice")
    table: dict[str, list[float]] = {column: [] for column in columns}
    for number, line in enumerate(lines[1:], start=2):
        fields = line.split(",")
        if len(fields) != len(columns):
            raise ValueError(
                f"{path}, line {number}: {len(fields)} fields, expected {len(columns)}"
            )
        for column, field in zip(columns, fields, strict=True):
            try:
                table[column].append(float(field) if field else float("nan"))
            except ValueError:
                raise ValueError(f"{path}, line {number}: {column}: not a number") from None
    return table


def parse_json(text: str | bytes) -> Any:
    """Parse JSON, but refuse an entry that is there twice.

    Raises
    ------
    ValueError
        If it is no JSON, or has an entry twice.
    RecursionError
        If it is nested too deeply.
    """
    return json.loads(text, object_pairs_hook=unique_fields)


def describe_environment() -> dict[str, Any]:
    """Versions, commit, machine and command: what a reader needs to run this again."""
    versions: dict[str, str | None] = {"python": platform.python_version()}
    versions["mapp_env"] = mapp_env.__version__  # what runs, which need not be what is installed
    for package in VERSIONED:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = None
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": sys.argv,
        "versions": versions,
        "commit": git_commit(),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
    }


def git_commit() -> str | None:
    """Return the commit these baselines are at, "+changes" if edited since; None without git."""
    answers = []
    for command in (["rev-parse", "HEAD"], ["status", "--porcelain"]):
        try:
            answer = subprocess.run(
                ["git", *command],
                cwd=Path(__file__).parent,
                capture_output=True,
                text=True,
                timeout=10,
                check=True,
            )
        except (OSError, subprocess.SubprocessError):
            return None
        answers.append(answer.stdout.strip())
    return answers[0] + ("+changes" if answers[1] else "")


class StopSignals:
    """Turns Ctrl-C and SIGTERM into a question the training loop asks between two steps.

    The first signal is only noted, so that weights and metrics are never caught half-way; a
    second one interrupts as usual.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict[int, Any] = {}

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            raise KeyboardInterrupt
        self.received = number

    def __enter__(self) -> "StopSignals":
        if threading.current_thread() is threading.main_thread():  # Python allows it only there
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)


class Stopwatch:
    """Adds up where the time goes: each lap is booked under a name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Book the time since the last lap under `name`."""
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now

    @property
    def total(self) -> float:
        """Seconds of all laps, those before a resumption included."""
        return sum(self.seconds.values())

    def __str__(self) -> str:
        total = max(self.total, 1e-9)
        parts = [f"{name} {100 * s / total:.0f} %" for name, s in self.seconds.items()]
        return f"{self.total:.1f} s: " + ", ".join(parts)
