"""One network commands all agents: the paper's meta-agent, trained by deep Q-learning.

Method: DQN (Mnih et al. 2015) whose linear output has one score per action for each agent; each
agent takes the action with its own highest score, and each agent's chosen score is trained on the
team reward. A decaying guidance points agents to close landmarks while training.

Paper: M. Cetinkaya, Multi-Agent Path Planning Using Deep Reinforcement Learning, section 5
(arXiv 2110.01460). docs/paper.md goes through it item by item, with what the paper leaves open.

Command::

    python baselines/meta_dqn.py --preset paper --seed 0

Output: a new run folder (runs/meta_dqn-paper-seed0-<time>) with config.json, metrics.csv (a row
per episode), policy.safetensors, evaluation.csv and .md (1,000 unseen problems), the paper's
figures 2, 3 and 4, and timing.json. Ctrl-C ends a run early and leaves it readable (exit code 130).
"""

import signal
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
import tyro
from torch import Tensor, nn
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines.checks import check_choice, check_count, check_number
from baselines.evaluate import N_ACTIONS, find_grid
from baselines.evaluation import (
    EVALUATION_SEED,
    N_ROUTES,
    Evaluation,
    Setting,
    count_unseen,
    evaluate,
    find_optima,
    format_table,
    save_table,
    unseen_problems,
)
from baselines.guidance import Acting, Guidance, GuidedPolicy, LinearSchedule
from baselines.networks import NetworkSpec, PaperNetwork, build_network, torch_generator
from baselines.policy import (
    MAX_TABLE_CELLS,
    NearestLandmarkPolicy,
    NetworkPolicy,
    RandomPolicy,
    save_policy,
)
from baselines.replay_memory import Batch, ReplayMemory
from baselines.runs import (
    TIMING_FILE,
    WEIGHTS_FILE,
    RunFolder,
    StopSignals,
    Stopwatch,
    default_folder,
)
from mapp_env import Grid, mapp_v0, sample_problems

ALGORITHM = "meta_dqn"
METRICS = ("episode", "problem", "steps", "reward", "solved", "epsilon", "guidance", "loss")


# -- configuration -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Args:
    """Options of a training; the defaults are the preset's."""

    preset: Literal["paper"] = "paper"
    """where the other options start from; "paper": section 5 of the paper, and for what it leaves
    open the choices listed in docs/paper.md"""
    seed: int = 0
    """seed of everything random: the same seed gives the same metrics.csv and the same weights"""
    out: Path | None = None
    """the run folder, new or empty; by default runs/meta_dqn-PRESET-seedSEED-TIME"""

    grid: str = "paper-7x7"
    """bundled grid, or a map file"""
    n_agents: int = 3
    """number of agents"""
    n_landmarks: int = 5
    """number of landmarks in each problem"""
    max_cycles: int = 50
    """step limit of an episode"""
    reward: Literal["manhattan", "geodesic", "step"] = "manhattan"
    """the team reward (rule R6); the paper's is manhattan"""
    n_problems: int = 20
    """random problems to train on, one after the other"""
    episodes_per_problem: int = 30
    """consecutive episodes on each problem"""

    hidden_units: int = 512
    """rectifier units in each of the two hidden layers"""
    learning_rate: float = 0.001
    """step size of Adam"""
    discount: float = 0.95
    """discount factor of future rewards"""
    memory_size: int = 10_000
    """transitions in the replay memory; the oldest is forgotten first"""
    learning_starts: int = 500
    """steps played before the first update"""
    batch_size: int = 32
    """transitions in an update"""
    update_interval: int = 4
    """steps played between two updates"""
    target_interval: int = 100
    """updates between two copies of the network to the target network"""

    epsilon_start: float = 1.0
    """probability at the first step that an agent takes a random action"""
    epsilon_end: float = 0.1
    """the same probability after epsilon_steps steps, and from then on"""
    epsilon_steps: int = 10_000
    """steps over which epsilon falls in a straight line"""

    guidance_start: float = 1.0
    """probability in the first episode that an agent with a close landmark in sight goes there"""
    guidance_end: float = 0.1
    """the same probability after guidance_fraction of the episodes, and from then on"""
    guidance_fraction: float = 0.8
    """part of the episodes over which the guidance falls in a straight line"""
    guidance_reach: int = 3
    """how many moves away, straight and with no wall between, a landmark is still close"""

    evaluation_problems: int = 1000
    """unseen problems for the table at the end, or all there are if they are fewer; 0 leaves out
    the table and the routes"""
    threads: int = 1
    """threads of PyTorch"""

    def __post_init__(self) -> None:
        check_choice("preset", self.preset, ("paper",))
        check_choice("reward", self.reward, ("manhattan", "geodesic", "step"))
        check_count("seed", self.seed, 0, 2**63 - 1)
        check_count("n_agents", self.n_agents, 1, 16)
        check_count("n_landmarks", self.n_landmarks, 1, 256)
        check_count("max_cycles", self.max_cycles, 1, 1_000_000)
        check_count("n_problems", self.n_problems, 1, 1_000_000)
        check_count("episodes_per_problem", self.episodes_per_problem, 1, 1_000_000)
        check_count("hidden_units", self.hidden_units, 1, 4096)
        check_number("learning_rate", self.learning_rate, 1e-12, 1.0)
        check_number("discount", self.discount, 0.0, 1.0)
        check_count("memory_size", self.memory_size, 1, 10_000_000)
        check_count("learning_starts", self.learning_starts, 1, 1_000_000_000)
        check_count("batch_size", self.batch_size, 1, 65_536)
        check_count("update_interval", self.update_interval, 1, 1_000_000)
        check_count("target_interval", self.target_interval, 1, 1_000_000)
        check_number("epsilon_start", self.epsilon_start, 0.0, 1.0)
        check_number("epsilon_end", self.epsilon_end, 0.0, 1.0)
        check_count("epsilon_steps", self.epsilon_steps, 0, 1_000_000_000)
        check_number("guidance_start", self.guidance_start, 0.0, 1.0)
        check_number("guidance_end", self.guidance_end, 0.0, 1.0)
        check_number("guidance_fraction", self.guidance_fraction, 0.0, 1.0)
        check_count("guidance_reach", self.guidance_reach, 1, 512)
        check_count("evaluation_problems", self.evaluation_problems, 0, 1_000_000)
        check_count("threads", self.threads, 1, 1024)

    @property
    def n_episodes(self) -> int:
        """Episodes of the whole training."""
        return self.n_problems * self.episodes_per_problem


