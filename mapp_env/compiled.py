"""How the kernels are compiled: the one place that knows numba's options."""

from __future__ import annotations

from typing import Any

from numba import njit

__all__ = ["kernel"]

# Compiled code is kept beside the source or, where that is read-only, in the user's cache folder.
# Rules are small functions: without inlining, calls would take half of a batched step. (`Any`, as
# numba's own types say nothing of what a decorated function takes and returns.) Kernels allocate
# nothing, so they go without numba's reference counts: each slice of an array would cost two atomic
# operations, together another half.
#
# Who edits a kernel that others call: numba notices a change of the file that a cached function
# stands in, not of the files it calls into. Delete mapp_env/__pycache__ then; the tests use a cache
# of their own for each state of the sources.
kernel: Any = njit(cache=True, forceinline=True, _nrt=False)  # type: ignore[call-overload]
