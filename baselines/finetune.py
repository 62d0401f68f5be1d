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
import time
from dataclasses import dataclass, fields, replace
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import nn
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines import solve as solving
from baselines.learning.config import run_script
from baselines.learning.q_learning import joint_values
from baselines.learning.ranges import Within, check_options
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
from baselines.policies.rules_of_thumb import RandomPolicy
from baselines.policies.settings import N_ACTIONS, PolicyOfRun, load_run
from baselines.replay.imagined import UNKNOWN, join
from mapp_env import Plan, Problem, mapp_v0, replay, solve
from mapp_env.engine.loops import visit_rows
from mapp_env.engine.world import make_world

# Values of one network differ by tenths where logits of another differ by tens: actions are drawn
# at inverse temperatures from one end to the other, episode by episode.
INVERSE_TEMPERATURES = (0.1, 16.0)
LEARNING = ("imagined", "updates_per_episode", "learning_rate", "patience")


@dataclass
class Args(solving.Args):
    """Options of fine-tuning."""

    problems: Annotated[int, Within(0, 1_000_000)] = 0
    """in place of landmarks: number of random problems to try, none of them solved optimally"""
    episodes: Annotated[int, Within(1, 30)] = 30
    """most episodes to play"""
    random_episodes: Annotated[int, Within(0, 29)] = 8
    """number of random-walk episodes after the first"""
    imagined: Annotated[int, Within(1, 65_536)] = 4096
    """episodes imagined before each of the others"""
    updates_per_episode: Annotated[int, Within(1, 10_000)] = 10
    """updates after that"""
    learning_rate: Annotated[float, Within(1e-12, 1.0)] = 0.002
    """step size of Adam"""
    patience: Annotated[int, Within(1, 30)] = 5
    """stop after this many of its own episodes without improvement"""
    seed: Annotated[int, Within(0, 2**63 - 1)] = 0
    """seed of everything random"""

    def __post_init__(self) -> None:
        check_options(self)
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
    """What was observed and done until all landmarks were visited."""

    observations: np.ndarray  # (T, N + 2K) float32
    joint: np.ndarray  # (T,) int64, joint actions


class Tuner:
    """A copy of a network, what it knows of the grid, and the problem it is trained on."""

    def __init__(self, args: Args, network: Network, problem: Problem) -> None:
        spec = network.spec
        if spec.n_joint_actions > MAX_JOINT_ACTIONS:
            raise ValueError(
                f"policy must be of a team with at most {MAX_JOINT_ACTIONS:,} joint actions, got "
                f"{spec.n_joint_actions:,}"
            )
        self.args, self.problem = args, problem
        self.network, self.spec = copy.deepcopy(network), spec
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=args.learning_rate)
        self.rng = np.random.default_rng(args.seed)
        self.moves = np.full((problem.grid.n_cells, N_ACTIONS), UNKNOWN, np.int64)  # experienced
        self.world = make_world(problem.grid, spec.n_agents, spec.n_landmarks)
        self.digits = split_joint(np.arange(spec.n_joint_actions), spec.n_agents, N_ACTIONS)
        self.best: Episode | None = None

    def run_episode(self, env: mapp_v0.parallel_env, random: bool) -> Plan:
        """Play an episode, greedily or at random, and keep where each agent's moves have led."""
        n = self.spec.n_agents
        policy = RandomPolicy(n, N_ACTIONS, self.rng) if random else NetworkPolicy(self.network)
        leader = env.possible_agents[0]
        obs = env.reset(options={"landmarks": list(self.problem.landmarks)})[0][leader]
        taken = []
        while env.agents:
            actions = policy.act(obs[None])[0]
            next_obs = env.step(dict(zip(env.agents, actions.tolist(), strict=True)))[0][leader]
            self.moves[obs[:n].astype(np.int64), actions] = next_obs[:n]
            obs = next_obs
            taken.append(actions)
        return replay(replace(self.problem, max_cycles=None), np.array(taken))

    def train(self) -> None:
        """Imagine episodes, and learn to do what was done in the shortest so far."""
        found = self.imagine()
        if found is not None and (self.best is None or len(found.joint) < len(self.best.joint)):
            self.best = found
        if self.best is None:
            return
        observations, joint = (
            torch.from_numpy(array).to(self.network.device) for array in self.best
        )
        for _ in range(self.args.updates_per_episode):
            scores = joint_values(self.network(observations), self.spec)
            loss = nn.functional.cross_entropy(scores, joint)
            self.optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self.optimiser.step()

    def imagine(self) -> Episode | None:
        """Return the shortest of many imagined episodes, None if none visits all landmarks."""
        n_rows, problem = self.args.imagined, self.problem
        inverse_temperature = np.geomspace(*INVERSE_TEMPERATURES, n_rows, dtype=np.float32)
        cells = np.full((n_rows, self.spec.n_agents), problem.grid.depot)
        landmarks = np.tile(np.array(problem.landmarks), (n_rows, 1))
        visited = np.zeros(landmarks.shape, np.bool_)
        observations, taken = [], []
        limit = problem.max_cycles if self.best is None else len(self.best.joint)
        for _ in range(limit or 0):
            known = (self.moves[cells[:, None, :], self.digits] != UNKNOWN).all(axis=2)
            going_on = known.any(axis=1)  # the others are on cells without known moves
            if not going_on.any():
                return None
            observations.append(join(cells, landmarks, visited))
            with torch.inference_mode():
                given = torch.from_numpy(observations[-1]).to(self.network.device)
                values = joint_values(self.network(given), self.spec).cpu().numpy()
            # The largest of logits and Gumbel noise is a draw from the policy.
            logits = inverse_temperature[:, None] * values
            scores = logits + self.rng.gumbel(size=known.shape)
            taken.append(np.where(known, scores, -np.inf).argmax(axis=1))
            moved = self.moves[cells, self.digits[taken[-1]]]
            cells = np.where(going_on[:, None], moved, cells)
            visited, _, solved = visit_rows(self.world, cells, landmarks, visited)
            if solved.any():
                row = int(solved.argmax())
                return Episode(np.stack(observations)[:, row], np.stack(taken)[:, row])
        return None


