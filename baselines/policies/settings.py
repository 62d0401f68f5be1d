"""What the agents have to do: from names and run folders to settings."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from baselines.policies.policy import NetworkPolicy, find_weights, load_policy
from baselines.runs.folder import CONFIG_FILE, read_config
from mapp_env import Grid, Problem
from mapp_env.engine.state import N_ACTIONS
from mapp_env.evaluation.problems import Group, group_rows
from mapp_env.problem import MAX_AGENTS, MAX_CYCLES, MAX_LANDMARKS
from mapp_env.validation import check_count


@dataclass(frozen=True)
class Setting:
    """What the agents have to do, but for the landmarks' places."""

    grid: Grid
    n_agents: int = 3
    n_landmarks: int = 5
    max_cycles: int = 50

    def problem(self, landmarks: tuple[int, ...]) -> Problem:
        """Return the problem of some landmarks.

        Raises a ValueError if there are not as many as in the setting, or one is invalid.
        """
        if len(landmarks) != self.n_landmarks:
            raise ValueError(
                f"landmarks must be {self.n_landmarks} cells for this policy, got {len(landmarks)}"
            )
        return Problem(self.grid, landmarks, self.n_agents, self.max_cycles)

    def group(self, landmarks: np.ndarray) -> Group:
        """Return problems, a row of landmarks each, as they are played together."""
        return group_rows(self.grid, landmarks, self.n_agents, self.max_cycles)


class PolicyOfRun(NamedTuple):
    """A trained policy, its task, and the problems that its training began with."""

    policy: NetworkPolicy
    setting: Setting
    problems: list[tuple[int, ...]]


def load_run(name: str | Path, device: str = "cpu") -> PolicyOfRun:
    """Load a policy and what its run folder says of it.

    Raises a ValueError if there is no such policy, or its folder does not say what it was trained
    for.
    """
    policy = load_policy(name, device)
    folder = find_weights(name).parent
    setting, problems = read_setting(folder)
    check_fits(policy, setting, folder)
    return PolicyOfRun(policy, setting, problems)


def read_setting(folder: Path) -> tuple[Setting, list[tuple[int, ...]]]:
    """Read from a run folder what was trained: the setting, and the training problems.

    Raises a ValueError if the run's config does not say it, or says something invalid.
    """
    config = read_config(folder)
    where = f"{folder / CONFIG_FILE}"
    try:
        options, rows = config["options"], config["training_problems"]
        if not isinstance(options, dict) or not isinstance(rows, list):
            raise ValueError("options must be an object, training_problems a list")
        setting = Setting(
            Grid.from_text(config["grid"]),
            check_count("n_agents", options["n_agents"], 1, MAX_AGENTS),
            check_count("n_landmarks", options["n_landmarks"], 1, MAX_LANDMARKS),
            check_count("max_cycles", options["max_cycles"], 1, MAX_CYCLES),
        )
        problems = []
        for index, landmarks in enumerate(rows):
            where = f"{folder / CONFIG_FILE}: training_problems[{index}]"
            problems.append(Problem(setting.grid, landmarks).landmarks)
            if len(problems[-1]) != setting.n_landmarks:
                raise ValueError(
                    f"must have {setting.n_landmarks} landmarks, got {len(problems[-1])}"
                )
    except KeyError as error:
        raise ValueError(f"{where}: no entry {error}") from error
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error
    return setting, problems


def check_fits(policy: NetworkPolicy, setting: Setting, folder: Path) -> None:
    """Raise a ValueError if a run's config and weights tell of different tasks."""
    spec = policy.spec
    for name, value in {
        "n_agents": setting.n_agents,
        "n_landmarks": setting.n_landmarks,
        "n_actions": N_ACTIONS,
    }.items():
        found = getattr(spec, name)
        if found != value and name not in spec.any_size:
            raise ValueError(
                f"{folder}: {name} is {value} by {CONFIG_FILE}, and {found} by the weights"
            )
    if policy.grid not in (None, setting.grid):
        raise ValueError(f"{folder}: the grid is another one by {CONFIG_FILE} than by the weights")