# -- network -----------------------------------------------------------------------------------


def make_network(args: Args, grid: Grid, generator: torch.Generator) -> PaperNetwork:
    """Build the network that commands all agents: N + 2K numbers in, N x A scores out."""
    spec = NetworkSpec(
        kind="paper",
        n_agents=args.n_agents,
        n_landmarks=args.n_landmarks,
        n_actions=N_ACTIONS,
        n_cells=grid.n_cells,
        hidden_units=args.hidden_units,
    )
    return build_network(spec, generator)


# -- acting ------------------------------------------------------------------------------------


def choose_actions(
    network: PaperNetwork, observation: np.ndarray, epsilon: float, rng: np.random.Generator
) -> np.ndarray:
    """Epsilon-greedy joint action (N,): each agent tosses its own coin."""
    n_agents = network.spec.n_agents
    random_actions = rng.integers(N_ACTIONS, size=n_agents)
    explores = rng.random(n_agents) < epsilon
    if explores.all():
        return random_actions
    with torch.inference_mode():
        scores = network(torch.from_numpy(observation[None]))
        greedy = scores[0].argmax(dim=-1).numpy()
    return np.where(explores, random_actions, greedy)


# -- loss --------------------------------------------------------------------------------------


def td_targets(rewards: Tensor, terminated: Tensor, next_scores: Tensor, discount: float) -> Tensor:
    """Return what each agent's chosen score should be: (B, N).

    Every agent gets the team reward, and goes on with the best of its own scores in the next
    state; after a termination nothing follows, after a truncation the episode would have gone on.

    Parameters
    ----------
    rewards, terminated
        (B,) the team reward; whether the episode ended because all landmarks were visited.
    next_scores
        (B, N, A) the target network's scores of the next states.
    discount
        Discount factor.
    """
    goes_on = (~terminated).to(rewards.dtype)
    return rewards[:, None] + discount * goes_on[:, None] * next_scores.amax(dim=-1)


def update(
    network: PaperNetwork,
    target: PaperNetwork,
    optimiser: torch.optim.Optimizer,
    batch: Batch,
    discount: float,
) -> float:
    """One step of Adam on the Huber loss (Mnih's clipped error) of a batch; return the loss."""
    observations, actions, rewards, next_observations, terminated = map(torch.from_numpy, batch)
    with torch.no_grad():
        targets = td_targets(rewards, terminated, target(next_observations), discount)
    chosen = network(observations).gather(2, actions[:, :, None])[:, :, 0]
    loss = nn.functional.smooth_l1_loss(chosen, targets)
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    optimiser.step()
    return loss.item()


