"""Train a policy a little further on one problem: the paper's "short training on the problem".

Method: at most 30 more episodes on the problem. The first one is the policy's own, the next ones
walk at random, so that it is known where moves lead. Before each of the others the network plays
many episodes on this problem in imagination, along the moves that were made, with actions drawn
from its own values, and learns to do what it did in the shortest (``self_improve`` does the same on
all problems); then it plays greedily for real. Neither the walls nor the optimum are looked up.

Paper: section 5, last paragraph (arXiv 2110.01460).

Command::

    python baselines/finetune.py --policy pretrained --landmarks 0 6 20 42 48
    python baselines/finetune.py --policy pretrained --problems 100

Output: the costs before and after beside the optimum, and the routes; ``--picture`` and ``--plan``
as of solve.py. What counts is the best of the episodes that were played, the last one included.
With ``--problems`` that many unseen problems which the policy does not solve optimally are
fine-tuned, and it is said of how many the optimum was found.
"""

import copy
import sys
import time
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
import torch
import tyro
from torch import nn
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines import solve as solving
from baselines.learning.q_learning import joint_values
from baselines.networks import MAX_JOINT_ACTIONS, Network, split_joint
from baselines.policies import play
from baselines.policies.acting import check_grid
from baselines.policies.evaluation import (
    MAX_EXACT_LANDMARKS,
    count_unseen,
    evaluate,
    find_optima,
    unseen_problems,
)
from baselines.policies.policy import NetworkPolicy
from baselines.policies.settings import N_ACTIONS, Setting, load_run
from baselines.replay.imagined import UNKNOWN, join
from mapp_env import Plan, Problem, mapp_v0, replay, solve
from mapp_env.engine.loops import visit_rows
from mapp_env.engine.task import make_world
from mapp_env.validation import check_count, check_number

# Values of one network differ by tenths where logits of another differ by tens: actions are drawn
# at sharpnesses from one end to the other, episode by episode.
SHARPNESS = (0.1, 16.0)
LEARNING = ("imagined", "updates_per_episode", "learning_rate", "patience")


@dataclass
class Args(solving.Args):
    """Options of fine-tuning."""

    problems: int = 0
    """in place of landmarks: number of random problems to try, none of them solved optimally"""
    episodes: int = 30
    """most episodes to play"""
    random_episodes: int = 8
    """how many of them, after the first, walk at random"""
    imagined: int = 4096
    """episodes imagined before each of the others"""
    updates_per_episode: int = 10
    """updates after that"""
    learning_rate: float = 0.002
    """step size of Adam"""
    patience: int = 5
    """it ends early when so many of its own episodes have not become shorter"""
    seed: int = 0
    """seed of everything random"""

    def __post_init__(self) -> None:
        check_count("problems", self.problems, 0, 1_000_000)
        check_count("episodes", self.episodes, 1, 30)
        check_count("random_episodes", self.random_episodes, 0, 29)
        check_count("imagined", self.imagined, 1, 65_536)
        check_count("updates_per_episode", self.updates_per_episode, 1, 10_000)
        check_number("learning_rate", self.learning_rate, 1e-12, 1.0)
        check_count("patience", self.patience, 1, 30)
        check_count("seed", self.seed, 0, 2**63 - 1)
        beside = ("landmarks", "picture", "plan", "animation")
        for name in beside if self.problems else ():
            if getattr(self, name):
                raise ValueError(f"problems takes no {name} beside it")
        learns = self.episodes > self.random_episodes + 1
        for field in fields(self) if not learns else ():
            if field.name in LEARNING and getattr(self, field.name) != field.default:
                raise ValueError(
                    f"{field.name} has no effect with episodes {self.episodes} and random_episodes "
                    f"{self.random_episodes}, which leave nothing to learn from: leave it out"
                )


class Episode(NamedTuple):
    """What was seen and done until all landmarks were visited."""

    seen: np.ndarray  # (T, D) float32
    joint: np.ndarray  # (T,) int64, joint actions


