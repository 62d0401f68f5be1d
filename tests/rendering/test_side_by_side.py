"""Plans played side by side: each panel is its own animation, under what it is called and costs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

import mapp_env
from mapp_env.rendering import animate_plans, save_animation, side_by_side

PROBLEM = mapp_env.Problem(mapp_env.make_grid(), (0, 6, 20, 42, 48), 3, max_cycles=50)
OPTIMUM = mapp_env.solve(PROBLEM)
LONGER = mapp_env.replay(PROBLEM, mapp_env.solve(PROBLEM, "total_distance").joint_actions())
SIDE = 112


def read(path: Path) -> np.ndarray:
    """Return a GIF's frames, shape (frames, height, width, 3)."""
    with Image.open(path) as image:
        return np.array([np.array(f.convert("RGB")) for f in ImageSequence.Iterator(image)])


def test_panels_are_the_animations_of_their_plans(tmp_path: Path) -> None:
    """Below the captions each plan plays as alone; whoever is through stays as it is."""
    plans = {"longer": LONGER, "optimum": OPTIMUM}
    size = animate_plans(tmp_path / "both.gif", PROBLEM, plans, max_side=SIDE)
    assert size == (tmp_path / "both.gif").stat().st_size
    both = read(tmp_path / "both.gif")
    assert len(both) == LONGER.cover_time + 1 > OPTIMUM.cover_time + 1
    width = (both.shape[2] - side_by_side.BETWEEN) // 2
    for left, plan in ((0, LONGER), (width + side_by_side.BETWEEN, OPTIMUM)):
        save_animation(tmp_path / "one.gif", PROBLEM, plan.actions, max_side=SIDE)
        alone = read(tmp_path / "one.gif")
        panel = both[:, side_by_side.CAPTION :, left : left + width]
        # Both files have fewer colours than a GIF may, or nearly so.
        assert abs(panel[: len(alone)].astype(int) - alone).mean() < 0.5
        assert (panel[len(alone) :] == panel[len(alone) - 1]).all()


def test_captions_tell_costs_at_the_end(tmp_path: Path) -> None:
    """A caption's second line is empty until its plan is through, and not afterwards."""
    animate_plans(tmp_path / "one.gif", PROBLEM, {"optimum": OPTIMUM}, max_side=SIDE)
    lines = read(tmp_path / "one.gif")[:, 6 + side_by_side.LINE : side_by_side.CAPTION - 4]
    written = [len(np.unique(line.reshape(-1, 3), axis=0)) > 1 for line in lines]
    assert written == [False] * OPTIMUM.cover_time + [True]


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (OPTIMUM, "cover time 12 (proven), total distance 36"),
        (LONGER, f"cover time {LONGER.cover_time} (gap "),
        (mapp_env.replay(PROBLEM, [[0, 1, 2]]), "not every landmark is visited"),
    ],
)
def test_outcome_in_words(plan: mapp_env.Plan, words: str) -> None:
    """What is written is the plan's cost, whether it is proven, and its gap where there is one."""
    gaps = side_by_side.gaps({"this": plan, "optimum": OPTIMUM})
    assert side_by_side._outcome(plan, gaps["this"].get("cover_time")).startswith(words)


def test_what_cannot_be_shown_is_refused(tmp_path: Path) -> None:
    """No plans, another problem's plan and an impossible size are named, and nothing is written."""
    other = mapp_env.solve(mapp_env.Problem(mapp_env.make_grid(), (0, 1, 2, 3, 4), 3))
    with pytest.raises(ValueError, match="plans must be a mapping of 1 to 12"):
        animate_plans(tmp_path / "a.gif", PROBLEM, {})
    with pytest.raises(ValueError, match="is a plan of another problem"):
        animate_plans(tmp_path / "a.gif", PROBLEM, {"other": other})
    with pytest.raises(ValueError, match="max_side must be"):
        animate_plans(tmp_path / "a.gif", PROBLEM, {"optimum": OPTIMUM}, max_side=4)
    assert not list(tmp_path.iterdir())
