"""Plans: one tour per agent, what they cost, and what the rules make of a list of joint actions."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapp_env.dynamics import (
    BY_COORDINATES,
    NO_DISTANCES,
    WAIT,
    Reward,
    cell_table,
    measure_row,
    reset_row,
    row_length,
    step_row,
)
from mapp_env.files import MAX_PLAN_BYTES, FileError, read_record, write_record
from mapp_env.problem import Problem
from mapp_env.validation import check_choice, describe
from mapp_env.walking import walk_tours

__all__ = ["OBJECTIVES", "STATUSES", "Plan", "replay"]

OBJECTIVES = ("cover_time", "makespan", "total_distance")
STATUSES = ("optimal", "feasible", "infeasible")


@dataclass(frozen=True)
class Plan:
    """One tour per agent and what they cost by the rules.

    Attributes
    ----------
    tours : tuple of tuple of int
        For each agent its cells, depot first and last, or empty if it claimed nothing (R8).
    claims : tuple of tuple of int
        For each agent the landmarks that it was the first on, in order.
    cover_time, makespan, total_distance : int or float
        Steps until every landmark is visited, steps until the last agent is home, cells moved by
        all agents; ``math.inf`` if not every landmark is visited.
    objective : {"cover_time", "makespan", "total_distance"}
        What :attr:`cost` is.
    status : {"optimal", "feasible", "infeasible"}
        Whether the cost is proven to be the smallest; "infeasible" if landmarks are left.
    claim_steps : tuple of tuple of int
        For each agent the step of each of its claims.
    actions : tuple of tuple of int
        The joint actions that were carried out, one tuple a step.
    solver : str
        What made the plan: "exact", "search", ..., or "replay".
    seconds : float
        How long that took.
    bound : int or None
        A proven lower bound of the cost, if there is one.
    problem : Problem or None
        What the plan is for; ``None`` in a plan made by hand.
    """

    tours: tuple[tuple[int, ...], ...]
    claims: tuple[tuple[int, ...], ...]
    cover_time: float
    makespan: float
    total_distance: float
    objective: str = "cover_time"
    status: str = "feasible"
    claim_steps: tuple[tuple[int, ...], ...] = field(default=(), repr=False)
    actions: tuple[tuple[int, ...], ...] = field(default=(), repr=False)
    solver: str = "replay"
    seconds: float = field(default=0.0, compare=False)
    bound: int | None = None
    problem: Problem | None = field(default=None, repr=False)

    @property
    def success(self) -> bool:
        """Whether every landmark is visited."""
        return self.cover_time != math.inf

    @property
    def cost(self) -> float:
        """The cost in :attr:`objective`."""
        return float(getattr(self, self.objective))

    # -- playing it --------------------------------------------------------------------

    def joint_actions(self, allow_wait: bool = False) -> NDArray[np.int64]:
        """Return actions that the environment, or :func:`replay`, turns into this plan again.

        Parameters
        ----------
        allow_wait : bool
            Whether the environment has the action to wait, 4. With it, an agent waits once it had
            the time to walk home after its last claim; one without a claim waits from the start.
            Without it, a solver's plan has idle agents bump into walls or step to and fro.

        Returns
        -------
        ndarray of int64, shape (T, N)
            Exactly ``cover_time`` steps if every landmark is visited.

        Raises
        ------
        ValueError
            If the plan has no actions on record, or has waits that cannot be left out.
        """
        if not self.actions and (self.success or self.problem is None):
            raise ValueError("joint_actions() needs a plan from solve, replay or a file")
        actions = np.array(self.actions, np.int64).reshape(-1, len(self.tours))
        if allow_wait:
            for agent, steps in enumerate(self.claim_steps):
                actions[self._step_home(agent, steps) :, agent] = WAIT
            return actions
        if (actions == WAIT).any():
            step, agent = np.argwhere(actions == WAIT)[0].tolist()
            raise ValueError(
                f"joint_actions(allow_wait=False): agent {agent} of this plan waits at step {step}"
            )
        return actions

    def _step_home(self, agent: int, steps: tuple[int, ...]) -> int:
        """Return when an agent is home, if it goes there after its last claim."""
        if not steps:
            return 0
        tour = self.tours[agent]
        last = self.claims[agent][-1]
        return steps[-1] + tour[::-1].index(last)

    # -- checking it -------------------------------------------------------------------

    def verify(self, problem: Problem | None = None) -> None:
        """Check that tours, claims and costs are right for a problem, under the rules.

        Every tour is walked cell by cell, and the recorded actions (for a plan made by hand: the
        tours, without a pause) are carried out anew; the problem's step limit is ignored.

        Parameters
        ----------
        problem : Problem, optional
            By default the plan's own.

        Raises
        ------
        ValueError
            That says what is wrong: a tour that does not start and end at the depot, jumps or runs
            into a wall; a landmark that is missing or claimed twice; a wrong number of agents; a
            detour after the last claim; a cost that is not what the rules give; a status or bound
            that contradicts the cost.
        """
        problem = self.problem if problem is None else problem
        if not isinstance(problem, Problem):
            raise ValueError(f"problem must be a mapp_env.Problem, got {describe(problem)}")
        check_choice("objective", self.objective, OBJECTIVES)
        check_choice("status", self.status, STATUSES)
        self._verify_tours(problem)
        self._verify_claims(problem)
        unlimited = replace(problem, max_cycles=None)
        actions = self.actions
        if not actions and any(self.tours):
            actions = tuple(map(tuple, walk_tours(unlimited, self.tours).tolist()))
        played = replay(unlimited, actions, self.objective)
        for name in ("cover_time", "makespan", "total_distance", "claims", "tours"):
            stated, given = getattr(self, name), getattr(played, name)
            if stated != given:
                raise ValueError(
                    f"plan: {name} is stated as {describe(stated)}, the rules give "
                    f"{describe(given)}"
                )
        if self.actions and (self.claim_steps, self.actions) != (
            played.claim_steps,
            played.actions,
        ):
            raise ValueError("plan: claim_steps and actions are not what the rules give")
        self._verify_status()

    def _verify_tours(self, problem: Problem) -> None:
        grid = problem.grid
        if len(self.tours) != problem.n_agents or len(self.claims) != problem.n_agents:
            raise ValueError(
                f"plan: has {len(self.tours)} tours and {len(self.claims)} lists of claims, "
                f"the problem has {problem.n_agents} agents"
            )
        for agent, tour in enumerate(self.tours):
            if not tour:
                continue
            for cell in tour:
                if grid.walls.flat[grid.cell(f"plan: tours[{agent}]: cell", cell)]:
                    raise ValueError(f"plan: tours[{agent}] enters cell {cell}, which is a wall")
            if tour[0] != grid.depot or tour[-1] != grid.depot:
                raise ValueError(
                    f"plan: tours[{agent}] must start and end at the depot, cell {grid.depot}; "
                    f"it goes from {tour[0]} to {tour[-1]}"
                )
            for cell, to in pairwise(tour):
                if cell == to or to not in grid.moves[cell]:
                    raise ValueError(f"plan: tours[{agent}] jumps from cell {cell} to {to}")

    def _verify_claims(self, problem: Problem) -> None:
        claimed = [cell for cells in self.claims for cell in cells]
        if len(set(claimed)) < len(claimed) or not set(claimed) <= set(problem.landmarks):
            raise ValueError(
                f"plan: claims must be landmarks, each once, got {describe(self.claims)}"
            )
        missing = sorted(set(problem.landmarks) - set(claimed))
        if self.success and missing:
            raise ValueError(f"plan: nobody claims the landmark on cell {missing[0]}")
        for agent, (tour, cells) in enumerate(zip(self.tours, self.claims, strict=True)):
            if bool(tour) != bool(cells):
                raise ValueError(
                    f"plan: agent {agent} has {len(cells)} claims and a tour of {len(tour)} cells"
                )
            if not _in_order(tour, cells):
                raise ValueError(f"plan: tours[{agent}] does not visit its claims in their order")
            if cells and tour[::-1].index(cells[-1]) != problem.grid.home[cells[-1]]:
                raise ValueError(
                    f"plan: tours[{agent}] must take a shortest path home from its last claim"
                )

    def _verify_status(self) -> None:
        if (self.status == "infeasible") == self.success:
            raise ValueError(f"plan: status {self.status!r} contradicts success={self.success}")
        if self.bound is not None and self.bound > self.cost:
            raise ValueError(f"plan: bound {self.bound} is above the cost {self.cost}")
        if self.status == "optimal" and self.bound != self.cost:
            raise ValueError(f"plan: status 'optimal' needs bound {self.cost}, got {self.bound}")

    # -- reading and writing -----------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan and its problem as JSON, whole or not at all.

        Parameters
        ----------
        path : str or os.PathLike
            The file; replaced if it is there.

        Raises
        ------
        ValueError
            If the plan is not right (:meth:`verify`), too large, or the file cannot be written.
        """
        self.verify()
        problem = self.problem
        if problem is None:  # verify has refused it
            return
        columns = zip(*self.actions, strict=True) if self.actions else [()] * len(self.tours)
        record = {
            "problem": problem.to_record(),
            "objective": self.objective,
            "status": self.status,
            "solver": self.solver,
            "seconds": self.seconds,
            "bound": self.bound,
            **{name: _or_null(getattr(self, name)) for name in OBJECTIVES},
            "tours": self.tours,
            "claims": self.claims,
            "claim_steps": self.claim_steps,
            "actions": ["".join(map(str, column)) for column in columns],
        }
        write_record(path, "plan", record, MAX_PLAN_BYTES)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Plan:
        """Read a plan and its problem from a file, and verify it.

        Parameters
        ----------
        path : str or os.PathLike
            A file that :meth:`save` wrote.

        Raises
        ------
        ValueError
            If it is not such a file, in any detail, or the plan in it is not right.
        """
        source = read_record(path, "plan", MAX_PLAN_BYTES)
        problem = Problem.from_record(source.record("problem"))
        n_agents = problem.n_agents
        columns = source.strings("actions", n_agents, "01234")
        if len({len(column) for column in columns}) > 1:
            raise source.error("actions", "must be equally long for all agents")
        costs = {name: source.number(name, null=math.inf) for name in OBJECTIVES}
        plan = cls(
            tours=source.cell_lists("tours", n_agents),
            claims=source.cell_lists("claims", n_agents),
            **costs,
            objective=source.choice("objective", OBJECTIVES),
            status=source.choice("status", STATUSES),
            claim_steps=source.cell_lists("claim_steps", n_agents),
            actions=tuple(tuple(map(int, step)) for step in zip(*columns, strict=True)),
            solver=source.text("solver", 100),
            seconds=source.real("seconds"),
            bound=source.number("bound", null=None),
            problem=problem,
        )
        source.finish()
        try:
            plan.verify()
        except ValueError as error:
            raise FileError(f"{source.where}: {error}") from error
        return plan


