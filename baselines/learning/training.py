"""Reinforcement learning: problems one after the other, episode by episode, for any learner."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from baselines.learning.config import Options, own_options
from baselines.learning.train import Trainable, run_training
from baselines.networks import Network
from baselines.policies.acting import Acting
from baselines.policies.evaluation import EVALUATION_SEED, Evaluation
from baselines.policies.guidance import Guidance, GuidedPolicy, LinearSchedule
from baselines.policies.policy import NetworkPolicy
from baselines.policies.rules_of_thumb import RandomPolicy
from baselines.policies.settings import N_ACTIONS, Setting, read_setting
from baselines.runs.checkpoints import Saved
from mapp_env import Grid, mapp_v0, sample_problems
from mapp_env.grids import find_grid

METRICS = (
    *("episode", "problem", "steps", "reward", "solved", "epsilon", "guidance"),
    *("updates", "loss"),
)
POLICIES_WITH_ROUTES = ("network alone", "network, guidance 1")


class Learner(Saved, Protocol):
    """What is trained."""

    updates: int

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the greedy joint action (N,)."""

    def remember(
        self,
        observation: np.ndarray,
        actions: np.ndarray,
        reward: float,
        next_observation: np.ndarray,
        terminated: bool,
    ) -> None:
        """Store a transition."""

    @property
    def ready(self) -> bool:
        """Whether enough has been stored to learn."""

    def update(self, progress: float) -> float:
        """Learn from one batch; return the loss."""

    def policy(self) -> NetworkPolicy:
        """Return the trained policy."""


class Streams(NamedTuple):
    """Separate random streams, so that an extra draw in one does not shift the others."""

    network: np.random.SeedSequence
    problems: np.random.SeedSequence
    acting: np.random.SeedSequence
    replay: np.random.SeedSequence

    @classmethod
    def spawn(cls, seed: int) -> "Streams":
        """Derive the streams from the seed of a run."""
        return cls(*np.random.SeedSequence(seed).spawn(len(cls._fields)))


@dataclass
class Progress:
    """Where a training stands, to the step and to the update."""

    episodes: int = 0  # finished
    steps: int = 0  # played, in all
    actions: list[list[int]] = field(default_factory=list)  # of the episode so far
    pending: int = 0  # updates that are due
    over: bool = False  # whether the episode has ended, but for its updates
    solved: bool = False
    reward: float = 0.0  # of the episode so far
    epsilon: float = 0.0
    losses: float = 0.0  # of the episode, summed
    updates: int = 0  # of the episode


