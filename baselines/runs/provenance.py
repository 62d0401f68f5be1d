"""What a run came from: versions, commit, machine and command, for a reader to run it again."""

import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import mapp_env

VERSIONED = ("numpy", "numba", "torch", "gymnasium", "pettingzoo", "safetensors")


def describe_environment() -> dict[str, Any]:
    """Return what a run starts with, ready for JSON."""
    versions: dict[str, str | None] = {"python": platform.python_version()}
    versions["mapp_env"] = mapp_env.__version__  # what runs, which need not be what is installed
    for package in VERSIONED:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = None
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": sys.argv,
        "versions": versions,
        "commit": git_commit(),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
    }


def git_commit() -> str | None:
    """Return the commit these baselines are at, "+changes" if edited since; None without git."""
    answers = []
    for command in (["rev-parse", "HEAD"], ["status", "--porcelain"]):
        try:
            answer = subprocess.run(
                ["git", *command],
                cwd=Path(__file__).parent,
                capture_output=True,
                text=True,
                timeout=10,
                check=True,
            )
        except (OSError, subprocess.SubprocessError):
            return None
        answers.append(answer.stdout.strip())
    return answers[0] + ("+changes" if answers[1] else "")
