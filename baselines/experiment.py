"""The paper's experiment with any learner: problems one after the other, episode by episode.

What a run does between its first and its last line, whichever learner it trains: the episodes, the
updates that are due, metrics, checkpoints, and at the end the table and the figures.
"""

import dataclasses
import signal
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines.checkpoints import Checkpoints
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
from baselines.options import Options, check_resumed
from baselines.policy import (
    MAX_TABLE_CELLS,
    NearestLandmarkPolicy,
    NetworkPolicy,
    RandomPolicy,
    save_policy,
)
from baselines.runs import (
    TIMING_FILE,
    WEIGHTS_FILE,
    RunFolder,
    StopSignals,
    Stopwatch,
    default_folder,
    read_config,
)
from baselines.settings import N_ACTIONS, find_grid, read_setting
from mapp_env import Grid, mapp_v0, sample_problems

METRICS = (
    *("episode", "problem", "steps", "reward", "solved", "epsilon", "guidance"),
    *("updates", "loss"),
)
SAVED = ("network alone", "network, guidance 1")


class Learner(Protocol):
    """What is trained."""

    updates: int

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the greedy joint action (N,)."""
        ...

    def remember(
        self,
        observation: np.ndarray,
        actions: np.ndarray,
        reward: float,
        next_observation: np.ndarray,
        terminated: bool,
    ) -> None:
        """Take note of a transition."""
        ...

    @property
    def ready(self) -> bool:
        """Whether there is something to learn from."""
        ...

    def update(self, progress: float) -> float:
        """Learn from one batch; return the loss."""
        ...

    def policy(self) -> NetworkPolicy:
        """Return what was learned."""
        ...

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that change, by name."""
        ...

    def state(self) -> dict[str, Any]:
        """Return all else that changes, ready for JSON."""
        ...

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Take over what the two above returned."""
        ...


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


# -- training ----------------------------------------------------------------------------------


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


class Training:
    """A training that can be stopped between any two steps or updates, and carried on.

    Parameters
    ----------
    args
        Options.
    grid
        The grid.
    problems
        (P, K) landmark cells, a training problem per row.
    learner
        What is trained.
    """

    def __init__(self, args: Options, grid: Grid, problems: np.ndarray, learner: Learner) -> None:
        self.args, self.problems, self.learner = args, problems, learner
        self.env = mapp_v0.parallel_env(
            grid=grid,
            n_agents=args.n_agents,
            n_landmarks=args.n_landmarks,
            max_cycles=args.max_cycles,
            reward=args.reward,
        )
        self.leader = self.env.possible_agents[0]  # all see the same and are rewarded the same
        self.rng = np.random.default_rng(Streams.spawn(args.seed).acting)
        self.guidance = Guidance(grid, args.n_agents, args.n_landmarks, args.guidance_reach)
        self.epsilon_at = LinearSchedule(args.epsilon_start, args.epsilon_end, args.epsilon_steps)
        self.guidance_at = LinearSchedule(
            args.guidance_start, args.guidance_end, round(args.guidance_fraction * args.n_episodes)
        )
        self.now = Progress()
        self.watch = Stopwatch()
        self.observation = self._reset()

    @property
    def finished(self) -> bool:
        """Whether all episodes are over."""
        return self.now.episodes >= self.args.n_episodes

    @property
    def problem(self) -> int:
        """Index of the problem that is being trained on."""
        return self.now.episodes // self.args.episodes_per_problem

    def advance(self) -> dict[str, object] | None:
        """Carry out one update or one step; return the row of an episode that it ends."""
        now, args = self.now, self.args
        if now.pending:
            # An episode's updates are spread evenly over it.
            done = now.episodes
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
        actions = self._choose(now.epsilon)
        self.watch.lap("network acts")
        influence = self.guidance_at(now.episodes)
        seen = self.observation
        if influence > 0.0:
            actions = self.guidance.apply(actions[None], seen[None], influence, self.rng)[0]
        self.watch.lap("guidance")
        following, reward, terminated, truncated = self._play(actions.tolist())
        self.watch.lap("env")
        self.learner.remember(seen, actions, reward, following, terminated)
        self.observation = following
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
        """Return an epsilon-greedy joint action (N,): each agent tosses its own coin."""
        n_agents = self.args.n_agents
        random_actions = self.rng.integers(N_ACTIONS, size=n_agents)
        explores = self.rng.random(n_agents) < epsilon
        if explores.all():
            return random_actions
        return np.where(explores, random_actions, self.learner.act(self.observation))

    def _play(self, actions: list[int]) -> tuple[np.ndarray, float, bool, bool]:
        commands = dict(zip(self.env.agents, actions, strict=True))
        seen, rewards, terminations, truncations, _ = self.env.step(commands)
        leader = self.leader
        return seen[leader], rewards[leader], terminations[leader], truncations[leader]

    def _reset(self) -> np.ndarray:
        problem = min(self.problem, len(self.problems) - 1)
        seen, _ = self.env.reset(options={"landmarks": self.problems[problem].tolist()})
        observation: np.ndarray = seen[self.leader]
        return observation

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

    def state(self) -> dict[str, Any]:
        """Return all that changes but for arrays, ready for JSON."""
        return {
            "progress": asdict(self.now),
            "rng": self.rng.bit_generator.state,
            "learner": self.learner.state(),
            "seconds": self.watch.seconds,
        }

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Take over what :meth:`state` and the learner's arrays were."""
        self.now = Progress(**state["progress"])
        self.rng.bit_generator.state = state["rng"]
        self.learner.restore(arrays, state["learner"])
        self.watch.seconds = dict(state["seconds"])
        # The episode so far is played again: the rules leave nothing to chance.
        self.observation = self._reset()
        for actions in self.now.actions:
            self.observation = self._play(actions)[0]


