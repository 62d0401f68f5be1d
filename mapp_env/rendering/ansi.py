"""The scene as plain text, without escape codes, for terminals, logs and tests."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from mapp_env.engine.scene import Scene

FREE, WALL, DEPOT, UNVISITED, VISITED, SEVERAL = ".", "#", "D", "*", "x", "&"


def ansi(scene: Scene) -> str:
    """Draw a scene as text.

    One sign a cell: ``#`` wall, ``.`` free, ``D`` depot, ``*`` unvisited landmark, ``x`` visited
    landmark, the agent's number, or ``&`` for several agents, named below the grid. An agent hides
    what it stands on. The line above the grid counts steps and visited landmarks.

    Parameters
    ----------
    scene : Scene
        The moment to show.

    Returns
    -------
    str
        Lines without escape codes and without a final newline.
    """
    grid = scene.grid
    on_cell: defaultdict[int, list[int]] = defaultdict(list)
    for agent, cell in enumerate(scene.cells):
        on_cell[cell].append(agent)
    shared = sorted(cell for cell, agents in on_cell.items() if len(agents) > 1)

    # Numbers of two digits widen every column, whoever stands where, so that rows stay aligned
    # and all frames of an episode have the same shape.
    width = len(str(max(len(scene.cells) - 1, 0)))
    signs = np.where(grid.walls.ravel(), WALL, FREE).astype(f"<U{width}")
    signs[grid.depot] = DEPOT
    for cell, visited in zip(scene.landmarks, scene.visited, strict=True):
        signs[cell] = VISITED if visited else UNVISITED
    for cell, agents in on_cell.items():
        signs[cell] = SEVERAL if len(agents) > 1 else str(agents[0])

    lines = [
        f"step {scene.step}/{scene.max_cycles}  "
        f"landmarks {sum(scene.visited)}/{len(scene.landmarks)}"
    ]
    for row in signs.reshape(grid.walls.shape).tolist():
        lines.append(" ".join(f"{sign:>{width}}" for sign in row))
    for cell in shared:
        row, col = divmod(cell, grid.cols)
        names = ", ".join(map(str, on_cell[cell]))
        lines.append(f"{SEVERAL} at row {row}, col {col}: agents {names}")
    return "\n".join(lines)