# -- training ----------------------------------------------------------------------------------


@dataclass
class Training:
    """What a training ends with."""

    network: PaperNetwork
    signal: int | None  # what stopped it early
    watch: Stopwatch
    episodes: int = 0
    steps: int = 0
    updates: int = 0


class Streams(NamedTuple):
    """A stream for everything random, so that one more draw here moves nothing there."""

    network: np.random.SeedSequence
    problems: np.random.SeedSequence
    acting: np.random.SeedSequence
    replay: np.random.SeedSequence

    @classmethod
    def spawn(cls, seed: int) -> "Streams":
        """Derive the streams from the seed of a run."""
        return cls(*np.random.SeedSequence(seed).spawn(len(cls._fields)))


def train(
    args: Args, grid: Grid, problems: np.ndarray, run: RunFolder, signals: StopSignals
) -> Training:
    """Train on one problem after the other, as the paper's section 5 says."""
    streams = Streams.spawn(args.seed)
    acting_rng = np.random.default_rng(streams.acting)
    replay_rng = np.random.default_rng(streams.replay)

    env = mapp_v0.parallel_env(
        grid=grid,
        n_agents=args.n_agents,
        n_landmarks=args.n_landmarks,
        max_cycles=args.max_cycles,
        reward=args.reward,
    )
    leader = env.possible_agents[0]  # all agents see the same and are rewarded the same

    network = make_network(args, grid, torch_generator(streams.network))
    target = make_network(args, grid, torch.Generator())
    target.load_state_dict(network.state_dict())
    # The fused step on a CPU is what needs torch 2.4.
    optimiser = torch.optim.Adam(network.parameters(), lr=args.learning_rate, fused=True)
    memory = ReplayMemory(args.memory_size, network.spec.observation_size, args.n_agents)

    guidance = Guidance(grid, args.n_agents, args.n_landmarks, args.guidance_reach)
    epsilon_at = LinearSchedule(args.epsilon_start, args.epsilon_end, args.epsilon_steps)
    guidance_at = LinearSchedule(
        args.guidance_start, args.guidance_end, round(args.guidance_fraction * args.n_episodes)
    )

    done = Training(network, signal=None, watch=Stopwatch())
    watch = done.watch
    progress = tqdm(total=args.n_episodes, unit="episode", disable=None)  # None: if no terminal
    for episode in range(args.n_episodes):
        problem = episode // args.episodes_per_problem
        influence = guidance_at(episode)
        observations, _ = env.reset(options={"landmarks": problems[problem].tolist()})
        observation = observations[leader]
        terminated = truncated = False
        total_reward, losses = 0.0, []
        steps = 0
        watch.lap("env")

        while not (terminated or truncated):
            if signals.received is not None:
                done.signal = signals.received
                break
            epsilon = epsilon_at(done.steps)
            actions = choose_actions(network, observation, epsilon, acting_rng)
            watch.lap("network acts")
            actions = guidance.apply(actions[None], observation[None], influence, acting_rng)[0]
            watch.lap("guidance")

            commands = dict(zip(env.agents, actions.tolist(), strict=True))
            observations, rewards, terminations, truncations, _ = env.step(commands)
            next_observation, reward = observations[leader], rewards[leader]
            terminated, truncated = terminations[leader], truncations[leader]
            watch.lap("env")

            memory.add(observation, actions, reward, next_observation, terminated)
            observation = next_observation
            total_reward += reward
            steps += 1
            done.steps += 1
            watch.lap("memory")

            if done.steps >= args.learning_starts and done.steps % args.update_interval == 0:
                batch = memory.sample(args.batch_size, replay_rng)
                watch.lap("memory")
                losses.append(update(network, target, optimiser, batch, args.discount))
                done.updates += 1
                if done.updates % args.target_interval == 0:
                    target.load_state_dict(network.state_dict())
                watch.lap("update")

        if done.signal is not None:
            break
        done.episodes += 1
        row = {
            "episode": episode + 1,
            "problem": problem + 1,
            "steps": steps,
            "reward": total_reward,
            "solved": int(terminated),
            "epsilon": epsilon,  # at the episode's last step
            "guidance": influence,
            "loss": float(np.mean(losses)) if losses else "",
        }
        run.log(row)
        progress.set_postfix(steps=steps, reward=f"{total_reward:.0f}", epsilon=f"{epsilon:.2f}")
        progress.update()
        if (episode + 1) % args.episodes_per_problem == 0:
            save_policy(run.path(WEIGHTS_FILE), network)
        watch.lap("log and save")

    progress.close()
    save_policy(run.path(WEIGHTS_FILE), network)
    watch.lap("log and save")
    run.write_json(
        TIMING_FILE,
        {
            "episodes": done.episodes,
            "steps": done.steps,
            "updates": done.updates,
            "seconds": {name: round(s, 3) for name, s in watch.seconds.items()},
            "seconds_total": round(watch.total, 3),
        },
    )
    return done


