"""How the kernels are compiled: the one place that knows numba's options."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

__all__ = ["cache_files", "cache_folders", "kernel"]


def _digest_sources() -> str:
    """Return a name for the present state of the package's sources."""
    digest = hashlib.sha256()
    folder = Path(__file__).parent
    for path in sorted([*folder.glob("*.py"), *folder.glob("solvers/*.py")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


_SOURCES = _digest_sources()
_KERNELS: list[Any] = []


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
    compiled = njit(cache=True, forceinline=True, _nrt=False)(function)  # type: ignore[call-overload]
    function.__qualname__ = name
    _KERNELS.append(compiled)
    return compiled


def cache_folders() -> list[Path]:
    """Return where compiled kernels are kept; nowhere if they are not compiled."""
    return sorted({Path(one.stats.cache_path) for one in _KERNELS if hasattr(one, "stats")})


def cache_files() -> list[Path]:
    """Return the files of compiled code that the present sources have left there."""
    return [path for folder in cache_folders() for path in sorted(folder.glob(f"*_{_SOURCES}-*"))]
