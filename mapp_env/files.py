"""Files that strangers may have written: read with suspicion, written whole or not at all.

A file holds one JSON object: ``format`` and ``version`` say what it is, every other field is
required, none may be added. Numbers are finite, no key comes twice, ``true`` is no number.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import pathlib
import re
import secrets
import stat
from collections.abc import Iterable, Mapping
from typing import Any

from mapp_env.validation import describe

__all__ = [
    "MAX_PLAN_BYTES",
    "MAX_PROBLEM_BYTES",
    "FileError",
    "Record",
    "check_writable",
    "labelled",
    "make_folder",
    "read_bytes",
    "read_record",
    "remove_unfinished",
    "unique_fields",
    "write_bytes",
    "write_record",
    "write_text",
]

VERSION = 1

MAX_PROBLEM_BYTES = 1 << 20
"""Largest problem file: the text of a 512 x 512 grid takes about a quarter of it."""

MAX_PLAN_BYTES = 16 << 20
"""Largest plan file: sixteen agents that act, and walk, for half a million steps each.

On a 512 x 512 grid a shortest path, which leaves a third of the cells aside, and the way back take
350,000.
"""

MAX_MARKS = 1_000
"""Most brackets, colons and quotes in a file: a parser may need a second for millions of them."""

MAX_INTEGER = 2**53 - 1  # what every reader of JSON keeps exactly
MAX_PATH_LETTERS = 320  # of a path in a message
MAX_LINKS = 40  # as Linux follows at most
STREAMS = ("/proc/", "/dev/fd/")  # where a process finds the files it has open
UNFINISHED = re.compile(r"\.[0-9a-f]{16}\.tmp")  # until it is whole and takes its name


class FileError(ValueError):
    """A file that cannot be used; the message names its path and what is wrong."""


class Record:
    """An object of a file, of which each field is taken once.

    Parameters
    ----------
    where : str
        How messages call it: the path, and the field it stands in.
    fields : dict
        Its fields.
    """

    def __init__(self, where: str, fields: dict[str, Any]) -> None:
        self.where = where
        self._left = fields

    def take(self, name: str) -> Any:
        """Return a field's value, whatever it is."""
        if name not in self._left:
            raise FileError(f"{self.where}: lacks the field {name!r}")
        return self._left.pop(name)

    def error(self, name: str, rule: str, value: object = ...) -> FileError:
        """Return the error that says what a field must be, and what it is, if given."""
        got = "" if value is ... else f", got {_shown(value)}"
        return FileError(f"{self.where}: field {name!r} {rule}{got}")

    def record(self, name: str) -> Record:
        """Return a field that is an object."""
        value = self.take(name)
        if type(value) is not dict:
            raise self.error(name, "must be an object", value)
        return Record(f"{self.where}: field {name!r}", value)

    def number(self, name: str, null: Any = ...) -> Any:
        """Return a field that is a whole number from 0, or ``null`` for a null, if given."""
        value = self.take(name)
        if value is None and null is not ...:
            return null
        if type(value) is not int or not 0 <= value <= MAX_INTEGER:
            raise self.error(name, f"must be an integer in 0..{MAX_INTEGER}", value)
        return value

    def real(self, name: str) -> float:
        """Return a field that is a finite number from 0."""
        value = self.take(name)
        if type(value) not in (int, float) or not 0 <= value <= MAX_INTEGER:
            raise self.error(name, f"must be a number in 0..{MAX_INTEGER}", value)
        return float(value)

    def text(self, name: str, limit: int) -> str:
        """Return a field that is a string of at most ``limit`` characters."""
        value = self.take(name)
        if type(value) is not str or len(value) > limit:
            raise self.error(name, f"must be a string of at most {limit} characters", value)
        return value

    def choice(self, name: str, allowed: Iterable[str]) -> str:
        """Return a field that is one of some strings."""
        value = self.take(name)
        options = tuple(allowed)
        if type(value) is not str or value not in options:
            raise self.error(name, f"must be one of {', '.join(options)}", value)
        return value

    def cells(self, name: str) -> tuple[int, ...]:
        """Return a field that is a list of whole numbers from 0."""
        return self._cells(name, self.take(name))

    def cell_lists(self, name: str, count: int) -> tuple[tuple[int, ...], ...]:
        """Return a field that is a list of ``count`` lists of whole numbers from 0."""
        value = self._list(name, count)
        return tuple(self._cells(f"{name}[{index}]", line) for index, line in enumerate(value))

    def holds_strings(self, name: str) -> bool:
        """Return whether a field is there and a list of strings alone; it is not taken."""
        value = self._left.get(name)
        return type(value) is list and all(type(line) is str for line in value)

    def strings(self, name: str, count: int, letters: str) -> tuple[str, ...]:
        """Return a field that is a list of ``count`` strings of certain letters."""
        value = self._list(name, count)
        if not all(type(line) is str and set(line) <= set(letters) for line in value):
            raise self.error(name, f"must be strings of {letters!r}", value)
        return tuple(value)

    def finish(self) -> None:
        """Raise an error if a field was not taken."""
        for name in self._left:
            raise FileError(f"{self.where}: has an unknown field {describe(name)}")

    def _list(self, name: str, count: int) -> list[Any]:
        value = self.take(name)
        if type(value) is not list or len(value) != count:
            raise self.error(name, f"must be a list of {count}", value)
        return value

    def _cells(self, name: str, value: object) -> tuple[int, ...]:
        if type(value) is not list:
            raise self.error(name, "must be a list", value)
        for item in value:
            if type(item) is not int or not 0 <= item <= MAX_INTEGER:
                raise self.error(name, f"must hold integers in 0..{MAX_INTEGER}", item)
        return tuple(value)