class Training(Trainable):
    """Episodes, the updates that are due after steps and episodes, and what is logged.

    Trained is the learner, on each of the problems: (P, K) landmark cells.
    """

    UNIT, COLUMNS, SHOWN = "episodes", METRICS, ("steps", "reward")
    args: Options

    def __init__(self, args: Options, grid: Grid, problems: np.ndarray, learner: Learner) -> None:
        super().__init__(args, args.n_episodes, args.episodes_per_problem)
        self.problems, self.learner = problems, learner
        self.env = mapp_v0.parallel_env(
            grid, args.n_agents, args.n_landmarks, args.max_cycles, args.reward
        )
        self.leader = self.env.possible_agents[0]  # the same for all agents
        self.rng = np.random.default_rng(Streams.spawn(args.seed).acting)
        self.guidance = Guidance(grid, args.n_agents, args.n_landmarks, args.guidance_reach)
        self.epsilon_at = LinearSchedule(args.epsilon_start, args.epsilon_end, args.epsilon_steps)
        self.guidance_at = LinearSchedule(
            args.guidance_start, args.guidance_end, round(args.guidance_fraction * args.n_episodes)
        )
        self.now = Progress()
        self.observation = self._reset()

    @property
    def network(self) -> Network:
        """What was learned."""
        return self.learner.policy().network

    @property
    def problem(self) -> int:
        """Index of the problem that is being trained on."""
        return self.now.episodes // self.args.episodes_per_problem

    def counts(self) -> dict[str, int]:
        """Return what was done so far."""
        now = self.now
        return {"episodes": now.episodes, "steps": now.steps, "updates": self.learner.updates}

    def advance(self) -> dict[str, object] | None:
        """Carry out one update or one step; return the row of an episode that it ends."""
        now, args = self.now, self.args
        if now.pending:
            # An episode's updates are spread evenly over it.
            done: float = now.episodes
            if args.updates_per_episode:
                done += 1 - now.pending / max(args.updates_per_episode, now.pending)
            now.losses += self.learner.update(done / args.n_episodes)
            now.updates += 1
            now.pending -= 1
            self.watch.lap("update")
        elif not now.over:
            self._step()
        return self._end_episode() if now.over and not now.pending else None

    def _step(self) -> None:
        now, args = self.now, self.args
        now.epsilon = self.epsilon_at(now.steps)
        obs, actions = self.observation, self._choose(now.epsilon)
        self.watch.lap("network acts")
        influence = self.guidance_at(now.episodes)
        if influence > 0.0:
            actions = self.guidance.apply(actions[None], obs[None], influence, self.rng)[0]
        self.watch.lap("guidance")
        next_obs, reward, terminated, truncated = self._step_env(actions.tolist())
        self.watch.lap("env")
        self.learner.remember(obs, actions, reward, next_obs, terminated)
        self.observation = next_obs
        now.actions.append(actions.tolist())
        now.reward += reward
        now.steps += 1
        now.solved, now.over = terminated, terminated or truncated
        if now.steps >= args.learning_starts and self.learner.ready:
            if args.update_interval and now.steps % args.update_interval == 0:
                now.pending += 1
            if now.over:
                now.pending += args.updates_per_episode
        self.watch.lap("memory")

    def _choose(self, epsilon: float) -> np.ndarray:
        """Return an epsilon-greedy joint action (N,); each agent explores independently."""
        n_agents = self.args.n_agents
        random_actions = self.rng.integers(N_ACTIONS, size=n_agents)
        explores = self.rng.random(n_agents) < epsilon
        if explores.all():
            return random_actions
        return np.where(explores, random_actions, self.learner.act(self.observation))

    def _step_env(self, actions: list[int]) -> tuple[np.ndarray, float, bool, bool]:
        commands = dict(zip(self.env.agents, actions, strict=True))
        obs, rewards, terminations, truncations, _ = self.env.step(commands)
        leader = self.leader
        return obs[leader], rewards[leader], terminations[leader], truncations[leader]

    def _reset(self) -> np.ndarray:
        problem = min(self.problem, len(self.problems) - 1)
        landmarks = self.problems[problem].tolist()
        obs: np.ndarray = self.env.reset(options={"landmarks": landmarks})[0][self.leader]
        return obs

    def _end_episode(self) -> dict[str, object]:
        now = self.now
        row: dict[str, object] = {
            "episode": now.episodes + 1,
            "problem": self.problem + 1,
            "steps": len(now.actions),
            "reward": now.reward,
            "solved": int(now.solved),
            "epsilon": now.epsilon,  # at the episode's last step
            "guidance": self.guidance_at(now.episodes),
            "updates": now.updates,
            "loss": now.losses / now.updates if now.updates else "",
        }
        self.now = Progress(episodes=now.episodes + 1, steps=now.steps)
        self.observation = self._reset()
        self.watch.lap("env")
        return row

    # -- checkpoints

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that change, by name."""
        return self.learner.arrays()

    def state(self) -> dict[str, Any]:
        """Return all other state, as JSON-ready values."""
        return {
            "progress": asdict(self.now),
            "observation": self.observation.tolist(),
            "rng": self.rng.bit_generator.state,
            "learner": self.learner.state(),
            "seconds": self.watch.seconds,
        }

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Take over what was saved; the episode so far is played again, as it is deterministic."""
        self.now = now = Progress(**state["progress"])
        self.rng.bit_generator.state = state["rng"]
        self.learner.restore(arrays, state["learner"])
        self.watch.seconds = dict(state["seconds"])
        self.observation = self._reset()
        now.reward, now.solved, now.over = 0.0, False, False
        for actions in now.actions:
            self.observation, reward, now.solved, truncated = self._step_env(actions)
            now.reward += reward
            now.over = now.solved or truncated

    def check_metrics(self, table: dict[str, list[float]]) -> None:
        """Compare where it stands with the rows of its finished episodes."""
        now = self.now
        finished = now.episodes, now.steps - len(now.actions), self.learner.updates - now.updates
        logged = len(table["episode"]), sum(table["steps"]), sum(table["updates"])
        if finished != logged:
            raise ValueError(
                f"finished episodes, their steps and updates are {finished} in it, and {logged} in "
                "metrics.csv"
            )

    # -- what comes out

    def rivals(self, policy: NetworkPolicy) -> dict[str, Acting]:
        """Return random agents, and with a training that was guided, guided ones."""
        args = self.args
        # As many streams as rows, so that a row keeps its stream whatever rows there are.
        rngs = iter(np.random.default_rng(EVALUATION_SEED).spawn(8))
        chance = RandomPolicy(args.n_agents, N_ACTIONS, next(rngs))
        if args.guidance_start == 0.0:
            return {"random": chance}

        def guided(acting: Acting, influence: float) -> GuidedPolicy:
            return GuidedPolicy(acting, self.guidance, influence, next(rngs))

        rows: dict[str, Acting] = {}
        if 0.0 < args.guidance_end < 1.0:
            rows[f"network, guidance {args.guidance_end:g}"] = guided(policy, args.guidance_end)
        rows["network, guidance 1"] = guided(policy, 1.0)
        return rows | {"random": chance, "random, guidance 1": guided(chance, 1.0)}

    def draw(self, folder: Path, evaluations: dict[str, Evaluation]) -> None:
        """Draw the paper's figures 2, 3 and 4."""
        # Only here, because drawing takes longer to import than everything before.
        from baselines.policies.figures import draw_learning_curves, draw_routes

        draw_learning_curves(folder)
        if evaluations:
            routes = {
                label: evaluations[label] for label in POLICIES_WITH_ROUTES if label in evaluations
            }
            draw_routes(folder, routes)


def training_problems(args: Options, grid: Grid) -> np.ndarray:
    """Draw the problems of a training, from its seed: (P, K)."""
    seed = int(Streams.spawn(args.seed).problems.generate_state(1)[0])
    return sample_problems(grid, args.n_problems, n_landmarks=args.n_landmarks, seed=seed)


def train_learner(
    args: Options, algorithm: str, make_learner: Callable[[Any, Grid, Streams], Learner]
) -> int:
    """Train a learner, evaluate, draw; return the exit code.

    Raises a ValueError if an option or the folder cannot be used.
    """
    args = own_options(args, algorithm)
    if args.resume is None:
        setting = Setting(find_grid(args.grid), args.n_agents, args.n_landmarks, args.max_cycles)
        problems = training_problems(args, setting.grid)
    else:
        setting, rows = read_setting(args.resume)
        problems = np.array(rows, np.int32)

    def make_training() -> Training:
        learner = make_learner(args, setting.grid, Streams.spawn(args.seed))
        return Training(args, setting.grid, problems, learner)

    return run_training(args, algorithm, setting, problems.tolist(), make_training)
