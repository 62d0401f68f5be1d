"""Compiled code is kept where that works; where it does not, it is compiled anew."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
import pytest

from mapp_env import compiled

REPOSITORY = Path(__file__).resolve().parents[2]
DECORATORS = (compiled.kernel, compiled.nogil_kernel)
SUMS = "def combine(one, two):\n    return one + two\n"


class Sums:
    """A file with one function, compiled as each new process would."""

    def __init__(self, folder: Path) -> None:
        self.source = folder / "sums.py"
        self.kept = folder / "kept"

    def compile(self, decorator: Callable[[Any], Any], text: str = SUMS) -> Any:
        """Return the function, compiled when it is first called."""
        if not self.source.exists() or self.source.read_text(encoding="ascii") != text:
            self.source.write_text(text, encoding="ascii")
        spec = importlib.util.spec_from_file_location("sums", self.source)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return decorator(module.combine)

    @property
    def files(self) -> list[Path]:
        """What is kept."""
        return sorted(self.kept.glob("*/*"))


@pytest.fixture
def sums(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sums:
    """Return such a file, whose compiled code is kept beside it."""
    monkeypatch.setattr(compiled, "_KERNELS", [])
    monkeypatch.setattr(compiled, "_TOLD", [])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # the file may change within a second
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kept"))
    return Sums(tmp_path)


@contextlib.contextmanager
def room_for(n_bytes: int) -> Iterator[None]:
    """Let no file grow larger, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def hits(function: Any) -> int:
    """Return how often compiled code was read from files."""
    return sum(function.stats.cache_hits.values())


@pytest.mark.parametrize("decorator", DECORATORS)
@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_damaged_files_are_compiled_anew(
    sums: Sums, decorator: Callable[[Any], Any], suffix: str
) -> None:
    """Files that are empty, cut short or overwritten are not read, but replaced."""
    assert sums.compile(decorator)(1, 2) == 3
    assert [path.suffix for path in sums.files] == [".nbc", ".nbi"]
    for damage in (
        lambda content: b"",
        lambda content: content[:1],
        lambda content: content[: len(content) // 2],
        lambda content: content[:-1],
        lambda content: bytes(len(content)),
        lambda content: b"\x80\x04]." + content,  # the pickle of an empty list
    ):
        (path,) = (path for path in sums.files if path.suffix == f".{suffix}")
        path.write_bytes(damage(path.read_bytes()))
        again = sums.compile(decorator)
        assert (again(1, 2), hits(again)) == (3, 0)
        reread = sums.compile(decorator)
        assert (reread(1, 2), hits(reread)) == (3, 1)


@pytest.mark.parametrize("decorator", DECORATORS)
def test_a_place_that_is_lost_is_warned_of_once(
    sums: Sums, decorator: Callable[[Any], Any]
) -> None:
    """A folder that cannot be written any more is one warning; everything is compiled and runs."""
    functions = [sums.compile(decorator) for _ in range(3)]
    shutil.rmtree(sums.kept)
    sums.kept.write_text("no folder", encoding="ascii")
    with pytest.warns(RuntimeWarning, match="NUMBA_CACHE_DIR") as told:
        assert [function(1, 2) for function in functions] == [3, 3, 3]
    assert len(told) == 1


def test_a_full_disk_leaves_no_older_code(sums: Sums) -> None:
    """Where the index could be written and the code could not, the code before is never run."""
    assert sums.compile(compiled.nogil_kernel)(1, 2) == 3
    code, index = (path.stat().st_size for path in sums.files)
    assert index < 2 * index < code
    changed = SUMS.replace("+", "*")
    with room_for(2 * index), pytest.warns(RuntimeWarning, match="too large"):
        assert sums.compile(compiled.nogil_kernel, changed)(1, 2) == 2
    assert sums.compile(compiled.nogil_kernel, changed)(1, 2) == 2


def test_nothing_is_read_from_the_working_folder(
    sums: Sums, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a home folder no file that lies in the working folder is taken for compiled code."""
    (tmp_path / "__pycache__").write_text("no folder", encoding="ascii")
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.chdir(tmp_path)
    with pytest.warns(RuntimeWarning, match="NUMBA_CACHE_DIR"):
        assert sums.compile(compiled.kernel)(1, 2) == 3
    assert not list(tmp_path.rglob("*.nb?"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "named")
    assert sums.compile(compiled.kernel)(1, 2) == 3
    assert {path.suffix for path in (tmp_path / "named").rglob("*.*.*")} == {".nbi", ".nbc"}


WITHOUT_A_PLACE = """
import json, warnings
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    import mapp_env, baselines.networks.pairs
    grid = mapp_env.make_grid()
    baselines.networks.pairs.routes(grid.moves[:1, None, :], grid.moves[:1], 49)
from mapp_env import compiled
assert compiled.is_compiled() and compiled.cache_folders() == compiled.cache_files() == []
print(json.dumps([str(one.message) for one in told]))
"""


def test_without_a_place_each_process_compiles(tmp_path: Path) -> None:
    """Where no folder can be written, everything starts and works after one warning."""
    for name in ("mapp_env", "baselines"):
        shutil.copytree(
            REPOSITORY / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "pre*")
        )
        for folder in [tmp_path / name, *filter(Path.is_dir, (tmp_path / name).rglob("*"))]:
            (folder / "__pycache__").write_text("no folder", encoding="ascii")
    nowhere = str(tmp_path / "mapp_env" / "__pycache__" / "below_a_file")
    environ = {"HOME": nowhere, "XDG_CACHE_HOME": nowhere, "NUMBA_CACHE_DIR": nowhere}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_A_PLACE],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path), **environ},
        capture_output=True,
        text=True,
        check=True,
    )
    (told,) = json.loads(done.stdout)
    assert "NUMBA_CACHE_DIR" in told
