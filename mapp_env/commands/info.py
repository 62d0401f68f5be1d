"""Show versions, the cache of compiled code and the machine.

For example:
  for people, and for a bug report
    python -m mapp_env info
  for a program
    python -m mapp_env info --json
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from importlib import metadata
from typing import Any

from mapp_env import __version__
from mapp_env.commands.reports import add_json_option, print_report, words
from mapp_env.compiled import cache_files, cache_folders, is_compiled

PACKAGES = ("numpy", "numba", "gymnasium", "pettingzoo", "pillow")
EXTRAS = (
    *("matplotlib", "pygame-ce", "pyvrp", "torch", "supersuit", "stable-baselines3"),
    *("sb3-contrib", "torchrl", "ray"),
)

# In a process of its own: importing torch takes seconds, and a broken one must not take this along.
ACCELERATOR = """
import torch
accelerated = torch.cuda.is_available()
print(torch.cuda.get_device_name(0) if accelerated else f"none, torch {torch.__version__}")
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> None:
    """Print what runs here."""
    # Its own is that of what runs, which need not be what is installed.
    own = {"python": platform.python_version(), "mapp-env": __version__}
    files = cache_files()
    record: dict[str, Any] = {
        "versions": {**own, **versions_of(PACKAGES)},
        "extras": versions_of(EXTRAS),
        "compiled_code": {
            "compiled": is_compiled(),
            "cache": [str(folder) for folder in cache_folders()],
            "files": len(files),
            "bytes": sum(path.stat().st_size for path in files),
        },
        "device": {
            "platform": platform.platform(),
            "processor": platform.machine(),
            "cores": os.cpu_count(),
            "accelerator_for_learners": _accelerator(),
        },
    }
    lines = []
    for part, entries in record.items():
        lines.append(words(part))
        lines += [f"  {words(name):<25} {_shown(value)}" for name, value in entries.items()]
    print_report(arguments, record, lines)


def versions_of(packages: Iterable[str]) -> dict[str, str | None]:
    """Return which versions are installed; none of them is imported."""
    found: dict[str, str | None] = {}
    for name in packages:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found


def _accelerator() -> str | None:
    """Return what torch would compute on beside the processor; None without torch."""
    if versions_of(("torch",))["torch"] is None:
        return None
    done = subprocess.run(  # -P: not a torch.py of the working folder
        [sys.executable, "-P", "-c", ACCELERATOR], capture_output=True, text=True, check=False
    )
    return done.stdout.strip() if done.returncode == 0 else "torch cannot be imported"


def _shown(value: object) -> str:
    if value is None:
        return "not installed"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(value) or "none"
    return f"{value:,}" if isinstance(value, int) else str(value)
