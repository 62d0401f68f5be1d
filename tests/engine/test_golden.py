"""Version 0 plays today what it played when it was released."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest
from model import PAPER_ROWS, Model

FOLDER = Path(__file__).resolve().parent / "golden"
SPEC = importlib.util.spec_from_file_location("golden_make", FOLDER / "make.py")
assert SPEC is not None
assert SPEC.loader is not None
golden = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(golden)


def stored(name: str) -> list[dict[str, Any]]:
    """Return the recorded episodes of a setting."""
    return json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("index", range(len(golden.SEEDS)))
@pytest.mark.parametrize("name", golden.SETTINGS)
def test_trajectory_is_the_recorded_one(name: str, index: int) -> None:
    """Landmarks drawn, rewards, observations, masks and metrics are the recorded ones."""
    assert golden.play(name, golden.SEEDS[index]) == stored(name)[index]


@pytest.mark.parametrize("name", golden.SETTINGS)
def test_recorded_trajectory_obeys_the_rules(name: str) -> None:
    """The records themselves are right: the independent model plays the same episodes."""
    setting = golden.SETTINGS[name]
    rows = PAPER_ROWS
    if "grid" in setting:
        rows = tuple(setting["grid"].replace("@", "#").split())
    for record in stored(name):
        model = Model(
            rows,
            tuple(record["landmarks"]),
            setting.get("n_agents", 3),
            setting.get("reward", "manhattan"),
            setting.get("allow_wait", False),
            setting.get("max_cycles", 50),
        )
        rewards = [model.step(actions)[0] for actions in record["actions"]]
        assert rewards == record["rewards"]
        assert model.ended
        assert model.terminated is record["terminated"]
        assert model.global_observation() == record["final_state"]
        metrics = {
            key: None if value == float("inf") else value for key, value in model.metrics().items()
        }
        assert metrics == record["metrics"]


def test_records_hold_both_endings() -> None:
    """The records hold terminated and truncated episodes, and exactly the settings played."""
    records = [record for name in golden.SETTINGS for record in stored(name)]
    endings = [record["terminated"] for record in records]
    assert endings.count(True) >= 4
    assert endings.count(False) >= 4
    assert {path.stem for path in FOLDER.glob("*.json")} == set(golden.SETTINGS)
