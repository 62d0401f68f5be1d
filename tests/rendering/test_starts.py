"""Pictures of agents that start anywhere: their starts are marked, and routes begin there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.patches import Wedge

import mapp_env
from mapp_env.rendering import animate_plans, draw_plan, rgb_array
from mapp_env.rendering.animation import scenes
from mapp_env.rendering.palette import agent_colour, to_hex

PROBLEM = mapp_env.Problem(mapp_env.make_grid(), (0, 6, 42, 48), 4, starts=(27, 24, 27, 37))
PLAN = mapp_env.solve(PROBLEM)


def test_each_start_has_a_disc_of_its_agents() -> None:
    """A sector in an agent's colour on its start, none on the depot, none without starts."""
    sectors = [patch for patch in draw_plan(PROBLEM, PLAN).patches if isinstance(patch, Wedge)]
    found = sorted((patch.center, patch.get_facecolor()) for patch in sectors)
    expected = []
    for agent, cell in ((0, 27), (2, 27), (3, 37)):
        disc = Wedge((cell % 7, cell // 7), 1, 0, 1, facecolor=to_hex(agent_colour(agent)))
        expected.append((disc.center, disc.get_facecolor()))
    assert found == sorted(expected)
    # Those of one start share the disc.
    turns = sorted(patch.theta2 - patch.theta1 for patch in sectors)
    assert turns == pytest.approx([180, 180, 360])
    plain = replace(PROBLEM, starts=None)
    axes = draw_plan(plain, mapp_env.solve(plain))
    assert not [patch for patch in axes.patches if isinstance(patch, Wedge)]


def test_an_animation_begins_on_the_starts() -> None:
    """The first scene has the agents on their starts, the last the landmarks visited."""
    shown = list(scenes(PROBLEM, PLAN.actions))
    assert shown[0].cells == PROBLEM.start_cells
    assert not any(shown[0].visited)
    assert all(shown[-1].visited)
    assert all(
        trail[0] == cell for trail, cell in zip(shown[-1].trails, (27, 24, 27, 37), strict=True)
    )
    assert rgb_array(shown[0]).shape == rgb_array(shown[-1]).shape


def test_plans_from_other_starts_are_not_compared(tmp_path: Path) -> None:
    """Plans are side by side only if their agents start alike."""
    for starts in (None, (27, 24, 37, 27)):
        with pytest.raises(ValueError, match="is a plan of another problem"):
            animate_plans(tmp_path / "a.gif", replace(PROBLEM, starts=starts), {"a": PLAN})
    assert animate_plans(tmp_path / "a.gif", PROBLEM, {"a": PLAN}) > 0
