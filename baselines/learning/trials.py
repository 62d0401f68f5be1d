"""One training of a study: its name and folder, what starts it or goes on with it."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from filelock import FileLock, Timeout

from baselines.learning.config import Options, option_name, parse_options
from baselines.runs.folder import CONFIG_FILE, LOCK_FILE, foreign_entry, read_config

EVALUATION_FILE = "evaluation.csv"  # a training writes it when it is through
OWN_ENTRIES = ("out", "resume", "seed", "preset", "share_parameters", "threads")


class Trial(NamedTuple):
    """One training of a study."""

    group: tuple[
        str, ...
    ]  # what is summed up over the seeds: its cells of the table's first columns
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
    def command(self) -> list[str]:
        """What starts it, or goes on with it."""
        # -P: what lies in the working folder is none of its modules.
        return [sys.executable, "-P", "-m", f"baselines.{self.algorithm}", *self.arguments]

    @property
    def log(self) -> Path:
        """Where its output goes."""
        return self.folder.with_name(self.folder.name + ".log")


def plan_trial(
    group: tuple[str, ...],
    seed: int,
    out: Path,
    kind: tuple[str, type[Options]],
    own: Sequence[str],
    words: Sequence[str],
) -> Trial:
    """Return a training of a study.

    Parameters
    ----------
    group, seed, out
        What it is one of; its folder in `out` is named after them.
    kind
        Algorithm and options.
    own
        Words of the command line that make it what it is.
    words
        Further words, the same for all.

    Raises
    ------
    ValueError
        If an option is refused, or its folder holds a training with other options.
    """
    set_here = {*OWN_ENTRIES, *map(option_name, own)}
    for word in words:
        if word.startswith("--") and option_name(word) in set_here:
            raise ValueError(f"{word}: set for each training by the study itself")
    all_words = ("--seed", str(seed), *own, *words)
    options = parse_options(kind[1], "", all_words)
    if not options.evaluation_problems:
        raise ValueError("evaluation_problems must be at least 1 to compare, got 0")
    name = "-".join("_".join(cell.split()) for cell in (*group, f"seed{seed}"))
    trial = Trial(group, seed, out / name, kind[0], options, all_words)
    check_folder(trial)
    return trial


def check_folder(trial: Trial) -> None:
    """Refuse what was trained with other options, and what is no training.

    Raises
    ------
    ValueError
        If the folder holds anything else.
    """
    folder = trial.folder
    if not folder.is_dir():
        return
    if (folder / CONFIG_FILE).exists():
        config = read_config(folder)
        options = config.get("options")
        # As JSON has it.
        wanted = {**dataclasses.asdict(trial.options), "out": None, "resume": None}
        found = {**options, "out": None, "resume": None} if isinstance(options, dict) else {}
        differing = sorted(
            name for name in wanted | found if wanted.get(name) != found.get(name, wanted)
        )
        if config.get("algorithm") != trial.algorithm or differing:
            raise ValueError(
                f"out: {folder} holds another training: {', '.join(differing) or 'algorithm'} "
                "differ; use another folder"
            )
        return
    try:
        with FileLock(folder / LOCK_FILE, timeout=0):
            name = foreign_entry(folder)
            if name is not None:
                raise ValueError(f"out: {folder} holds something else: {name}")
    except Timeout:
        raise ValueError(f"out: another training is writing into {folder}") from None
