"""Run folders: what a training leaves behind, written so that a stopped run stays readable.

=================== ==============================================================
config.json         every option, the training problems, versions, commit
metrics.csv         a row per finished episode (of an imitation: per 100 updates)
policy.safetensors  the network's weights (``policies.load_policy`` reads them)
timing.json         where the time went; the only file with wall times of the run
checkpoints/        the last two checkpoints (``checkpoints.Checkpoints``)
evaluation.csv/.md  the table over unseen problems
fig*.png            the paper's figures 2, 3 and 4
=================== ==============================================================

metrics.csv holds no wall time: two runs with one seed write the same bytes. Each of its rows is
handed to the operating system at once; all other files are written whole or not at all.
"""

import contextlib
import csv
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from baselines.runs.provenance import describe_environment
from mapp_env.files import (
    UNFINISHED,
    make_folder,
    read_bytes,
    read_json,
    remove_unfinished,
    write_text,
)

try:
    import fcntl
except ImportError:  # Windows, where nobody can delete a file that is open
    fcntl = None  # type: ignore[assignment]

CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.csv"
WEIGHTS_FILE = "policy.safetensors"
TIMING_FILE = "timing.json"
EVALUATION_FILE = "evaluation.csv"  # the last file that counts: with it a run is through
CHECKPOINTS = "checkpoints"
LOCK_FILE = ".lock"
MAX_TEXT_BYTES = 64 * 1024 * 1024  # no file of ours comes near; refuse to read more
MAX_HEADER_BYTES = 1024  # of metrics.csv


class RunFolder:
    """The folder of one training, with its metrics.csv open, locked until it is closed.

    It must not exist, or be empty, unless a run is resumed. (A training that was killed before its
    config was written has left nothing.)

    Raises a ValueError if the folder holds something already (or, to resume, no run), cannot be
    made, or another training has it open.
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
        with contextlib.ExitStack() as opened:
            try:
                opened.enter_context(FileLock(folder / LOCK_FILE).acquire(timeout=0))
                self._metrics = opened.enter_context(
                    self.path(METRICS_FILE).open(
                        "r+" if resume else "a+", newline="", encoding="utf-8"
                    )
                )
                self._lock_metrics()
                self._writer = csv.writer(self._metrics, lineterminator="\n")
                for place in filter(Path.is_dir, (folder, self.path(CHECKPOINTS))):
                    remove_unfinished(place)  # what a killed training was about to write
                if not resume:
                    self.restart()
            except Timeout:
                raise ValueError(f"{folder}: another training is writing into it") from None
            except OSError as error:
                raise ValueError(f"{folder}: cannot be written into: {error}") from error
            self._opened = opened.pop_all()

    def _lock_metrics(self) -> None:
        """Lock metrics.csv as well: a lock file that was deleted no longer keeps others out."""
        if fcntl is None:
            return
        try:
            fcntl.flock(self._metrics, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            raise ValueError(f"{self.folder}: another training is writing into it") from None
        except OSError:  # a file system without such locks
            pass

    def close(self) -> None:
        """Close metrics.csv and release the folder."""
        with contextlib.suppress(OSError):  # a row that has no room: that was said when it came
            self._opened.close()

    def path(self, name: str) -> Path:
        """Return where the file called `name` is in this run."""
        return self.folder / name

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Write config.json: `config`, and what it ran on."""
        self.write_json(CONFIG_FILE, {**config, "environment": describe_environment()})

    def write_json(self, name: str, content: object) -> None:
        """Write a JSON file in one piece."""
        text = json.dumps(content, indent=2, allow_nan=False) + "\n"
        write_text(self.path(name), text, MAX_TEXT_BYTES)

    # -- metrics.csv

    def log(self, row: Mapping[str, object]) -> None:
        """Append one row to metrics.csv and hand it to the operating system at once."""
        self._write_row([row[column] for column in self.columns])

    def _write_row(self, values: Sequence[object]) -> None:
        self._writer.writerow([f"{v:.9g}" if isinstance(v, float) else v for v in values])
        self._metrics.flush()

    def position(self) -> dict[str, Any]:
        """Force metrics.csv to the disk; return what is in it, for a checkpoint.

        Raises a ValueError if there is another file in its place, an OSError if there is none.
        """
        path = self.path(METRICS_FILE)
        os.fsync(self._metrics.fileno())
        if not os.path.samestat(os.fstat(self._metrics.fileno()), path.stat()):
            raise ValueError(f"{path}: is no longer the file that this training writes")
        content = read_bytes(path, MAX_TEXT_BYTES, "a metrics file", ValueError)
        return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}

    def rows_at(self, position: Mapping[str, Any]) -> dict[str, list[float]]:
        """Return what was in metrics.csv when a checkpoint was written, by columns.

        Raises a ValueError if it has changed since.
        """
        path = self.path(METRICS_FILE)
        content = read_bytes(path, MAX_TEXT_BYTES, "a metrics file", ValueError)
        content = content[: position["bytes"]]
        if hashlib.sha256(content).hexdigest() != position["sha256"]:
            raise ValueError(f"{path}: changed since the checkpoint was written")
        return parse_metrics(path, content)

    def rewind(self, position: Mapping[str, Any]) -> None:
        """Truncate metrics.csv to a checkpoint; later rows will be written again."""
        self._metrics.truncate(position["bytes"])
        self._metrics.seek(position["bytes"])

    def restart(self) -> None:
        """Cut metrics.csv back to its header."""
        self._metrics.seek(0)
        self._metrics.truncate(0)
        self._write_row(self.columns)


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


def read_config(folder: Path) -> dict[str, Any]:
    """Read a run's config.json.

    Raises a ValueError if the file is missing, too large, or no object of strict JSON.
    """
    path = folder / CONFIG_FILE
    config = read_json(path, MAX_TEXT_BYTES, "a config file", ValueError)
    if not isinstance(config, dict):
        raise ValueError(f"{path}: must hold a JSON object")
    return config


def read_metrics(folder: Path) -> dict[str, list[float]]:
    """Read a run's metrics.csv by columns; an empty field is NaN, a torn last row is left out.

    Raises a ValueError if the file is missing, too large, or not a table of numbers.
    """
    path = folder / METRICS_FILE
    return parse_metrics(path, read_bytes(path, MAX_TEXT_BYTES, "a metrics file", ValueError))


def parse_metrics(path: Path, content: bytes) -> dict[str, list[float]]:
    """Return the columns of a metrics.csv; as :func:`read_metrics`."""
    text = content.decode("utf-8", errors="replace")
    header, *lines = text[: text.rfind("\n") + 1].splitlines() or [""]
    columns = header.split(",")
    if not header:
        raise ValueError(f"{path}: no header line")
    if len(set(columns)) != len(columns):
        raise ValueError(f"{path}, line 1: a column is there twice")
    table: dict[str, list[float]] = {column: [] for column in columns}
    for number, line in enumerate(lines, start=2):
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