# -- reading ---------------------------------------------------------------


def read_record(path: str | os.PathLike[str], kind: str, limit: int) -> Record:
    """Read a file of one JSON object and check what it says it is.

    Parameters
    ----------
    path : str or os.PathLike
        A regular file.
    kind : str
        What it must be: "problem" or "plan".
    limit : int
        Largest size in bytes.

    Returns
    -------
    Record
        The fields but for ``format`` and ``version``.

    Raises
    ------
    FileError
        If the file cannot be read, is not strict JSON, or is of another kind or version.
    """
    data = read_bytes(path, limit, f"a {kind} file", FileError)
    where = os.fspath(path)
    if sum(map(data.count, (b"[", b"{", b":", b'"'))) > MAX_MARKS:
        raise FileError(
            f"{where}: is no {kind} file: has more than {MAX_MARKS} brackets, colons and quotes"
        )
    try:
        value = json.loads(
            data.decode("utf-8"),
            object_pairs_hook=unique_fields,
            parse_constant=_refuse_constant,
            parse_float=_finite,
        )
    except RecursionError:
        raise FileError(f"{where}: is nested too deeply") from None
    except ValueError as error:  # of JSON, of UTF-8, of the three checks above
        raise FileError(f"{where}: is not strict JSON: {error}") from error
    if type(value) is not dict:
        raise FileError(f"{where}: must hold a JSON object, got {_shown(value)}")
    record = Record(where, value)
    record.choice("format", [f"mapp_env {kind}"])
    version = record.number("version")
    if version != VERSION:
        raise record.error("version", f"must be {VERSION}", version)
    return record


