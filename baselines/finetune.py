"""Train a policy a little further on one problem: the paper's "short training on the problem".

Method: at most 30 more episodes on the problem. The first ones walk at random, so that it is known
where moves lead; the others are the policy's own. After each, the network learns from episodes
imagined on this problem alone (``imagined_replay``), with one step's cost as the reward.

Paper: section 5, last paragraph (arXiv 2110.01460).

Command::

    python baselines/finetune.py --policy pretrained --landmarks 0 6 20 42 48
    python baselines/finetune.py --policy pretrained --problems 100

Output: the costs before and after beside the optimum, and the routes; ``--picture`` and ``--plan``
as of solve.py. What counts is the best of the episodes that were played, the last one included.
With ``--problems`` that many unseen problems which the policy does not solve optimally are
fine-tuned, and it is said of how many the optimum was found.
"""

import sys
import time
from dataclasses import dataclass, replace

import numpy as np
import torch
import tyro
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines import solve as solving
from baselines.checks import check_count, check_number
from baselines.evaluation import count_unseen, evaluate, find_optima, unseen_problems
from baselines.meta_dqn import Args as TrainingArgs
from baselines.meta_dqn import MetaLearner
from baselines.options import preset_options
from baselines.policy import NetworkPolicy, find_weights
from baselines.settings import N_ACTIONS, Setting, read_setting
from baselines.training import Streams
from mapp_env import Plan, Problem, mapp_v0, replay, solve


@dataclass
class Args(solving.Args):
    """Options of fine-tuning."""

    problems: int = 0
    """in place of landmarks: number of random problems to try, none of them solved optimally"""
    episodes: int = 30
    """most episodes to play"""
    random_episodes: int = 8
    """how many of them walk at random"""
    updates_per_episode: int = 15
    """updates after each of the others"""
    learning_rate: float = 0.002
    """step size of Adam; it falls in a straight line to 0"""
    seed: int = 0
    """seed of everything random"""

    def __post_init__(self) -> None:
        check_count("problems", self.problems, 0, 1_000_000)
        check_count("episodes", self.episodes, 1, 30)
        check_count("random_episodes", self.random_episodes, 0, self.episodes - 1)
        check_count("updates_per_episode", self.updates_per_episode, 1, 10_000)
        check_number("learning_rate", self.learning_rate, 1e-12, 1.0)
        check_count("seed", self.seed, 0, 2**63 - 1)


def make_learner(
    args: Args, policy: NetworkPolicy, setting: Setting, problem: Problem
) -> MetaLearner:
    """Return a learner that goes on from a policy, on one problem alone.

    Raises
    ------
    ValueError
        If the policy is no meta-agent's: independent learners have no joint actions to try.
    """
    spec = policy.spec
    if spec.team != "one":
        raise ValueError(f"policy must be a meta-agent's, got one of {spec.team} learners")
    training = preset_options(
        TrainingArgs,
        "default",
        seed=args.seed,
        n_agents=spec.n_agents,
        n_landmarks=spec.n_landmarks,
        network=spec.kind,
        outputs=spec.outputs,
        dueling=spec.dueling,
        hidden_units=spec.hidden_units,
        code_units=spec.code_units,
        landmark_units=spec.landmark_units,
        learning_rate=args.learning_rate,
        learning_rate_warmup=0,
        batch_size=256,
        # One problem has few states, so more of what could be done is tried.
        tried_actions=4,
        imagined_exploration=0.3,
        final_from=0.0,
        prefetch=False,
    )
    learner = MetaLearner(training, setting.grid, Streams.spawn(args.seed))
    for network in (learner.network, learner.target):
        network.load_state_dict(policy.network.state_dict())
    assert learner.imagined is not None
    learner.imagined.problem = np.array(problem.landmarks)
    return learner


def finetune(
    args: Args, policy: NetworkPolicy, setting: Setting, problem: Problem
) -> tuple[Plan, int]:
    """Return the best plan of the episodes played, and how many they were.

    It ends early when an episode is as short as the way to the farthest landmark.
    """
    learner = make_learner(args, policy, setting, problem)
    env = mapp_v0.parallel_env(
        setting.grid, setting.n_agents, setting.n_landmarks, setting.max_cycles
    )
    rng = np.random.default_rng(args.seed)
    farthest = max(int(setting.grid.home[cell]) for cell in problem.landmarks)
    best: Plan | None = None
    own = args.episodes - args.random_episodes
    for episode in range(args.episodes):
        random = 0 < episode <= args.random_episodes  # the first shows what the policy can do
        plan = play(env, learner, problem, rng if random else None)
        if best is None or (plan.success, -plan.cover_time) > (best.success, -best.cover_time):
            best = plan
        if best.success and best.cover_time <= farthest:
            return best, episode + 1
        if episode >= args.random_episodes and learner.ready:
            done = (episode - args.random_episodes) / own
            for _ in range(args.updates_per_episode):
                learner.update(done)
    assert best is not None
    return best, args.episodes


def play(
    env: mapp_v0.parallel_env,
    learner: MetaLearner,
    problem: Problem,
    rng: np.random.Generator | None,
) -> Plan:
    """Play an episode, by the learner or at random, and let the learner remember it."""
    leader = env.possible_agents[0]
    seen = env.reset(options={"landmarks": list(problem.landmarks)})[0][leader]
    taken = []
    while env.agents:
        if rng is None:
            actions = learner.act(seen)
        else:
            actions = rng.integers(N_ACTIONS, size=len(env.agents))
        following, rewards, terminations, _, _ = env.step(
            dict(zip(env.agents, actions.tolist(), strict=True))
        )
        ended = terminations[leader]
        learner.remember(seen, actions, rewards[leader], following[leader], ended)
        seen = following[leader]
        taken.append(actions)
    return replay(replace(problem, max_cycles=None), np.array(taken))


def study(args: Args, policy: NetworkPolicy, setting: Setting, seen: list[tuple[int, ...]]) -> None:
    """Fine-tune on unseen problems that the policy does not solve optimally, and count."""
    landmarks = unseen_problems(
        setting, min(100 * args.problems, count_unseen(setting, seen)), seen
    )
    result = evaluate(policy, setting, landmarks, find_optima(setting, landmarks))
    chosen = landmarks[~(result.gaps <= 0.0)][: args.problems]
    optimum = find_optima(setting, chosen)
    assert optimum is not None
    seconds, found, gaps = [], 0, []
    for row, best in zip(tqdm(chosen.tolist(), disable=None), optimum.cover_time, strict=True):
        start = time.perf_counter()
        plan, _ = finetune(args, policy, setting, solving.make_problem(setting, tuple(row)))
        seconds.append(time.perf_counter() - start)
        found += plan.cover_time == best
        gaps.append(plan.cover_time / best - 1)
    print(
        f"{len(chosen)} problems that the policy does not solve optimally: the optimum found on "
        f"{found} ({100 * found / len(chosen):.1f} %), mean gap {100 * np.mean(gaps):.2f} %, "
        f"{np.mean(seconds):.1f} s each on average, {max(seconds):.1f} s at most"
    )


def main(args: Args) -> int:
    """Fine-tune on one problem; return the exit code."""
    torch.set_num_threads(1)
    policy, setting = solving.load(args.policy)
    if args.problems:
        seen = read_setting(find_weights(args.policy).parent)[1]
        study(args, policy, setting, seen)
        return 0
    problem = solving.make_problem(setting, args.landmarks)
    before = solving.solve_by_policy(policy, setting, problem)
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
