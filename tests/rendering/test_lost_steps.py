"""Moves of steps that lost something are marked: those, then, and no others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image, ImageSequence

import mapp_env
from mapp_env.rendering import draw_plan, rgb_array, save_animation
from mapp_env.rendering.animation import scenes
from mapp_env.rendering.palette import LOST, to_hex

GRID = mapp_env.Grid.from_text("......\n.D....\n......\n......")
PROBLEM = mapp_env.Problem(GRID, (5, 20), 2, starts=(7, 12))
ACTIONS = np.array([[1, 1], [1, 1], [3, 4], [1, 3], [2, 1], [2, 1], [1, 4]])
REGRETS = [0, 1, 0, 2, 0, 0, 1]
PLAN = mapp_env.replay(PROBLEM, ACTIONS)
CELL = 72  # pixels, of so small a grid
# From and to which cell each agent moves in the steps that lost.
MARKED = {1: [(8, 9), (13, 14)], 3: [(15, 16), (14, 20)], 6: [(4, 5), (22, 22)]}


def frames(path: Path) -> list[np.ndarray]:
    """Return a GIF's frames."""
    with Image.open(path) as image:
        return [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]


def marks(frame: np.ndarray) -> np.ndarray:
    """Return which pixels are marked, but for the bar below."""
    return np.abs(frame[:-32].astype(int) - LOST).max(axis=2) < 3


def middle(cell: int) -> tuple[float, float]:
    """Return the middle of a cell in a frame."""
    row, col = divmod(cell, GRID.cols)
    return 4 + (row + 0.5) * CELL, 4 + (col + 0.5) * CELL


def test_a_mark_is_where_and_when_a_step_lost(tmp_path: Path) -> None:
    """Each frame has marks beside the middle of each move that has lost so far, and only there."""
    save_animation(tmp_path / "a.gif", PROBLEM, ACTIONS, regrets=REGRETS)
    shown = frames(tmp_path / "a.gif")
    assert len(shown) == len(PLAN.actions) + 1
    for step, frame in enumerate(shown):
        yellow = marks(frame)
        allowed = np.zeros_like(yellow)
        for lossy, moves in MARKED.items():
            for start, end in moves if lossy < step else ():
                (down, right), (down2, right2) = middle(start), middle(end)
                top, bottom = sorted((int(down), int(down2)))
                left, far = sorted((int(right), int(right2)))
                allowed[top - 16 : bottom + 16, left - 16 : far + 16] = True
                across, along = int((right + right2) / 2), int((down + down2) / 2)
                near = yellow[along - 12 : along + 12, across - 12 : across + 12]
                # An agent that stays stands on its mark.
                assert near.any() or start == end, (step, start, end)
        assert not (yellow & ~allowed).any(), step


def test_without_regrets_nothing_changes() -> None:
    """With none lost, only the bar says so; without regrets it does not, either."""
    nothing = (0,) * len(PLAN.actions)
    for plain, told in zip(
        scenes(PROBLEM, PLAN.actions), scenes(PROBLEM, PLAN.actions, nothing), strict=True
    ):
        before, after = rgb_array(plain), rgb_array(told)
        assert before.shape == after.shape
        assert (before[:-32] == after[:-32]).all()
        assert not marks(before).any()
        assert (before[-32:] != after[-32:]).any()


def lines_of(ax: Any) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Return from where to where marks go, (col, row)."""
    found = []
    for line in ax.lines:
        if to_rgb(line.get_color()) == to_rgb(to_hex(LOST)) and len(line.get_xdata()) == 2:
            (x, x2), (y, y2) = line.get_xdata(), line.get_ydata()
            found.append(((round(x), round(y)), (round(x2), round(y2))))
    return found


def test_a_figure_marks_all_agents_moves() -> None:
    """A line for each agent in each step that lost, along what it did; the legend counts."""
    ax = draw_plan(PROBLEM, PLAN, regrets=REGRETS)
    expected = [
        tuple(divmod(cell, GRID.cols)[::-1] for cell in move)
        for moves in MARKED.values()
        for move in moves
    ]
    assert sorted(lines_of(ax)) == sorted(expected)
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert "steps lost: 4, in 3 of 7" in texts
    assert lines_of(draw_plan(PROBLEM, PLAN)) == []
    plain = [text.get_text() for text in draw_plan(PROBLEM, PLAN).get_legend().get_texts()]
    assert not any("lost" in text for text in plain)


@pytest.mark.parametrize("regrets", [[1], [0.5] * 7, "none", 3, [[1] * 7]])
def test_other_than_a_regret_a_step_is_refused(tmp_path: Path, regrets: Any) -> None:
    """Too few, no whole numbers, no list: refused by name, and no file is written."""
    with pytest.raises(ValueError, match="regrets must be integers, one for each of 7 steps, got"):
        save_animation(tmp_path / "a.gif", PROBLEM, ACTIONS, regrets=regrets)
    with pytest.raises(ValueError, match="regrets must be integers, one for each of 7 steps, got"):
        draw_plan(PROBLEM, PLAN, regrets=regrets)
    assert not any(tmp_path.iterdir())
