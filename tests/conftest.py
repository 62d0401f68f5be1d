"""What every test needs before the package is imported: headless drawing, a private cache."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]


def _kernel_cache() -> Path:
    """Return a cache folder for compiled kernels that belongs to exactly these sources.

    numba notices a change of the file a kernel is in, but not of a file whose kernels it calls,
    so a folder shared by two versions of the package could serve stale code.
    """
    digest = hashlib.sha256()
    for path in sorted((REPOSITORY / "mapp_env").rglob("*.py")):
        digest.update(path.relative_to(REPOSITORY).as_posix().encode())
        digest.update(path.read_bytes())
    return REPOSITORY / ".pytest_cache" / "numba" / digest.hexdigest()[:16]


def _forget_old_caches(folder: Path) -> None:
    """Remove the caches of earlier sources beside ``folder`` that nobody wrote to for a day."""
    for other in folder.parent.glob("*"):
        if other != folder and time.time() - other.stat().st_mtime > 86_400:
            shutil.rmtree(other, ignore_errors=True)


# tests/model.py is imported by name, whatever the import mode.
sys.path.insert(0, str(Path(__file__).resolve().parent))

CACHE = _kernel_cache()
_forget_old_caches(CACHE)
os.environ.setdefault("NUMBA_CACHE_DIR", str(CACHE))
os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["SDL_AUDIODRIVER"] = "dummy"
os.environ.setdefault("MPLBACKEND", "Agg")

import hypothesis  # noqa: E402  (the environment above has to be set first)
import numpy as np  # noqa: E402
import pytest  # noqa: E402

hypothesis.settings.register_profile(
    "mapp_env",
    derandomize=True,
    deadline=None,
    database=None,
    max_examples=25,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("mapp_env")


def describe_difference(first: Any, second: Any, where: str = "") -> str | None:
    """Return where two nested results differ, or None; types, dtypes and shapes count too."""
    if type(first) is not type(second):
        return f"{where}: {type(first).__name__} {first!r} is not {second!r}"
    if isinstance(first, dict):
        if list(first) != list(second) and set(first) != set(second):
            return f"{where}: keys {sorted(first)} are not {sorted(second)}"
        for key in first:
            found = describe_difference(first[key], second[key], f"{where}[{key!r}]")
            if found:
                return found
        return None
    if isinstance(first, (list, tuple)):
        if len(first) != len(second):
            return f"{where}: length {len(first)} is not {len(second)}"
        for index, (a, b) in enumerate(zip(first, second, strict=True)):
            found = describe_difference(a, b, f"{where}[{index}]")
            if found:
                return found
        return None
    if isinstance(first, np.ndarray):
        if first.dtype != second.dtype or first.shape != second.shape:
            return f"{where}: {first.dtype}{first.shape} is not {second.dtype}{second.shape}"
        if first.dtype == object:
            return describe_difference(list(first.flat), list(second.flat), where)
        if first.tobytes() != second.tobytes():
            return f"{where}: {first!r} is not {second!r}"
        return None
    if isinstance(first, float):
        return None if repr(first) == repr(second) else f"{where}: {first!r} is not {second!r}"
    return None if first == second else f"{where}: {first!r} is not {second!r}"


@pytest.fixture(scope="session")
def same() -> Callable[[Any, Any], None]:
    """Return a check that two nested results are equal bit for bit."""

    def check(first: Any, second: Any) -> None:
        difference = describe_difference(first, second)
        assert difference is None, difference

    return check


BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER_OPTIONS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync"
)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium without a window, by Playwright.

    Where there is none the test is skipped; with MAPP_REQUIRE_CHROMIUM=1, as in continuous
    integration, it fails.
    """
    from playwright.sync_api import sync_playwright

    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        problem = f"no browser on the path: none of {', '.join(BROWSERS)}"
        if os.environ.get("MAPP_REQUIRE_CHROMIUM"):
            pytest.fail(problem)
        pytest.skip(problem)
    with sync_playwright() as driver:
        running = driver.chromium.launch(executable_path=program, args=BROWSER_OPTIONS.split())
        yield running
        running.close()


@pytest.fixture(scope="session", autouse=True)
def training_logs(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep the folders in which Stable-Baselines3 logs each training with the tests' own."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("sb3"))


@pytest.fixture(scope="session")
def forge() -> Callable[[Path, Path, Callable[[dict[str, Any], dict[str, Any]], object]], Path]:
    """Return what copies a run with one checkpoint that is changed, with digests made to fit."""
    import safetensors.numpy

    def digest(content: bytes) -> str:
        return hashlib.sha256(content).hexdigest()

    def canonical(record: dict[str, Any]) -> bytes:
        return (json.dumps(record, sort_keys=True) + "\n").encode()

    def forged(
        run: Path, copy: Path, change: Callable[[dict[str, Any], dict[str, Any]], object]
    ) -> Path:
        shutil.copytree(run, copy)
        (path,) = (copy / "checkpoints").glob("*.json")
        record = json.loads(path.read_text())
        arrays = safetensors.numpy.load_file(path.with_suffix(".safetensors"))
        change(arrays, record["state"])
        content = safetensors.numpy.save({k: np.asarray(v, order="C") for k, v in arrays.items()})
        record["arrays_sha256"] = digest(content)
        del record["sha256"]
        record["sha256"] = digest(canonical(record))
        path.write_bytes(canonical(record))
        path.with_suffix(".safetensors").write_bytes(content)
        return copy

    return forged
