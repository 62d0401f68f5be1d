"""Plans side by side: a panel each, and above it how far it is from what is proven optimal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mapp_env
from mapp_env.rendering import compare_plans

GRID = mapp_env.make_grid()
PROBLEM = mapp_env.Problem(GRID, (0, 6, 20, 42, 48), 3)
OPTIMUM = mapp_env.solve(PROBLEM)
SHORTEST = mapp_env.solve(PROBLEM, "total_distance")
UNSOLVED = mapp_env.replay(PROBLEM, [[0, 1, 2]])


def policy() -> mapp_env.Plan:
    """Return what the environment makes of the shortest plan: nothing proven about it."""
    return mapp_env.replay(PROBLEM, SHORTEST.actions)


def headings(figure: Any) -> list[tuple[str, str]]:
    """Return each panel's label and the lines below it."""
    return [(ax.texts[0].get_text(), ax.get_title()) for ax in figure.axes]


def test_one_panel_a_plan_with_costs_and_gap() -> None:
    """Each plan has its label, costs and, where the other is proven optimal, the gap to it."""
    plan = policy()
    figure = compare_plans(PROBLEM, {"policy": plan, "optimum": OPTIMUM})
    gap = (plan.cover_time - OPTIMUM.cover_time) / OPTIMUM.cover_time
    assert gap > 0
    assert headings(figure) == [
        (
            "policy",
            f"cover time {plan.cover_time}, makespan {plan.makespan}, "
            f"total distance {plan.total_distance}\n"
            f"cover time: gap {100 * gap:.1f}% to the optimum {OPTIMUM.cover_time}",
        ),
        (
            "optimum",
            f"cover time {OPTIMUM.cover_time} (optimal), makespan {OPTIMUM.makespan}, "
            f"total distance {OPTIMUM.total_distance}\n",
        ),
    ]


def test_gaps_are_to_every_proven_optimum() -> None:
    """Two optima in two objectives are each short of the other's, and a policy of both."""
    figure = compare_plans(PROBLEM, {"p": policy(), "time": OPTIMUM, "distance": SHORTEST})
    notes = {label: title.split("\n")[1] for label, title in headings(figure)}
    assert notes["p"].count("gap") == 2
    assert "total distance: gap 0.0%" in notes["p"]
    assert notes["time"].startswith("total distance: gap ")
    assert notes["distance"].startswith("cover time: gap ")
    assert notes["time"].count("gap") == notes["distance"].count("gap") == 1


def test_nothing_proven_no_gap() -> None:
    """Without a proven optimum, or for a plan that leaves landmarks, no gap is given."""
    figure = compare_plans(PROBLEM, {"a": policy(), "b": replace(OPTIMUM, status="feasible")})
    assert not any("gap" in title for _, title in headings(figure))
    (_, title), _ = headings(compare_plans(PROBLEM, {"a": UNSOLVED, "b": OPTIMUM}))
    assert title == "not every landmark is visited\n"


@pytest.mark.parametrize("n_plans", [1, 2, 3, 4, 7, 12])
@pytest.mark.parametrize("rows", [1, 7, 40])
def test_nothing_overlaps_and_nothing_is_cut_off(n_plans: int, rows: int) -> None:
    """Maps, titles and legends of all panels keep apart, inside the figure."""
    problem = mapp_env.Problem(mapp_env.Grid(np.zeros((rows, 40), bool)), (0, 39), 16)
    plan = mapp_env.solve(problem)
    figure = compare_plans(problem, {f"plan {index}": plan for index in range(n_plans)})
    figure.draw_without_rendering()
    assert len(figure.axes) == n_plans
    boxes = []
    for ax in figure.axes:
        assert len(ax.get_legend().get_texts()) >= 16
        boxes.append(ax.get_window_extent())
        for part in (ax.title, ax.texts[0], ax.get_legend()):
            boxes.append(part.get_window_extent())
    width, height = figure.bbox.size
    for index, box in enumerate(boxes):
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= width
        assert box.y1 <= height
        for other in boxes[:index]:
            across = min(box.x1, other.x1) - max(box.x0, other.x0)
            down = min(box.y1, other.y1) - max(box.y0, other.y0)
            assert min(across, down) <= 1  # pixel


def test_panels_are_read_like_lines() -> None:
    """From left to right, three in a row, then the next row below."""
    figure = compare_plans(PROBLEM, {str(index): OPTIMUM for index in range(5)})
    corners = [ax.get_position().corners()[0] for ax in figure.axes]
    places = [(round(-bottom, 6), round(left, 6)) for left, bottom in corners]
    assert places == sorted(places)
    assert len({down for down, _ in places}) == 2
    assert len({across for _, across in places}) == 3


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf", ".PNG"])
def test_it_is_written(tmp_path: Path, suffix: str) -> None:
    """With a path the figure is in a file of the format that the path names."""
    target = tmp_path / f"a{suffix}"
    compare_plans(PROBLEM, {"optimum": OPTIMUM}, target)
    start = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[suffix.lower()]
    assert target.read_bytes().startswith(start)


def test_labels_are_taken_as_they_are() -> None:
    """A label is no formula, and one that is too long is cut."""
    figure = compare_plans(PROBLEM, {"$\\frac{$": OPTIMUM, "x" * 1000: OPTIMUM})
    figure.draw_without_rendering()
    (first, _), (second, _) = headings(figure)
    assert first == "$\\frac{$"
    assert len(second) <= 60


def test_a_label_that_is_a_number_is_refused() -> None:
    """Labels are strings."""
    with pytest.raises(ValueError, match="labels, got 3"):
        compare_plans(PROBLEM, {3: OPTIMUM})  # type: ignore[dict-item]


OTHER = mapp_env.Problem(GRID, (0, 6, 20, 42, 41), 3)
ELSEWHERE = mapp_env.Problem(mapp_env.Grid(np.zeros((7, 7), bool)), PROBLEM.landmarks, 3)


@pytest.mark.parametrize(
    ("problem", "plans", "words"),
    [
        (None, {"a": OPTIMUM}, "problem must be"),
        (PROBLEM, {}, "plans must be a mapping of 1 to 12"),
        (PROBLEM, [OPTIMUM], "plans must be a mapping"),
        (PROBLEM, {str(index): OPTIMUM for index in range(13)}, "plans must be a mapping of 1"),
        (PROBLEM, {"a": None}, r"plans\['a'\] must be a mapp_env.Plan"),
        (PROBLEM, {"a": mapp_env.solve(OTHER)}, r"plans\['a'\] is a plan of another problem"),
        (PROBLEM, {"a": mapp_env.solve(ELSEWHERE)}, r"plans\['a'\] is a plan of another problem"),
        (replace(PROBLEM, n_agents=2), {"a": OPTIMUM}, "another problem"),
        (PROBLEM, {"a": replace(OPTIMUM, cover_time=3), "b": OPTIMUM}, "below 12"),
    ],
)
def test_wrong_arguments_are_refused(problem: Any, plans: Any, words: str) -> None:
    """What is no problem, no plan, or no plan of this problem is a ValueError that says which."""
    with pytest.raises(ValueError, match=words):
        compare_plans(problem, plans)


@pytest.mark.parametrize("name", ["a.bmp", "a", "no/such/folder/a.png", "."])
def test_wrong_paths_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A path that cannot be written, or names no known format, is a ValueError; nothing is left."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"must end in|cannot be written|not a regular file"):
        compare_plans(PROBLEM, {"a": OPTIMUM}, name)
    assert not list(tmp_path.iterdir())
