"""Plans: one tour per agent and what they cost; checked, played again, kept in files."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapp_env.engine.state import WAIT
from mapp_env.files import FileError
from mapp_env.plans.replay import Episode, play_episode
from mapp_env.plans.tours import check_tours, moves_of, tour_of, walk_tours
from mapp_env.problem import MAX_CYCLES, Problem, check_joint_actions
from mapp_env.records import MAX_INTEGER, MAX_PLAN_BYTES, Record, read_record, write_record
from mapp_env.validation import as_real, check_choice, check_count, describe

OBJECTIVES = ("cover_time", "makespan", "total_distance")
STATUSES = ("optimal", "feasible", "infeasible")

MAX_SOLVER_LETTERS = 100

MAX_LISTED_CELLS = 100_000
"""Most cells that a file lists, all tours together; in a larger plan, a tour is its moves.

A file must hold what a solver finds; a cell takes up to eight letters, a move one.
"""


@dataclass(frozen=True)
class Plan:
    """One tour per agent and what they cost by the rules.

    Attributes
    ----------
    tours : tuple of tuple of int
        For each agent its cells, from its start, which is the depot unless the problem says
        otherwise, to the depot; empty if it claimed nothing (R8, R10).
    claims : tuple of tuple of int
        For each agent the landmarks that it was the first on, in order.
    cover_time : int or float
        Steps until every landmark is visited; ``math.inf`` if one is not.
    makespan : int or float
        Steps until the last agent is home, if each goes home after its last claim; ``math.inf``
        if a landmark is not visited.
    total_distance : int or float
        Cells moved by all agents, the way home included; ``math.inf`` if a landmark is not visited.
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
        """The cost in :attr:`objective`, a whole number or infinite."""
        cost: float = getattr(self, self.objective)
        return cost

    # -- playing it --------------------------------------------------------------------

    def joint_actions(self, allow_wait: bool = False) -> NDArray[np.int64]:
        """Return actions that the environment, or :func:`replay`, turns into this plan again.

        Parameters
        ----------
        allow_wait : bool
            Whether the environment has the action to wait, 4. With it, an agent waits once it had
            the time to walk home after its last claim; one without a claim waits from the start.
            Without it, a solver's plan has idle agents bump into walls or step to and fro; only one
            between four unvisited landmarks, alone on its start, waits all the same.

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
                home = 0  # when it is there, if it goes there after its last claim
                if steps:
                    home = steps[-1] + self.tours[agent][::-1].index(self.claims[agent][-1])
                actions[home:, agent] = WAIT
            return actions
        if (actions == WAIT).any():
            step, agent = np.argwhere(actions == WAIT)[0].tolist()
            raise ValueError(
                f"joint_actions(allow_wait=False): agent {agent} of this plan waits at step {step}"
            )
        return actions

    # -- checking it -------------------------------------------------------------------

    def verify(self, problem: Problem | None = None) -> None:
        """Check that tours, claims and costs are right for a problem, under the rules.

        The recorded actions (for a plan made by hand: the tours, without a pause) are carried out,
        and all that the plan states is compared; the problem's step limit is ignored.

        Parameters
        ----------
        problem : Problem, optional
            By default the plan's own.

        Raises
        ------
        ValueError
            That says what is wrong: a tour that does not begin at the agent's start or end at the
            depot, jumps or runs into a wall; a wrong number of agents; tours, claims or a cost that
            are not what the rules give; a status or bound that contradicts the cost.
        """
        self._verify(self.problem if problem is None else problem)

    def _verify(
        self, problem: Problem | None, actions: NDArray[np.int64] | None = None
    ) -> tuple[Problem, Episode]:
        """Verify, and return the problem and what the rules make of the plan.

        ``actions`` are the plan's own, shape (T, N), if they are at hand as an array.
        """
        if not isinstance(problem, Problem):
            raise ValueError(f"problem must be a mapp_env.Problem, got {describe(problem)}")
        self._verify_labels()
        if len(self.tours) != problem.n_agents or len(self.claims) != problem.n_agents:
            raise ValueError(
                f"plan: has {len(self.tours)} tours and {len(self.claims)} lists of claims, "
                f"the problem has {problem.n_agents} agents"
            )
        check_tours(problem, self.tours)
        if actions is None and not self.actions and any(self.tours):
            actions = walk_tours(problem, self.tours)
        elif actions is None:
            actions = check_joint_actions(self.actions, problem.n_agents)
        episode = play_episode(replace(problem, max_cycles=None), actions)
        for name in (*OBJECTIVES, "claims", "tours"):
            stated, given = getattr(self, name), getattr(episode, name)
            if stated != given:
                raise ValueError(
                    f"plan: {name} is stated as {describe(stated)}, the rules give "
                    f"{describe(given)}"
                )
        for name in ("claim_steps", "actions"):
            stated = getattr(self, name)
            # A plan made by hand may leave both out.
            if stated != getattr(episode, name) and (stated or self.actions):
                raise ValueError("plan: claim_steps and actions are not what the rules give")
        self._verify_status()
        return problem, episode

    def _verify_labels(self) -> None:
        check_choice("objective", self.objective, OBJECTIVES)
        check_choice("status", self.status, STATUSES)
        if not isinstance(self.solver, str) or len(self.solver) > MAX_SOLVER_LETTERS:
            raise ValueError(
                f"plan: solver must be a str of at most {MAX_SOLVER_LETTERS} letters, "
                f"got {describe(self.solver)}"
            )
        seconds = as_real(self.seconds)
        if seconds is None or not 0 <= seconds <= MAX_INTEGER:
            raise ValueError(
                f"plan: seconds must be a number in 0..{MAX_INTEGER}, got {describe(self.seconds)}"
            )
        if self.bound is not None:
            check_count("plan: bound", self.bound, 0, MAX_INTEGER)

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

        Tours are lists of cells. If there are more than 100,000 cells in all, each tour is instead
        a string of its moves from the agent's start, a digit each, as the actions are.

        Parameters
        ----------
        path : str or os.PathLike
            The file; replaced if it is there.

        Raises
        ------
        ValueError
            If the plan is not right (:meth:`verify`), too large, or the file cannot be written.
        """
        write_record(path, "plan", self.to_record(), MAX_PLAN_BYTES)

    def to_record(self) -> dict[str, Any]:
        """Return the plan and its problem as the fields of a file.

        Raises
        ------
        ValueError
            If the plan is not right (:meth:`verify`), or longer than any episode.
        """
        problem, episode = self._verify(self.problem)
        if len(episode.actions) > MAX_CYCLES:
            raise FileError(f"plan: has {len(episode.actions)} steps, a file holds {MAX_CYCLES}")
        # As played: NumPy integers compare equal, but are not JSON.
        tours: Any = episode.tours
        if sum(map(len, tours)) > MAX_LISTED_CELLS:
            tours = [moves_of(problem.grid, tour) for tour in tours]
        columns = zip(*episode.actions, strict=True) if episode.actions else [()] * len(self.tours)
        return {
            "problem": problem.to_record(),
            "objective": self.objective,
            "status": self.status,
            "solver": self.solver,
            "seconds": float(self.seconds),
            "bound": None if self.bound is None else int(self.bound),
            **json_costs(episode),
            "tours": tours,
            "claims": episode.claims,
            "claim_steps": episode.claim_steps,
            "actions": ["".join(map(str, column)) for column in columns],
        }

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
        n_steps = len(columns[0])
        if {len(column) for column in columns} != {n_steps}:
            raise source.error("actions", "must be equally long for all agents")
        if n_steps > MAX_CYCLES:
            raise source.error("actions", f"must be of at most {MAX_CYCLES} steps", n_steps)
        letters = np.frombuffer("".join(columns).encode("ascii"), np.uint8)
        actions = (letters.reshape(n_agents, n_steps).T - ord("0")).astype(np.int64, order="C")
        costs = {name: source.number(name, null=math.inf) for name in OBJECTIVES}
        plan = cls(
            tours=_read_tours(source, problem, n_steps),
            claims=source.cell_lists("claims", n_agents),
            **costs,
            objective=source.choice("objective", OBJECTIVES),
            status=source.choice("status", STATUSES),
            claim_steps=source.cell_lists("claim_steps", n_agents),
            actions=tuple(map(tuple, actions.tolist())),
            solver=source.text("solver", MAX_SOLVER_LETTERS),
            seconds=source.real("seconds"),
            bound=source.number("bound", null=None),
            problem=problem,
        )
        source.finish()
        try:
            plan._verify(problem, actions)
        except ValueError as error:
            raise FileError(f"{source.where}: {error}") from error
        return plan


def _read_tours(source: Record, problem: Problem, n_steps: int) -> tuple[tuple[int, ...], ...]:
    """Return tours from a file: cells, or moves."""
    if not source.holds_strings("tours"):
        return source.cell_lists("tours", problem.n_agents)
    moves = source.strings("tours", problem.n_agents, "0123")
    if max(map(len, moves)) > n_steps + problem.grid.n_cells:
        raise source.error("tours", "must be the actions' moves and a way home")
    starts = problem.start_cells
    return tuple(
        tour_of(problem.grid, start, line) for start, line in zip(starts, moves, strict=True)
    )


def json_costs(costs: Plan | Episode) -> dict[str, int | None]:
    """Return the three costs as JSON holds them: one that is infinite is null."""
    named = {name: getattr(costs, name) for name in OBJECTIVES}
    return {name: None if cost == math.inf else int(cost) for name, cost in named.items()}


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
    episode = play_episode(problem, check_joint_actions(joint_actions, problem.n_agents))
    status = "feasible" if episode.cover_time < math.inf else "infeasible"
    return Plan(**episode._asdict(), objective=objective, status=status, problem=problem)
