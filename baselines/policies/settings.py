"""What the agents have to do: from names and run folders to settings."""

from dataclasses import dataclass
from pathlib import Path

from baselines.networks import NetworkSpec
from baselines.runs.folder import CONFIG_FILE, read_config
from mapp_env import Grid, Problem
from mapp_env.validation import check_count

N_ACTIONS = 4


@dataclass(frozen=True)
class Setting:
    """What the agents have to do, but for the landmarks' places."""

    grid: Grid
    n_agents: int = 3
    n_landmarks: int = 5
    max_cycles: int = 50


def read_grid(folder: Path) -> Grid:
    """Read from a run folder which grid was trained on.

    Raises
    ------
    ValueError
        If the run's config does not say it.
    """
    config = read_config(folder)
    try:
        return Grid.from_text(config["grid"])
    except KeyError as error:
        raise ValueError(f"{folder / CONFIG_FILE}: no entry {error}") from error
    except ValueError as error:
        raise ValueError(f"{folder / CONFIG_FILE}: grid: {error}") from error


def read_setting(folder: Path) -> tuple[Setting, list[tuple[int, ...]]]:
    """Read from a run folder what was trained: the setting, and the training problems.

    Raises
    ------
    ValueError
        If the run's config does not say it, or says what cannot be.
    """
    config = read_config(folder)
    where = f"{folder / CONFIG_FILE}"
    try:
        options, rows = config["options"], config["training_problems"]
        if not isinstance(options, dict) or not isinstance(rows, list):
            raise ValueError("options must be an object, training_problems a list")
        setting = Setting(
            Grid.from_text(config["grid"]),
            options["n_agents"],
            options["n_landmarks"],
            options["max_cycles"],
        )
        check_count("n_agents", setting.n_agents, 1, 16)
        check_count("n_landmarks", setting.n_landmarks, 1, 256)
        check_count("max_cycles", setting.max_cycles, 1, 1_000_000)
    except KeyError as error:
        raise ValueError(f"{where}: no entry {error}") from error
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error
    problems = []
    for index, landmarks in enumerate(rows):
        try:
            cells = Problem(setting.grid, landmarks).landmarks
        except ValueError as error:
            raise ValueError(f"{where}: training_problems[{index}]: {error}") from error
        if len(cells) != setting.n_landmarks:
            raise ValueError(
                f"{where}: training_problems[{index}]: must have {setting.n_landmarks} landmarks, "
                f"got {len(cells)}"
            )
        problems.append(cells)
    return setting, problems


def check_fits(spec: NetworkSpec, setting: Setting, folder: Path) -> None:
    """Refuse a run whose config and weights tell of different tasks.

    Raises
    ------
    ValueError
        If grid size, number of agents, landmarks or actions differ.
    """
    told = {
        "n_cells": setting.grid.n_cells,
        "n_agents": setting.n_agents,
        "n_landmarks": setting.n_landmarks,
        "n_actions": N_ACTIONS,
    }
    for name, value in told.items():
        if getattr(spec, name) != value:
            raise ValueError(
                f"{folder}: {name} is {value} by {CONFIG_FILE}, and {getattr(spec, name)} by the "
                "weights"
            )
    if spec.grid and Grid.from_text(spec.grid) != setting.grid:
        raise ValueError(f"{folder}: the grid is another one by {CONFIG_FILE} than by the weights")