def read_bytes(
    path: str | os.PathLike[str], limit: int, what: str, error_type: type[ValueError]
) -> bytes:
    """Return the content of a regular file.

    Nothing is read before the file is known to be regular, so that a pipe or a device cannot
    block.

    Parameters
    ----------
    path : str or os.PathLike
        The file.
    limit : int
        Largest size in bytes.
    what : str
        How messages call such a file: "a map file".
    error_type : type
        What is raised.

    Raises
    ------
    ValueError
        As ``error_type``, if the file cannot be opened, is not regular or is too large.
    """
    if not isinstance(path, str | os.PathLike):
        raise error_type(f"path must be a str or os.PathLike, got {describe(path)}")
    source = os.fspath(path)
    try:
        # Non-blocking: opening a FIFO that nobody writes to would otherwise wait for ever.
        handle = os.open(source, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except (OSError, ValueError) as error:
        raise error_type(f"{_named(source)}: cannot be opened as {what}: {error}") from error
    try:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise error_type(f"{source}: is not a regular file")
        if status.st_size > limit:
            raise error_type(f"{source}: has {status.st_size} bytes, {what} may have {limit}")
        with os.fdopen(handle, "rb", closefd=False) as file:
            # Again: the file may have grown since.
            data = file.read(limit + 1)
    except OSError as error:
        raise error_type(f"{source}: cannot be read: {error}") from error
    finally:
        os.close(handle)
    if len(data) > limit:
        raise error_type(f"{source}: has more than {limit} bytes, which {what} may have")
    return data


def _named(path: str | os.PathLike[str]) -> str:
    """Return a path for a message, whole unless it is absurdly long."""
    return describe(os.fspath(path), MAX_PATH_LETTERS)


def _shown(value: object) -> str:
    """Return a value of a file for a message; to print a list could take long, or nest too deep."""
    if isinstance(value, list | dict):
        return f"a {type(value).__name__} of {len(value)}"
    return describe(value)


def unique_fields(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of JSON, but refuse one with a key twice: two readers could differ on it."""
    fields = dict(pairs)
    if len(fields) < len(pairs):
        raise ValueError("an object has the same key twice")
    return fields


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{describe(text)} is too large a number")
    return number


# -- writing ---------------------------------------------------------------


def write_record(
    path: str | os.PathLike[str], kind: str, fields: Mapping[str, Any], limit: int
) -> None:
    """Write one JSON object, one field a line, as :func:`read_record` reads it.

    Raises
    ------
    FileError
        If it would be larger than ``limit`` bytes, or cannot be written.
    """
    lines = [
        f" {json.dumps(name)}: {json.dumps(value, allow_nan=False)}"
        for name, value in labelled(kind, fields).items()
    ]
    write_text(path, "{\n" + ",\n".join(lines) + "\n}\n", limit)


def labelled(kind: str, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a file with what says that it is one."""
    return {"format": f"mapp_env {kind}", "version": VERSION, **fields}


def write_text(path: str | os.PathLike[str], text: str, limit: int) -> None:
    """Write a text file as :func:`write_bytes` does."""
    write_bytes(path, text.encode("utf-8"), limit)


def write_bytes(path: str | os.PathLike[str], data: bytes, limit: int) -> None:
    """Write a file whole or not at all: beside it first, then in its place.

    A file that was there keeps its mode; of a link, what it leads to is replaced; another name of
    the same file (a hard link) keeps the old content.

    Parameters
    ----------
    path : str or os.PathLike
        The file; if it is there it must be a regular one that its owner may write.
    data : bytes
        Its content.
    limit : int
        Largest size in bytes.

    Raises
    ------
    FileError
        If there is too much or the file cannot be written; an earlier file is left as it was.
    """
    target = check_writable(path)
    if len(data) > limit:
        raise FileError(f"{os.fspath(path)}: would have {len(data)} bytes, allowed are {limit}")
    try:
        _replace(target, data)
    except (OSError, ValueError) as error:
        raise FileError(f"{_named(path)}: cannot be written: {error}") from error


def check_writable(path: str | os.PathLike[str]) -> str:
    """Return what a path leads to, if a file could stand there.

    For what takes long to make, so that a slip of the pen is noticed before.

    Raises
    ------
    FileError
        If it is no path, its folder is not there, or there is something already that is no file or
        may not be written.
    """
    if not isinstance(path, str | os.PathLike):
        raise FileError(f"path must be a str or os.PathLike, got {describe(path)}")
    try:
        target = _follow(os.fsdecode(path))
        os.stat(os.path.dirname(target))
        status = os.stat(target) if os.path.lexists(target) else None
    except (OSError, ValueError) as error:
        raise FileError(f"{_named(path)}: cannot be written: {error}") from error
    if target.startswith(STREAMS) or (status is not None and not stat.S_ISREG(status.st_mode)):
        raise FileError(f"{_named(path)}: is there and not a regular file")
    # To replace a file takes no right to write it; and to root no file is read-only.
    if status is not None and not (status.st_mode & stat.S_IWUSR and os.access(target, os.W_OK)):
        mode = f"{stat.S_IMODE(status.st_mode):04o}"
        raise FileError(f"{_named(path)}: is there and may not be written: its mode is {mode}")
    return target


def _follow(path: str) -> str:
    """Return what a path leads to through links, but for the streams of a process.

    ``/dev/stdout`` may lead to a log: to write it is to append to it, not to replace it.
    """
    for _ in range(MAX_LINKS):
        folder, name = os.path.split(path)
        path = os.path.join(os.path.realpath(folder), name)
        if path.startswith(STREAMS) or not os.path.islink(path):
            return os.path.normpath(path)
        path = os.path.join(os.path.dirname(path), os.readlink(path))
    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))


def remove_unfinished(folder: str | os.PathLike[str]) -> None:
    """Remove what writers that were killed have left beside their files.

    Only for a folder that nobody else writes into.
    """
    with os.scandir(folder) as entries:
        for entry in entries:
            if UNFINISHED.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                os.unlink(entry)


def _replace(target: str, data: bytes) -> None:
    """Put a file in the place of ``target`` so that a crash leaves the old or the new one."""
    folder = os.path.dirname(target)
    beside = os.path.join(folder, f".{secrets.token_hex(8)}.tmp")
    try:
        earlier = os.stat(target) if os.path.exists(target) else None
        # The user's file mode mask applies to a new file; an old one may be nobody else's to read.
        mode = 0o666 if earlier is None else 0o600
        handle = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(handle, "wb") as file:
            if earlier is not None:
                _take_after(file.fileno(), earlier)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, target)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(beside)
        raise
    _sync(folder)


def make_folder(path: str | os.PathLike[str]) -> None:
    """Make a folder and those above it, if they are not there, and force their names to the disk.

    Raises
    ------
    OSError
        If one cannot be made.
    """
    folder = pathlib.Path(path)
    new = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for place in new:
        _sync(place.parent)


def _sync(folder: str | os.PathLike[str]) -> None:
    """Force a folder to the disk: only then a new name is there after a crash of the machine.

    One that cannot be opened (a drop box) or forced to the disk (a share) is no failure: what it
    holds is there already.
    """
    if os.name == "posix":
        with contextlib.suppress(OSError):
            handle = os.open(folder, os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)


def _take_after(handle: int, earlier: os.stat_result) -> None:
    """Give a file owner, group and mode of an earlier one, as far as this user can."""
    if os.name == "posix":
        for owner in (earlier.st_uid, -1):  # if not whose it was, then the group
            with contextlib.suppress(OSError):
                os.chown(handle, owner, earlier.st_gid)
                break
        with contextlib.suppress(OSError):  # as on disks that have no modes
            os.chmod(handle, stat.S_IMODE(earlier.st_mode))
