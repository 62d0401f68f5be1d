"""Files: untrusted input is validated, output is written atomically."""

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
from typing import Any

from mapp_env.validation import describe

MAX_PATH_LETTERS = 320  # of a path in a message
MAX_LINKS = 40  # as Linux follows at most
STREAMS = ("/proc/", "/dev/fd/")  # where a process finds the files it has open
UNFINISHED = re.compile(r"\.[0-9a-f]{16}\.tmp")  # until it is whole and takes its name


class FileError(ValueError):
    """A file that cannot be used; the message names its path and what is wrong."""


# -- reading ---------------------------------------------------------------


def read_bytes(
    path: str | os.PathLike[str], limit: int, what: str, error_type: type[ValueError]
) -> bytes:
    """Return the content of a regular file of at most ``limit`` bytes.

    Nothing is read before the file is known to be regular, so that a pipe or a device cannot
    block. Messages call such a file ``what``: "a map file".

    Raises a ValueError as ``error_type``, if the file cannot be opened, is not regular or is too
    large.
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


def read_json(
    path: str | os.PathLike[str],
    limit: int,
    what: str,
    error_type: type[ValueError] = FileError,
    max_marks: int | None = None,
) -> Any:
    """Return the value in a file of strict JSON: :func:`read_bytes`, then :func:`parse_json`.

    ``max_marks`` is the most brackets, colons and quotes that such a file may have: a parser may
    need a second for millions of them. By default there may be any number.
    """
    data = read_bytes(path, limit, what, error_type)
    where = os.fspath(path)
    if max_marks is not None and sum(map(data.count, (b"[", b"{", b":", b'"'))) > max_marks:
        raise error_type(f"{where}: has more than {max_marks} brackets, colons and quotes")
    return parse_json(data, where, error_type)


def parse_json(data: str | bytes, where: object, error_type: type[ValueError] = FileError) -> Any:
    """Return the value of a strict JSON text, UTF-8 if it is bytes.

    Numbers are finite, and no object has a key twice: two readers could differ on it. How large
    the text may be is for the caller to say; messages call it ``where``.

    Raises a ValueError as ``error_type``, if it is not strict JSON or nested too deeply.
    """
    try:
        return json.loads(
            data if isinstance(data, str) else data.decode("utf-8"),
            object_pairs_hook=_unique_fields,
            parse_constant=_finite,
            parse_float=_finite,
        )
    except RecursionError:
        raise error_type(f"{where}: is nested too deeply") from None
    except ValueError as error:
        raise error_type(f"{where}: is not strict JSON: {error}") from error


def _unique_fields(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of JSON, but refuse one with a key twice."""
    fields = dict(pairs)
    if len(fields) < len(pairs):
        raise ValueError("an object has the same key twice")
    return fields


def _finite(text: str) -> float:
    """Return a number that JSON has: not ``NaN``, ``Infinity`` or ``1e999``."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{describe(text)} is not a finite number")
    return number


def _named(path: str | os.PathLike[str]) -> str:
    """Return a path for a message, whole unless it is absurdly long."""
    return describe(os.fspath(path), MAX_PATH_LETTERS)


# -- writing ---------------------------------------------------------------


def write_text(path: str | os.PathLike[str], text: str, limit: int) -> None:
    """Write a text file as :func:`write_bytes` does."""
    write_bytes(path, text.encode("utf-8"), limit)


def write_bytes(path: str | os.PathLike[str], data: bytes, limit: int) -> None:
    """Write a file whole or not at all: beside it first, then in its place.

    A file that was there, which must be a regular one that its owner may write, keeps its mode; of
    a link, what it leads to is replaced; another name of the same file (a hard link) keeps the old
    content.

    Raises a FileError if there are more than ``limit`` bytes or the file cannot be written; an
    earlier file is left as it was.
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

    Lets a mistyped path fail before a long computation.

    Raises a FileError if it is no path, its folder is not there, or there is something already that
    is no file or may not be written.
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

    Raises an OSError if one cannot be made.
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