def finetune(args: Args, policy: NetworkPolicy, problem: Problem) -> tuple[Plan, int]:
    """Return the best plan of the episodes played, and how many they were.

    It ends early when nothing has become better for a while.

    Raises a ValueError if the policy is of another grid than the problem, or of too large a team.
    """
    check_grid(policy, problem.grid)
    tuner = Tuner(args, policy.network, problem)
    env = mapp_v0.parallel_env(
        problem.grid, problem.n_agents, len(problem.landmarks), problem.max_cycles or 50
    )
    best: Plan | None = None
    waited = 0
    for episode in range(args.episodes):
        random = 0 < episode <= args.random_episodes  # the first shows what the policy can do
        if episode > args.random_episodes:
            tuner.train()
        plan = tuner.run_episode(env, random)
        waited += episode > args.random_episodes
        if best is None or (plan.success, -plan.cover_time) > (best.success, -best.cover_time):
            best, waited = plan, 0
        if best.success and waited >= args.patience:
            return best, episode + 1
    assert best is not None
    return best, args.episodes


def tune_many(args: Args, run: PolicyOfRun) -> None:
    """Fine-tune on random problems that the policy does not solve optimally, and count.

    Raises a ValueError if the optimum of so many landmarks is not known.
    """
    policy, setting, known = run
    n_problems = min(100 * args.problems, count_unseen(setting, known))
    landmarks = unseen_problems(setting, n_problems, known, args.seed)
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
    seconds, gaps = np.empty(len(rows)), np.empty(len(rows))
    for index, row in enumerate(tqdm(rows, disable=None)):
        start = time.perf_counter()
        plan, _ = finetune(args, policy, setting.problem(tuple(landmarks[row].tolist())))
        seconds[index] = time.perf_counter() - start
        gaps[index] = plan.cover_time / optima.cover_time[row] - 1.0
    solved, found = np.isfinite(gaps), int((gaps == 0.0).sum())
    print(
        f"{len(rows)} problems that the policy does not solve optimally, of {len(landmarks):,}: "
        f"solved {solved.sum()}, the optimum found on {found} ({100 * found / len(rows):.1f} %), "
        f"mean gap {100 * np.mean(gaps[solved]) if solved.any() else np.nan:.2f} %, "
        f"{np.mean(seconds):.1f} s each on average, {max(seconds):.1f} s at most"
    )


def main(args: Args) -> int:
    """Fine-tune on one problem; return the exit code."""
    torch.set_num_threads(1)
    run = load_run(args.policy, args.device)
    if args.problems:
        tune_many(args, run)
        return 0
    problem = run.setting.problem(args.landmarks)
    (before,) = play(run.policy, [problem])
    start = time.perf_counter()
    after, n_episodes = finetune(args, run.policy, problem)
    seconds = time.perf_counter() - start
    optimum = solve(problem)
    plans = {"policy": before, "fine-tuned": after}
    solving.report(problem, plans, optimum)
    print(f"{n_episodes} episodes in {seconds:.1f} s")
    solving.save(args, problem, plans, optimum)
    return 0 if after.success else 1


if __name__ == "__main__":
    run_script(main, Args, __doc__)
