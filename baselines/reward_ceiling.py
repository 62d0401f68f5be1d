"""What the best possible policy for a reward achieves: the ceiling for training on it.

Method: value iteration over all states of a problem (cells of the agents x unvisited landmarks),
without any learning; then the cover time of the policy that is optimal for the discounted reward,
beside the optimal cover time. Joint actions of equal value are ties: the figures are those of
breaking them at random, and at their best and worst.

Command::

    python baselines/reward_ceiling.py --problems 200

Output: a table with a row per reward: share of problems solved within the step limit, mean gap of
the cover time, share of problems whose cover time is optimal, largest gap. Solved, optimal and
largest are for ties broken at their worst.
"""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines.learning.config import REWARDS, run_script
from baselines.learning.ranges import Share, Within, check_options
from baselines.policies.evaluation import EVALUATION_SEED, find_optima, unseen_problems
from baselines.policies.settings import N_ACTIONS, Setting
from mapp_env.engine.loops import visit_rows
from mapp_env.engine.rules import Reward
from mapp_env.engine.world import make_world
from mapp_env.grids import find_grid
from mapp_env.validation import check_choice

MAX_STATES = 2**26  # half a gigabyte of values
SAME = 1e-9  # values closer than this are a tie
LEAST_WEIGHT = 10 * SAME  # of the last step of an episode, seen from the first
WORST = -1e9  # below any discounted sum of rewards


# -- values ------------------------------------------------------------------------------------


