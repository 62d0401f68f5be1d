"""The fields of problem and plan files, each taken and checked once.

A file holds one JSON object: ``format`` and ``version`` say what it is, every other field is
required, none may be added, and ``true`` is no number.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from typing import Any

from mapp_env.files import FileError, read_json, write_text
from mapp_env.validation import describe

VERSION = 2
"""Of the files that are written; those of version 1, without a problem's starts, are read, too."""

MAX_PROBLEM_BYTES = 8 << 20
"""Largest problem file: the text of a 2048 x 2048 grid takes about half of it."""

MAX_PLAN_BYTES = 24 << 20
"""Largest plan file: a problem, and sixteen agents that act, and walk, half a million steps each.

On a 512 x 512 grid a shortest path, which leaves a third of the cells aside, and the way back take
350,000.
"""

MAX_MARKS = 1_000  # of a file: brackets, colons and quotes
MAX_INTEGER = 2**53 - 1  # what every reader of JSON keeps exactly


class Record:
    """An object of a file, of which each field is taken once.

    ``where`` is how messages call it: the path, and the field it stands in; ``version`` is the
    file's.
    """

    def __init__(self, where: str, fields: dict[str, Any], version: int = VERSION) -> None:
        self.where = where
        self.version = version
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
        return Record(f"{self.where}: field {name!r}", value, self.version)

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

    def cells(self, name: str, null: Any = ...) -> Any:
        """Return a field that is a list of whole numbers from 0, or ``null`` for a null, if given.

        The list is returned as a tuple.
        """
        value = self.take(name)
        if value is None and null is not ...:
            return null
        return self._cells(name, value)

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


def _shown(value: object) -> str:
    """Return a value of a file for a message; to print a list could take long, or nest too deep."""
    if isinstance(value, list | dict):
        return f"a {type(value).__name__} of {len(value)}"
    return describe(value)


def read_record(path: str | os.PathLike[str], kind: str, limit: int) -> Record:
    """Return the fields of a "problem" or "plan" file of at most ``limit`` bytes.

    All but ``format`` and ``version``, which are checked.

    Raises a FileError if the file cannot be read, is not strict JSON, or is of another kind or
    version.
    """
    value = read_json(path, limit, f"a {kind} file", max_marks=MAX_MARKS)
    where = os.fspath(path)
    if type(value) is not dict:
        raise FileError(f"{where}: must hold a JSON object, got {_shown(value)}")
    record = Record(where, value)
    record.choice("format", [f"mapp_env {kind}"])
    version = record.number("version")
    if not 1 <= version <= VERSION:
        raise record.error("version", f"must be in 1..{VERSION}", version)
    record.version = version
    return record


def write_record(
    path: str | os.PathLike[str], kind: str, fields: Mapping[str, Any], limit: int
) -> None:
    """Write one JSON object, one field a line, as :func:`read_record` reads it.

    Raises a FileError if it would be larger than ``limit`` bytes, or cannot be written.
    """
    lines = [
        f" {json.dumps(name)}: {json.dumps(value, allow_nan=False)}"
        for name, value in labelled(kind, fields).items()
    ]
    write_text(path, "{\n" + ",\n".join(lines) + "\n}\n", limit)


def labelled(kind: str, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a file with what says that it is one."""
    return {"format": f"mapp_env {kind}", "version": VERSION, **fields}