def train(
    training: Training, run: RunFolder, checkpoints: Checkpoints, signals: StopSignals
) -> None:
    """Train until all episodes are over, or a signal comes; then leave a checkpoint."""
    args, learner = training.args, training.learner

    def save() -> None:
        number = training.now.steps + learner.updates
        state = {**training.state(), "metrics": run.position()}
        checkpoints.save(number, learner.arrays(), state)
        training.watch.lap("log and save")

    progress = tqdm(
        total=args.n_episodes,
        initial=training.now.episodes,
        unit=" episodes",
        disable=None,  # None: if there is no terminal
    )
    saved = time.monotonic()
    while not training.finished and signals.received is None:
        row = training.advance()
        if row is not None:
            run.log(row)
            reward = row["reward"]
            progress.set_postfix(steps=row["steps"], reward=f"{reward:.0f}")
            progress.update()
            if training.now.episodes % args.episodes_per_problem == 0:
                save_policy(run.path(WEIGHTS_FILE), learner.policy().network)
            training.watch.lap("log and save")
        if time.monotonic() - saved >= args.checkpoint_seconds:
            save()
            saved = time.monotonic()
    progress.close()
    save()
    save_policy(run.path(WEIGHTS_FILE), learner.policy().network)
    training.watch.lap("log and save")
    run.write_json(
        TIMING_FILE,
        {
            "episodes": training.now.episodes,
            "steps": training.now.steps,
            "updates": learner.updates,
            "seconds": {name: round(s, 3) for name, s in training.watch.seconds.items()},
            "seconds_total": round(training.watch.total, 3),
        },
    )


# -- evaluation --------------------------------------------------------------------------------


def evaluate_training(
    args: Options, setting: Setting, problems: np.ndarray, trained: NetworkPolicy
) -> dict[str, Evaluation]:
    """Evaluate what was learned, with and without guidance, and rivals, on unseen problems."""
    grid = setting.grid
    guidance = Guidance(grid, args.n_agents, args.n_landmarks, args.guidance_reach)
    # As many streams as rows, so that a row keeps its stream whatever rows there are.
    rngs = iter(np.random.default_rng(EVALUATION_SEED).spawn(8))

    def guided(policy: Acting, influence: float) -> GuidedPolicy:
        return GuidedPolicy(policy, guidance, influence, next(rngs))

    chance = RandomPolicy(args.n_agents, N_ACTIONS, next(rngs))
    policies: dict[str, Acting] = {"network alone": trained}
    if args.guidance_start > 0.0:
        if 0.0 < args.guidance_end < 1.0:
            policies[f"network, guidance {args.guidance_end:g}"] = guided(
                trained, args.guidance_end
            )
        policies["network, guidance 1"] = guided(trained, 1.0)
        policies["random"] = chance
        policies["random, guidance 1"] = guided(chance, 1.0)
    else:
        policies["random"] = chance
    if grid.n_cells <= MAX_TABLE_CELLS:
        policies["nearest landmark"] = NearestLandmarkPolicy(grid, args.n_agents, args.n_landmarks)
    else:
        print(f"no row for the nearest landmark: the grid has more than {MAX_TABLE_CELLS:,} cells")
    optima = find_optima(setting, problems)
    return {
        label: evaluate(policy, setting, problems, optima, n_kept=N_ROUTES, progress=label)
        for label, policy in policies.items()
    }


# -- the whole run -----------------------------------------------------------------------------