class RewardModel:
    """All states of one problem of a small grid, under one reward.

    A state is a tuple of the agents' places (numbers of cells that can be reached) and a set of
    unvisited landmarks (bits). Arrays over the places have one axis per agent.
    """

    def __init__(self, setting: Setting, landmarks: Sequence[int], reward: str) -> None:
        grid = setting.grid
        self.cells = np.sort(np.append(grid.reachable, grid.depot))
        place_of = np.full(grid.n_cells, -1)
        place_of[self.cells] = np.arange(len(self.cells))
        self.moves = place_of[np.asarray(grid.moves)[self.cells, :N_ACTIONS]]  # (places, 4)
        self.depot = int(place_of[grid.depot])
        self.n_agents, self.n_landmarks = setting.n_agents, len(landmarks)
        self.shape = (len(self.cells),) * self.n_agents
        self.everywhere = np.indices(self.shape).reshape(self.n_agents, -1).T
        self.landmarks, self.bits = np.array(landmarks), 1 << np.arange(self.n_landmarks)
        kind = Reward[reward.upper()]
        self.world = make_world(grid, self.n_agents, self.n_landmarks, kind)

    def arrive(
        self, places: np.ndarray, unvisited: int | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return what the rules make of moving to places (B, N), with the set of before, or (B,).

        These are the set of landmarks that are unvisited then (R5), and the reward (R6): (B,) each.
        """
        visited = (np.broadcast_to(unvisited, len(places))[:, None] & self.bits) == 0
        visited, rewards, _ = visit_rows(self.world, self.cells[places], self.landmarks, visited)
        return ~visited @ self.bits, rewards

    def best_neighbour(self, values: np.ndarray) -> np.ndarray:
        """Return the largest value that one joint action leads to, for all places."""
        for axis in range(self.n_agents):
            values = np.maximum.reduce(
                [values.take(self.moves[:, action], axis) for action in range(N_ACTIONS)]
            )
        return values


@dataclass(frozen=True)
class Solved:
    """The optimal values of one problem under one reward."""

    model: RewardModel
    arrival: list[np.ndarray]  # per set: value of moving to places, the reward included


def iterate_values(model: RewardModel, discount: float) -> Solved:
    """Return the optimal values: one set of unvisited landmarks after another, smaller ones first.

    With a landmark under an agent the set is in truth a smaller one, whose values are known; the
    other places are iterated until nothing moves.
    """
    values = np.zeros((1 << model.n_landmarks, *model.shape))  # nothing is left to lose in the end
    arrival = [values[0]]
    for unvisited in range(1, len(values)):
        arrived = model.arrive(model.everywhere, unvisited)
        left, rewards = (array.reshape(model.shape) for array in arrived)
        open_places = left == unvisited
        known = values.reshape(len(values), -1)[left.ravel(), np.arange(left.size)]
        value = np.where(open_places, WORST, known.reshape(model.shape))
        while True:
            arriving = rewards + discount * value
            new = np.where(open_places, model.best_neighbour(arriving), value)
            settled = np.abs(new - value).max() <= SAME
            value = new
            if settled:
                break
        values[unvisited] = value
        arrival.append(rewards + discount * value)
    return Solved(model, arrival)


# -- the policy that is optimal for them -------------------------------------------------------


@dataclass(frozen=True)
class CoverTimes:
    """Cover times of the policies that are optimal for a reward; infinite beyond the limit."""

    at_random: float  # mean over ties broken at random
    best: float
    worst: float


def cover_times(solved: Solved, max_cycles: int) -> CoverTimes:
    """Follow all optimal joint actions from the depot, each with its probability."""
    model = solved.model
    now = {((model.depot,) * model.n_agents, (1 << model.n_landmarks) - 1): 1.0}
    best, mean = math.inf, 0.0
    for step in range(1, max_cycles + 1):
        moved: Counter[tuple[tuple[int, ...], int]] = Counter()
        for (places, unvisited), chance in now.items():
            ties = optimal_moves(solved, places, unvisited)
            for target in ties:
                moved[target, unvisited] += chance / len(ties)
        targets, sets = map(np.array, zip(*moved, strict=True))
        after: Counter[tuple[tuple[int, ...], int]] = Counter()
        for key, left in zip(moved, model.arrive(targets, sets)[0].tolist(), strict=True):
            after[key[0], left] += moved[key]
        finished = sum(chance for (_, left), chance in after.items() if left == 0)
        if finished:
            best = min(best, step)
            mean += step * finished
        now = {key: chance for key, chance in after.items() if key[1]}
        if not now:
            return CoverTimes(mean, best, step)
    return CoverTimes(math.inf, best, math.inf)


def optimal_moves(solved: Solved, places: tuple[int, ...], unvisited: int) -> list[tuple[int, ...]]:
    """Return the places that each optimal joint action leads to; two actions may agree."""
    moves = solved.model.moves
    block = solved.arrival[unvisited][np.ix_(*(moves[place] for place in places))]
    chosen = np.argwhere(block >= block.max() - SAME)  # (ties, N)
    return list(map(tuple, moves[np.array(places), chosen].tolist()))


# -- from the command line ---------------------------------------------------------------------


@dataclass(frozen=True)
class Args:
    """Options of the study."""

    rewards: tuple[str, ...] = REWARDS
    """which rewards (rule R6)"""
    discount: Share = 0.95
    """discount factor of future rewards; the paper's is 0.95. One too small for the step limit is
    refused, as values could not tell late steps apart"""
    problems: Annotated[int, Within(1, 1_000_000)] = 100
    """number of random problems: one takes about a second for each reward"""
    seed: Annotated[int, Within(0, 2**63 - 1)] = EVALUATION_SEED
    """seed of the problems"""
    grid: str = "paper-7x7"
    """bundled grid or map file"""
    n_agents: Annotated[int, Within(1, 16)] = 3
    """number of agents"""
    n_landmarks: Annotated[int, Within(1, 256)] = 5
    """number of landmarks in each problem"""
    max_cycles: Annotated[int, Within(1, 1_000_000)] = 50
    """steps after which a problem counts as unsolved"""

    def __post_init__(self) -> None:
        for reward in self.rewards:
            check_choice("rewards", reward, REWARDS)
        check_options(self)
        # The last step counts so much at the start; if it is lost in the values, all is a tie.
        if self.discount**self.max_cycles < LEAST_WEIGHT:
            raise ValueError(
                f"discount ** max_cycles must be at least {LEAST_WEIGHT:g}, so that late steps "
                f"still count; got {self.discount:g} ** {self.max_cycles}"
            )


def all_cover_times(
    setting: Setting, landmarks: Iterable[Sequence[int]], reward: str, discount: float
) -> list[CoverTimes]:
    """Return the cover times of each problem."""
    models = (RewardModel(setting, row, reward) for row in landmarks)
    return [cover_times(iterate_values(model, discount), setting.max_cycles) for model in models]


def format_row(label: str, found: list[CoverTimes], optimum: np.ndarray) -> str:
    """Return one line of the table."""
    mean, best, worst = (
        np.array([getattr(times, name) for times in found])
        for name in ("at_random", "best", "worst")
    )
    solved = np.isfinite(worst)
    if not solved.any():
        return f"| {label:<9} | {0:8.2f} | {'-':>6} | {'-':>17} | {0:9.1f} | {'-':>11} |"
    # Rounded, because a mean over ties can be off by the last bit, and -0.00 is no gap.
    gap, low, high = (
        100 * max(0.0, float((times[solved] / optimum[solved] - 1).mean().round(9)))
        for times in (mean, best, worst)
    )
    largest = 100 * float((worst[solved] / optimum[solved] - 1).max())
    share = 100 * float((worst == optimum).mean())
    return (
        f"| {label:<9} | {100 * solved.mean():8.2f} | {gap:6.2f} | {f'{low:.2f} - {high:.2f}':>17} "
        f"| {share:9.1f} | {largest:11.1f} |"
    )


def main(args: Args) -> None:
    """Print the table."""
    setting = Setting(find_grid(args.grid), args.n_agents, args.n_landmarks, args.max_cycles)
    n_states = (setting.grid.reachable.size + 1) ** args.n_agents << args.n_landmarks
    if n_states > MAX_STATES:
        raise ValueError(
            f"grid, n_agents and n_landmarks make {n_states:,} states, allowed are {MAX_STATES:,}"
        )
    landmarks = unseen_problems(setting, args.problems, seed=args.seed)
    optima = find_optima(setting, landmarks)
    if optima is None:
        raise ValueError("n_landmarks must be at most 20 for a proven optimum")
    print(f"{args.problems:,} problems, discount {args.discount:g}\n")
    print("| reward    | solved % |  gap % |  best - worst tie | optimal % | worst gap % |")
    print("|-----------|---------:|-------:|------------------:|----------:|------------:|")
    for reward in args.rewards:
        rows = tqdm(landmarks.tolist(), desc=reward, leave=False, disable=None)
        found = all_cover_times(setting, rows, reward, args.discount)
        print(format_row(reward, found, optima.cover_time), flush=True)


if __name__ == "__main__":
    run_script(main, Args, __doc__)
