"""The scene: everything that a picture needs to know, and nothing of how it came about."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mapp_env.grid import Grid


TRAIL_MOVES = 512
"""Moves of a trail that are kept and drawn: the time for a picture should not grow with a run."""


@dataclass(frozen=True)
class Scene:
    """What a picture shows of one moment of one episode.

    Parameters
    ----------
    grid : Grid
        The walls and the depot.
    landmarks : tuple of int, length K
        The landmarks' cells.
    visited : tuple of bool, length K
        Whether each landmark has been visited.
    cells : tuple of int, length N
        Where each agent is.
    trails : tuple of tuple of int, length N
        The cells that each agent was on, oldest first and the present one last.
    step : int
        Steps since the reset.
    max_cycles : int
        The step at which the episode is truncated.
    lost : tuple of int, optional
        The regret of each step so far, in steps; without it, nothing is shown of it.
    """

    grid: Grid
    landmarks: tuple[int, ...]
    visited: tuple[bool, ...]
    cells: tuple[int, ...]
    trails: tuple[tuple[int, ...], ...]
    step: int
    max_cycles: int
    lost: tuple[int, ...] | None = None