class Tuner:
    """A network, what it knows of the grid, and the problem it is trained on.

    Parameters
    ----------
    args
        Options.
    network
        Whose values tell good joint actions from bad ones; it is copied.
    problem
        The problem.
    """

    def __init__(self, args: Args, network: Network, problem: Problem) -> None:
        if network.spec.n_joint_actions > MAX_JOINT_ACTIONS:
            raise ValueError(
                f"policy must be of a team with at most {MAX_JOINT_ACTIONS:,} joint actions, got "
                f"{network.spec.n_joint_actions:,}"
            )
        self.args, self.problem = args, problem
        self.network = copy.deepcopy(network)
        self.spec = network.spec
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=args.learning_rate)
        self.rng = np.random.default_rng(args.seed)
        self.moves = np.full((problem.grid.n_cells, N_ACTIONS), UNKNOWN, np.int64)  # experienced
        self.digits = split_joint(np.arange(self.spec.n_joint_actions), self.spec.n_agents, 4)
        self.best: Episode | None = None

    def remember(self, seen: np.ndarray, actions: np.ndarray, following: np.ndarray) -> None:
        """Keep where each agent's move has led."""
        n = self.spec.n_agents
        self.moves[seen[:n].astype(np.int64), actions] = following[:n]

    def train(self) -> None:
        """Imagine episodes, and learn to do what was done in the shortest so far."""
        found = self.imagine()
        if found is not None and (self.best is None or len(found.joint) < len(self.best.joint)):
            self.best = found
        if self.best is None:
            return
        seen, joint = map(torch.from_numpy, self.best)
        for _ in range(self.args.updates_per_episode):
            scores = joint_values(self.network(seen), self.spec)
            loss = nn.functional.cross_entropy(scores, joint)
            self.optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self.optimiser.step()

    def imagine(self) -> Episode | None:
        """Return the shortest of many imagined episodes, None if none visits all landmarks."""
        n_rows, problem = self.args.imagined, self.problem
        sharpness = np.geomspace(*SHARPNESS, n_rows, dtype=np.float32)[:, None]
        cells = np.full((n_rows, self.spec.n_agents), problem.grid.depot)
        landmarks = np.tile(np.array(problem.landmarks), (n_rows, 1))
        visited = np.zeros(landmarks.shape, np.bool_)
        world = make_world(problem.grid, self.spec.n_agents, self.spec.n_landmarks)
        seen, taken = [], []
        limit = problem.max_cycles if self.best is None else len(self.best.joint)
        for _ in range(limit or 0):
            known = (self.moves[cells[:, None, :], self.digits] != UNKNOWN).all(axis=2)
            going_on = known.any(axis=1)  # the others are where nobody has moved from
            if not going_on.any():
                return None
            seen.append(join(cells, landmarks, visited))
            with torch.inference_mode():
                values = joint_values(self.network(torch.from_numpy(seen[-1])), self.spec)
            # The largest of logits and Gumbel noise is a draw from the policy.
            scores = sharpness * values.numpy() + self.rng.gumbel(size=known.shape)
            joint = np.where(known, scores, -np.inf).argmax(axis=1)
            taken.append(joint)
            moved = self.moves[cells, self.digits[joint]]
            cells = np.where(going_on[:, None], moved, cells)
            visited[going_on] = visit_rows(world, cells, landmarks, visited)[0][going_on]
            done = visited.all(axis=1)
            if done.any():
                row = int(done.argmax())
                return Episode(np.stack(seen)[:, row], np.stack(taken)[:, row])
        return None


