"""The paper's experiment with any learner: problems one after the other, episode by episode.

What a run does between its first and its last line, whichever learner it trains: the episodes, the
updates that are due, metrics, checkpoints, and at the end the table and the figures.
"""

import dataclasses
import signal
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines.learning.config import Options, check_resumed
from baselines.learning.training import METRICS, Learner, Streams, Training
from baselines.policies.acting import Acting
from baselines.policies.evaluation import (
    EVALUATION_SEED,
    N_ROUTES,
    Evaluation,
    count_unseen,
    evaluate,
    find_optima,
    format_table,
    out_of_reach,
    save_table,
    unseen_problems,
)
from baselines.policies.guidance import Guidance, GuidedPolicy
from baselines.policies.policy import NetworkPolicy, save_policy
from baselines.policies.rules_of_thumb import RandomPolicy, rules_of_thumb
from baselines.policies.settings import N_ACTIONS, Setting, read_setting
from baselines.runs.checkpoints import Checkpoints, go_on, save
from baselines.runs.folder import (
    METRICS_FILE,
    TIMING_FILE,
    WEIGHTS_FILE,
    RunFolder,
    StopSignals,
    default_folder,
    read_config,
)
from mapp_env import Grid, sample_problems
from mapp_env.grids import find_grid

SAVED = ("network alone", "network, guidance 1")


# -- training ----------------------------------------------------------------------------------


def training_problems(args: Options, grid: Grid) -> np.ndarray:
    """Draw the problems of a training, from its seed: (P, K)."""
    return sample_problems(
        grid,
        args.n_problems,
        n_landmarks=args.n_landmarks,
        seed=int(Streams.spawn(args.seed).problems.generate_state(1)[0]),
    )


def keep_weights(training: Training, run: RunFolder) -> None:
    """Write the weights of the policy that is learned, for the grid it is learned on."""
    network, grid = training.learner.policy().network, training.guidance.grid
    save_policy(run.path(WEIGHTS_FILE), network, grid, training.args.half_precision)


def train(
    training: Training, run: RunFolder, checkpoints: Checkpoints, signals: StopSignals
) -> None:
    """Train until all episodes are over, or a signal comes; then leave a checkpoint."""
    args = training.args
    if not checkpoints.numbers():
        save(run, checkpoints, training)
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
                keep_weights(training, run)
            training.watch.lap("log and save")
        if time.monotonic() - saved >= args.checkpoint_seconds:
            save(run, checkpoints, training)
            training.watch.lap("log and save")
            saved = time.monotonic()
    progress.close()
    save(run, checkpoints, training)
    keep_weights(training, run)
    training.watch.lap("log and save")
    run.write_json(
        TIMING_FILE,
        {
            "episodes": training.now.episodes,
            "steps": training.now.steps,
            "updates": training.learner.updates,
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
    policies.update(rules_of_thumb(setting))
    optima = find_optima(setting, problems)
    for line in out_of_reach(setting, optima):
        print(line)
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
        problems = training_problems(args, setting.grid)
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
        with signals:
            if resumed is None:
                run.write_config(config)
            elif go_on(run, checkpoints, training):
                now = training.now
                print(f"going on from episode {now.episodes + 1}, step {now.steps:,}")
            if n_evaluated < args.evaluation_problems:
                print(
                    f"{n_evaluated:,} of {args.evaluation_problems:,} evaluation problems: there "
                    "are no more unseen ones"
                )
            # Without a terminal there is no bar: say where to look.
            print(f"training, {args.n_episodes} episodes: {run.path(METRICS_FILE)}", flush=True)
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
    from baselines.policies.figures import draw_learning_curves, draw_routes

    draw_learning_curves(folder)
    if unseen is not None:
        evaluations = evaluate_training(args, setting, unseen, trained)
        save_table(folder, evaluations)
        print(f"\n{len(unseen):,} unseen problems:\n\n{format_table(evaluations)}")
        draw_routes(folder, {label: evaluations[label] for label in SAVED if label in evaluations})


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
