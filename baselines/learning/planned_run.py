"""One training of a study: its name and folder, what starts it or goes on with it."""

import dataclasses
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from filelock import FileLock, Timeout

from baselines.learning.config import Options, option_name, parse_options
from baselines.runs.folder import (
    CONFIG_FILE,
    EVALUATION_FILE,
    LOCK_FILE,
    METRICS_FILE,
    foreign_entry,
    read_config,
)

# What a study sets for each run itself.
OWN_OPTIONS = ("out", "resume", "seed", "preset", "share_parameters", "threads", "prefetch")


class Run(NamedTuple):
    """One training of a study."""

    group: tuple[str, ...]  # what is summed up over the seeds: its row's first cells in the table
    seed: int
    folder: Path
    algorithm: str
    options: Options
    words: tuple[str, ...]  # its options, as words of a command line

    @property
    def name(self) -> str:
        """What it is called in messages."""
        return self.folder.name

    @property
    def finished(self) -> bool:
        """Whether it has been evaluated, the last thing that counts here."""
        return (self.folder / EVALUATION_FILE).is_file()

    @property
    def arguments(self) -> list[str]:
        """Words of the command line that start it, or go on with it."""
        if (self.folder / CONFIG_FILE).exists():
            return ["--resume", str(self.folder)]
        return [*self.words, "--out", str(self.folder)]

    @property
    def log(self) -> Path:
        """Where its output goes."""
        return self.folder.with_name(self.folder.name + ".log")

    def last_words(self) -> str:
        """Return the last line of its log that says something."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "ended without a word"

    def count_episodes(self) -> int:
        """Return how many episodes are in its metrics.csv so far."""
        try:
            return max((self.folder / METRICS_FILE).read_bytes().count(b"\n") - 1, 0)
        except OSError:
            return 0

    def start(self) -> subprocess.Popen[bytes]:
        """Start it in a process of its own, or go on with it."""
        root = str(Path(__file__).resolve().parents[2])
        paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
        with self.log.open("ab") as log:
            return subprocess.Popen(
                # -P: what lies in the working folder is none of its modules.
                [sys.executable, "-P", "-m", f"baselines.{self.algorithm}", *self.arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
                # Ctrl-C is for this process, which passes one signal on: a second would cut a
                # checkpoint short.
                start_new_session=True,
            )

    def check_folder(self) -> None:
        """Refuse what was trained with other options, and what is no training.

        Raises
        ------
        ValueError
            If its folder holds anything else.
        """
        folder = self.folder
        if not folder.is_dir():
            return
        if (folder / CONFIG_FILE).exists():
            config = read_config(folder)
            options = config.get("options")
            wanted = {**dataclasses.asdict(self.options), "out": None, "resume": None}
            found = {**options, "out": None, "resume": None} if isinstance(options, dict) else {}
            differing = sorted(
                name for name in wanted | found if wanted.get(name) != found.get(name, wanted)
            )
            if config.get("algorithm") != self.algorithm or differing:
                raise ValueError(
                    f"out: {folder} holds another training: "
                    f"{', '.join(differing) or 'algorithm'} differ; use another folder"
                )
            return
        try:
            with FileLock(folder / LOCK_FILE, timeout=0):
                name = foreign_entry(folder)
                if name is not None:
                    raise ValueError(f"out: {folder} holds something else: {name}")
        except Timeout:
            raise ValueError(f"out: another training is writing into {folder}") from None


def plan_run(
    group: tuple[str, ...],
    seed: int,
    out: Path,
    script: ModuleType,
    own: Sequence[str],
    words: Sequence[str],
) -> Run:
    """Return a run of a study.

    Parameters
    ----------
    group, seed, out
        What it is one of; its folder in `out` is named after them.
    script
        The learner's: ``baselines.meta_dqn``, say.
    own
        Words of the command line that make it what it is.
    words
        Further words, the same for all.

    Raises
    ------
    ValueError
        If an option is refused, or its folder holds a training with other options.
    """
    set_here = {*OWN_OPTIONS, *map(option_name, own)}
    for word in words:
        if word.startswith("--") and option_name(word) in set_here:
            raise ValueError(f"{word}: set for each training by the study itself")
    # With a process for each core a second thread gains nothing.
    all_words = ("--seed", str(seed), "--no-prefetch", *own, *words)
    options = parse_options(script.Args, "", all_words)
    if not options.evaluation_problems:
        raise ValueError("evaluation_problems must be at least 1 to compare, got 0")
    name = "-".join("_".join(cell.split()) for cell in (*group, f"seed{seed}"))
    run = Run(group, seed, out / name, script.ALGORITHM, options, all_words)
    run.check_folder()
    return run