def finetune(
    args: Args, policy: NetworkPolicy, setting: Setting, problem: Problem
) -> tuple[Plan, int]:
    """Return the best plan of the episodes played, and how many they were.

    It ends early when nothing has become better for a while.

    Raises
    ------
    ValueError
        If the policy is of another grid than the problem, or of too large a team.
    """
    check_grid(policy, problem.grid)
    tuner = Tuner(args, policy.network, problem)
    env = mapp_v0.parallel_env(
        setting.grid, setting.n_agents, setting.n_landmarks, setting.max_cycles
    )
    best: Plan | None = None
    waited = 0
    for episode in range(args.episodes):
        random = 0 < episode <= args.random_episodes  # the first shows what the policy can do
        if episode > args.random_episodes:
            tuner.train()
        plan = run_episode(env, tuner, random)
        waited += episode > args.random_episodes
        if best is None or (plan.success, -plan.cover_time) > (best.success, -best.cover_time):
            best, waited = plan, 0
        if best.success and waited >= args.patience:
            return best, episode + 1
    assert best is not None
    return best, args.episodes


def run_episode(env: mapp_v0.parallel_env, tuner: Tuner, random: bool) -> Plan:
    """Play an episode, greedily or at random, and remember where the moves led."""
    leader = env.possible_agents[0]
    policy = NetworkPolicy(tuner.network)
    seen = env.reset(options={"landmarks": list(tuner.problem.landmarks)})[0][leader]
    taken = []
    while env.agents:
        if random:
            actions = tuner.rng.integers(N_ACTIONS, size=len(env.agents))
        else:
            actions = policy.act(seen[None])[0]
        following = env.step(dict(zip(env.agents, actions.tolist(), strict=True)))[0][leader]
        tuner.remember(seen, actions, following)
        seen = following
        taken.append(actions)
    return replay(replace(tuner.problem, max_cycles=None), np.array(taken))


def study(args: Args, policy: NetworkPolicy, setting: Setting, seen: list[tuple[int, ...]]) -> None:
    """Fine-tune on random problems that the policy does not solve optimally, and count.

    Raises
    ------
    ValueError
        If the optimum of so many landmarks is not known.
    """
    landmarks = unseen_problems(
        setting, min(100 * args.problems, count_unseen(setting, seen)), seen, args.seed
    )
    optima = find_optima(setting, landmarks)
    if optima is None:
        raise ValueError(
            f"problems: optima are known up to {MAX_EXACT_LANDMARKS} landmarks, the policy is for "
            f"{setting.n_landmarks}"
        )
    result = evaluate(policy, setting, landmarks, optima)
    rows = np.flatnonzero(~(result.gaps <= 0.0))[: args.problems]
    if not len(rows):
        print(f"the policy solves all of {len(landmarks):,} random problems optimally")
        return
    seconds, gaps = [], []
    for row in tqdm(rows, disable=None):
        start = time.perf_counter()
        problem = setting.problem(tuple(landmarks[row].tolist()))
        plan, _ = finetune(args, policy, setting, problem)
        seconds.append(time.perf_counter() - start)
        gaps.append(plan.cover_time / optima.cover_time[row] - 1.0)
    solved = np.isfinite(gaps)
    found = int((np.array(gaps) == 0.0).sum())
    print(
        f"{len(rows)} problems that the policy does not solve optimally, of {len(landmarks):,}: "
        f"solved {solved.sum()}, the optimum found on {found} ({100 * found / len(rows):.1f} %), "
        f"mean gap {100 * np.mean(np.array(gaps)[solved]) if solved.any() else np.nan:.2f} %, "
        f"{np.mean(seconds):.1f} s each on average, {max(seconds):.1f} s at most"
    )


def main(args: Args) -> int:
    """Fine-tune on one problem; return the exit code."""
    torch.set_num_threads(1)
    policy, setting, seen = load_run(args.policy)
    if args.problems:
        study(args, policy, setting, seen)
        return 0
    problem = setting.problem(args.landmarks)
    before = play(policy, [problem])[0]
    start = time.perf_counter()
    after, n_episodes = finetune(args, policy, setting, problem)
    seconds = time.perf_counter() - start
    optimum = solve(problem)
    plans = {"policy": before, "fine-tuned": after}
    solving.report(problem, plans, optimum)
    print(f"{n_episodes} episodes in {seconds:.1f} s")
    solving.save(args, problem, plans, optimum)
    return 0 if after.success else 1


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args, description=__doc__)))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error