def run_experiment(
    args: Options, algorithm: str, make_learner: Callable[[Any, Grid, Streams], Learner]
) -> int:
    """Train, evaluate, draw; return the exit code."""
    resumed = args.resume
    if resumed is not None:
        check_resumed(args)
        args = read_options(type(args), resumed, algorithm)
    torch.set_num_threads(args.threads)
    # All that can be refused is refused before anything is written.
    if resumed is None:
        setting = Setting(find_grid(args.grid), args.n_agents, args.n_landmarks, args.max_cycles)
        problems = sample_problems(
            setting.grid,
            args.n_problems,
            n_landmarks=args.n_landmarks,
            seed=int(Streams.spawn(args.seed).problems.generate_state(1)[0]),
        )
    else:
        setting, rows = read_setting(resumed)
        problems = np.array(rows, np.int32)
    seen = problems.tolist()
    n_evaluated = min(args.evaluation_problems, count_unseen(setting, seen))
    unseen = unseen_problems(setting, n_evaluated, seen) if n_evaluated else None
    training = Training(
        args, setting.grid, problems, make_learner(args, setting.grid, Streams.spawn(args.seed))
    )

    folder = resumed or args.out or default_folder(algorithm, args.preset, args.seed)
    config = {
        "algorithm": algorithm,
        "options": {**asdict(args), "out": str(folder), "resume": None},
        "grid": setting.grid.to_text(),
        "training_problems": seen,
    }
    run = RunFolder(folder, METRICS, resume=resumed is not None)
    signals = StopSignals()
    try:
        # The folder's name is none of what a run is: it may be moved.
        identity = {**config, "options": {**asdict(args), "out": None, "resume": None}}
        checkpoints = Checkpoints(folder, identity)
        if resumed is None:
            run.write_config(config)
        else:
            restore(training, run, checkpoints)
        if n_evaluated < args.evaluation_problems:
            print(
                f"{n_evaluated:,} of {args.evaluation_problems:,} evaluation problems: there are "
                "no more unseen ones"
            )
        with signals:
            train(training, run, checkpoints, signals)
        print(
            f"{training.now.episodes} episodes, {training.now.steps:,} steps and "
            f"{training.learner.updates:,} updates in {training.watch}"
        )
        if signals.received is not None:
            raise KeyboardInterrupt
        finish(args, folder, setting, unseen, training.learner.policy())
    except KeyboardInterrupt:
        print(f"stopped early; go on with --resume {folder}", flush=True)
        return 128 + (signals.received or signal.SIGINT)
    except OSError as error:
        raise ValueError(f"{folder}: cannot be written: {error}") from error
    finally:
        run.close()
    print(f"\nrun folder: {folder}")
    return 0


def finish(
    args: Options,
    folder: Path,
    setting: Setting,
    unseen: np.ndarray | None,
    trained: NetworkPolicy,
) -> None:
    """Evaluate and draw."""
    # Only here, because drawing takes longer to import than everything before.
    from baselines.figures import draw_learning_curves, draw_routes

    draw_learning_curves(folder)
    if unseen is not None:
        evaluations = evaluate_training(args, setting, unseen, trained)
        save_table(folder, evaluations)
        print(f"\n{len(unseen):,} unseen problems:\n\n{format_table(evaluations)}")
        draw_routes(folder, {label: evaluations[label] for label in SAVED if label in evaluations})


def restore(training: Training, run: RunFolder, checkpoints: Checkpoints) -> None:
    """Bring a training to its newest whole checkpoint, or to its start if there is none.

    Raises
    ------
    ValueError
        If there are checkpoints but none can be used, or metrics.csv has changed.
    """
    checkpoint, problems = checkpoints.latest()
    for problem in problems:
        print(f"not used: {problem}")
    if checkpoint is None:
        run.restart()
        print("no checkpoint had been written: from the start")
        return
    try:
        run.rewind(checkpoint.state["metrics"])
        training.restore(checkpoint.arrays, checkpoint.state)
    except (KeyError, TypeError, RuntimeError, IndexError) as error:
        raise ValueError(
            f"checkpoint {checkpoint.number} does not fit this run: {error}"
        ) from error
    print(f"going on from episode {training.now.episodes + 1}, step {training.now.steps:,}")


def read_options(kind: type[Options], folder: Path, algorithm: str) -> Options:
    """Read a run's options.

    Raises
    ------
    ValueError
        If they are not those of this algorithm.
    """
    config = read_config(folder)
    if config.get("algorithm") != algorithm:
        raise ValueError(f"{folder}: a run of {config.get('algorithm')!r}, not of {algorithm}")
    options = config.get("options")
    names = {field.name for field in dataclasses.fields(kind)}
    if not isinstance(options, dict) or options.keys() != names:
        raise ValueError(f"{folder}: its options are not those of this version")
    try:
        return kind(**{**options, "out": None, "resume": None})
    except TypeError as error:
        raise ValueError(f"{folder}: {error}") from error