def _in_order(tour: tuple[int, ...], cells: tuple[int, ...]) -> bool:
    """Return whether a tour comes by some cells in their order."""
    rest = iter(tour)
    return all(cell in rest for cell in cells)


def _or_null(cost: float) -> int | None:
    """Return a cost as files hold it."""
    return None if cost == math.inf else int(cost)


def replay(problem: Problem, joint_actions: ArrayLike, objective: str = "cover_time") -> Plan:
    """Return the plan that joint actions amount to: what the environment would have scored.

    The episode ends when every landmark is visited or at the problem's step limit, if it has one;
    joint actions after that are not carried out.

    Parameters
    ----------
    problem : Problem
        What is played.
    joint_actions : array_like of int, shape (T, N)
        0 left, 1 right, 2 up, 3 down, 4 wait for each agent at each step.
    objective : {"cover_time", "makespan", "total_distance"}
        What the plan's ``cost`` is.

    Raises
    ------
    ValueError
        If the shape is wrong or an action is not one.
    """
    if not isinstance(problem, Problem):
        raise ValueError(f"problem must be a mapp_env.Problem, got {describe(problem)}")
    check_choice("objective", objective, OBJECTIVES)
    actions = _check_joint_actions(joint_actions, problem.n_agents)
    n_agents, n_landmarks = problem.n_agents, len(problem.landmarks)
    grid = problem.grid
    table = cell_table(grid)
    row = np.zeros(row_length(n_agents, n_landmarks), np.int32)
    landmarks = np.array(problem.landmarks, np.int32)
    reset_row(row, landmarks, grid.depot, n_agents, n_landmarks)
    flags = row[n_agents + n_landmarks : n_agents + 2 * n_landmarks]
    limit = len(actions) if problem.max_cycles is None else problem.max_cycles
    routes = [[grid.depot] for _ in range(n_agents)]
    tours: list[tuple[int, ...]] = [()] * n_agents
    claims: list[list[int]] = [[] for _ in range(n_agents)]
    claim_steps: list[list[int]] = [[] for _ in range(n_agents)]
    steps = 0
    for joint_action in actions[:limit]:
        before = flags.copy()
        steps += 1
        _, terminated, _ = step_row(
            row,
            joint_action,
            n_agents,
            n_landmarks,
            limit,
            int(Reward.STEP),
            table,
            NO_DISTANCES,
            BY_COORDINATES,
        )
        cells = row[:n_agents].tolist()
        for agent, cell in enumerate(cells):
            if cell != routes[agent][-1]:
                routes[agent].append(cell)
        for landmark in np.flatnonzero(flags != before):
            cell = problem.landmarks[landmark]
            agent = cells.index(cell)
            claims[agent].append(cell)
            claim_steps[agent].append(steps)
            tours[agent] = (*routes[agent], *grid.path(cell, grid.depot)[1:])
        if terminated:
            break
    costs = measure_row(row, n_agents, n_landmarks, table)
    whole = bool(flags.all())
    cover_time, makespan, total = (int(cost) if whole else math.inf for cost in costs)
    return Plan(
        tours=tuple(tours),
        claims=tuple(map(tuple, claims)),
        cover_time=cover_time,
        makespan=makespan,
        total_distance=total,
        objective=objective,
        status="feasible" if whole else "infeasible",
        claim_steps=tuple(map(tuple, claim_steps)),
        actions=tuple(map(tuple, actions[:steps].tolist())),
        problem=problem,
    )


def _check_joint_actions(joint_actions: Any, n_agents: int) -> NDArray[np.int64]:
    """Return joint actions as an int64 array of shape (T, N)."""
    try:
        array = np.asarray(joint_actions)
    except (ValueError, RecursionError):
        array = np.array(None)  # ragged, or nested too deep
    if array.shape in ((0,), (0, n_agents)):
        return np.empty((0, n_agents), np.int64)
    if array.ndim != 2 or array.shape[1] != n_agents or array.dtype.kind not in "iu":
        raise ValueError(
            f"joint_actions must be integers of shape (T, {n_agents}), "
            f"got {describe(joint_actions)}"
        )
    wrong = np.argwhere((array < 0) | (array > WAIT))
    if len(wrong):
        step, agent = wrong[0].tolist()
        raise ValueError(
            f"joint_actions[{step}, {agent}] must be in 0..{WAIT}, got {array[step, agent]}"
        )
    return np.ascontiguousarray(array, np.int64)
