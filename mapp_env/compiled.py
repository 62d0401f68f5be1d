"""How the kernels are compiled: the one place that knows numba's options."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import os
import time
import warnings
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

from numba import config, njit
from numba.core import event
from numba.core.caching import FunctionCache


def _digest_sources() -> str:
    """Return a name for the present state of the package's sources, in a folder or a zip."""
    digest = hashlib.sha256()
    folders = [resources.files(__package__)]
    for folder in folders:
        for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
            if entry.name.endswith(".py"):
                digest.update(entry.read_bytes())
            elif entry.is_dir():
                folders.append(entry)
    return digest.hexdigest()[:12]


_SOURCES = _digest_sources()
_KERNELS: list[Any] = []
_TOLD: list[str] = []  # why compiled code could not be kept: the first time is enough


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function at its first call, and keep the result for the next process.

    Rules are small functions: without inlining, calls would take half of a batched step. Kernels
    allocate nothing, so they go without numba's reference counts: each slice of an array would cost
    two atomic operations, together another half. (The result is `Any`, as numba's types say nothing
    of what a decorated function takes and returns.)

    numba keeps compiled code in files named after the function, beside the source or, where that is
    read-only, in the user's cache folder, and compiles anew when the file that the function stands
    in has changed; but a kernel also holds the code of those it calls, in other files. Hence a name
    that changes with any of them.
    """
    name = function.__qualname__
    function.__qualname__ = f"{name}_{_SOURCES}"
    compiled = _keep(njit(forceinline=True, _nrt=False)(function))  # type: ignore[call-overload]
    function.__qualname__ = name
    _KERNELS.append(compiled)
    return compiled


def nogil_kernel(function: Callable[..., Any]) -> Any:
    """Compile and keep a function that allocates, and that releases the GIL.

    Its files are named after it alone: it may call nothing that stands in another file.
    """
    return _keep(njit(nogil=True)(function))


def _keep(compiled: Any) -> Any:
    """Let a function's compiled code be kept in files, if there is a place for them.

    numba's own ``cache=True`` stops at the import where there is none, and at the first call where
    a file is damaged or cannot be written.
    """
    if hasattr(compiled, "stats"):  # else it is not compiled
        try:
            compiled._cache = _Files(compiled.py_func)
        except (OSError, RuntimeError) as error:
            _tell(error)
    return compiled


class _Files(FunctionCache):
    """What numba keeps of a function, read and written only where that works."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        # Without a home folder numba would trust what lies in the working folder's "~".
        folder: str = config.CACHE_DIR  # type: ignore[attr-defined]
        named = folder and Path(self.cache_path).is_relative_to(folder)
        if not (named or os.path.isabs(self.cache_path)):
            raise OSError("there is no home folder")

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return compiled code, or None if there is none that can be read."""
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception:  # of a file that is cut short, unpickling raises anything
            self._forget()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code, if it can be written."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except Exception as error:  # a full disk, or a damaged file that cannot be removed
            self._forget()
            _tell(error)

    def _forget(self) -> None:
        """Remove the function's files, the index first: it must not name older code."""
        pattern = f"{glob.escape(self._impl.filename_base)}.*nb[ci]"
        with contextlib.suppress(OSError):
            for path in sorted(Path(self.cache_path).glob(pattern), reverse=True):
                path.unlink(missing_ok=True)


def _tell(reason: Exception) -> None:
    """Warn, once in a process, that compiled code is not kept."""
    if not _TOLD:
        _TOLD.append(str(reason))
        warnings.warn(
            f"compiled code cannot be kept, so each process compiles anew ({reason}): set "
            "NUMBA_CACHE_DIR to a folder that can be written",
            RuntimeWarning,
            stacklevel=2,
        )


_COMPILING = event.TimingListener()  # type: ignore[no-untyped-call]
event.register("numba:compiler_lock", _COMPILING)  # type: ignore[no-untyped-call]


def clock() -> float:
    """Return seconds, on a clock that stands still while kernels are compiled or loaded.

    Solvers go by it: the first plan of an installation takes their time, not the compiler's.
    """
    return time.perf_counter() - (_COMPILING.duration if _COMPILING.done else 0.0)


def is_compiled() -> bool:
    """Return whether kernels are compiled, or run as plain Python."""
    return any(hasattr(one, "stats") for one in _KERNELS)


def cache_folders() -> list[Path]:
    """Return where compiled kernels are kept; nowhere if there is no place or nothing compiled."""
    paths = {one.stats.cache_path for one in _KERNELS if hasattr(one, "stats")} - {None}
    return sorted(map(Path, paths))


def cache_files() -> list[Path]:
    """Return the files of compiled code that the present sources have left there."""
    return [path for folder in cache_folders() for path in sorted(folder.glob(f"*_{_SOURCES}-*"))]