# -- evaluation --------------------------------------------------------------------------------


def evaluate_training(
    args: Args, setting: Setting, problems: np.ndarray, trained: PaperNetwork
) -> dict[str, Evaluation]:
    """Play unseen problems with the network alone, with guidance, and with its rivals."""
    grid = setting.grid
    guidance = Guidance(grid, args.n_agents, args.n_landmarks, args.guidance_reach)
    rngs = iter(np.random.default_rng(EVALUATION_SEED).spawn(8))

    def guided(policy: Acting, influence: float) -> GuidedPolicy:
        return GuidedPolicy(policy, guidance, influence, next(rngs))

    network = NetworkPolicy(trained)
    chance = RandomPolicy(args.n_agents, N_ACTIONS, next(rngs))
    policies: dict[str, Acting] = {"network alone": network}
    if 0.0 < args.guidance_end < 1.0:
        policies[f"network, guidance {args.guidance_end:g}"] = guided(network, args.guidance_end)
    policies["network, guidance 1"] = guided(network, 1.0)
    policies["random"] = chance
    policies["random, guidance 1"] = guided(chance, 1.0)
    if grid.n_cells <= MAX_TABLE_CELLS:
        policies["nearest landmark"] = NearestLandmarkPolicy(grid, args.n_agents, args.n_landmarks)
    else:
        print(f"no row for the nearest landmark: the grid has more than {MAX_TABLE_CELLS:,} cells")
    optima = find_optima(setting, problems)
    return {
        label: evaluate(policy, setting, problems, optima, n_kept=N_ROUTES, progress=label)
        for label, policy in policies.items()
    }


def main(args: Args) -> int:
    """Train, evaluate, draw; return the exit code."""
    torch.set_num_threads(args.threads)
    # All that can be refused is refused before anything is written.
    setting = Setting(find_grid(args.grid), args.n_agents, args.n_landmarks, args.max_cycles)
    problems = sample_problems(
        setting.grid,
        args.n_problems,
        n_landmarks=args.n_landmarks,
        seed=int(Streams.spawn(args.seed).problems.generate_state(1)[0]),
    )
    seen = problems.tolist()
    n_evaluated = min(args.evaluation_problems, count_unseen(setting, seen))
    unseen = unseen_problems(setting, n_evaluated, seen) if n_evaluated else None

    folder = args.out or default_folder(ALGORITHM, args.preset, args.seed)
    run = RunFolder(folder, METRICS)
    run.write_config(
        {
            "algorithm": ALGORITHM,
            "options": {**asdict(args), "out": str(folder)},
            "grid": setting.grid.to_text(),
            "training_problems": seen,
        }
    )
    if n_evaluated < args.evaluation_problems:
        print(
            f"{n_evaluated:,} of {args.evaluation_problems:,} evaluation problems: there are no "
            "more unseen ones"
        )
    signals = StopSignals()
    try:
        with signals:
            training = train(args, setting.grid, problems, run, signals)
        print(
            f"{training.episodes} episodes, {training.steps:,} steps and {training.updates:,} "
            f"updates in {training.watch}"
        )
        if training.signal is not None:
            raise KeyboardInterrupt
        # Only here, because drawing takes longer to import than everything before.
        from baselines.figures import draw_learning_curves, draw_routes

        draw_learning_curves(folder)
        if unseen is not None:
            evaluations = evaluate_training(args, setting, unseen, training.network)
            save_table(folder, evaluations)
            print(f"\n{len(unseen):,} unseen problems:\n\n{format_table(evaluations)}")
            shown = ("network alone", "network, guidance 1")
            draw_routes(folder, {label: evaluations[label] for label in shown})
    except KeyboardInterrupt:
        print(f"stopped early; what there is so far is in {folder}", flush=True)
        return 128 + (signals.received or signal.SIGINT)
    finally:
        run.close()
    print(f"\nrun folder: {folder}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args, description=__doc__)))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error
