"""The distance matrix of a problem in VRPLIB's format, for other people's solvers."""

from __future__ import annotations

import os

from mapp_env.files import write_text
from mapp_env.problem import Problem
from mapp_env.solvers.solution import landmark_distances

MAX_BYTES = 1 << 20


def save_vrplib(problem: Problem, path: str | os.PathLike[str]) -> None:
    """Write a problem's distances as a VRPLIB file with an ``EXPLICIT`` ``FULL_MATRIX``.

    Node 1 is the depot, node ``k + 2`` the problem's landmark ``k``; weights are steps of a
    shortest path. Every landmark has demand 1, and a vehicle room for all: a capacity is part of
    the format, not of the problem.

    Parameters
    ----------
    problem : Problem
        The problem.
    path : str or os.PathLike
        The file; replaced if it is there.

    Raises
    ------
    ValueError
        If the file cannot be written, or agents start elsewhere than on the depot: in this format
        all vehicles start and end in one place.
    """
    if set(problem.start_cells) != {problem.grid.depot}:
        raise ValueError(
            "problem must have all agents start on the depot, as a VRPLIB file has a single one; "
            f"got starts {problem.start_cells}"
        )
    distances = landmark_distances(problem)
    nodes = range(1, len(distances) + 1)
    lines = [
        "NAME : mapp_env",
        f"COMMENT : {problem.n_agents} agents, depot and landmarks on a walled grid",
        # tsplib95, which does not know it, takes the line for more of the field above.
        f"VEHICLES : {problem.n_agents}",
        "TYPE : CVRP",
        f"DIMENSION : {len(distances)}",
        f"CAPACITY : {len(problem.landmarks)}",
        "EDGE_WEIGHT_TYPE : EXPLICIT",
        "EDGE_WEIGHT_FORMAT : FULL_MATRIX",
        "EDGE_WEIGHT_SECTION",
        *(" ".join(map(str, line)) for line in distances.tolist()),
        "DEMAND_SECTION",
        *(f"{node} {0 if node == 1 else 1}" for node in nodes),
        "DEPOT_SECTION",
        "1",
        "-1",
        "EOF",
    ]
    write_text(path, "\n".join(lines) + "\n", MAX_BYTES)
