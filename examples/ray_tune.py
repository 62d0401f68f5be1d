"""Search the default preset's main settings with Ray Tune, stopping weak trials early.

    pip install -c constraints.txt -e ".[baselines,ray]"
    python examples/ray_tune.py --trials 8 --states 4096
    python examples/ray_tune.py --address auto --out /shared/tune --trials 200

A trial is the default preset of baselines/meta_dqn.py with six settings changed; the first trial
has the preset's own. After each of its 20 training problems it reports how well it acts, greedily,
on problems held out for tuning. The ASHA scheduler compares trials at problems 5, 10 and 20, and
stops the worse half. All trials learn from the same number of states per episode, so that more
updates mean smaller batches, and longer training is not mistaken for a better setting.

The best trial and the first are then evaluated on other problems, those of a run's own final table,
which played no part in the selection.

Output: a table of the trials, and the command that trains with the best settings; everything else
is in OUT, which on a cluster must be a folder that all machines see under the same path, as must
this checkout. A trial whose worker is lost starts again from its first episode.
"""

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("TUNE_DISABLE_AUTO_CALLBACK_LOGGERS", "1")
os.environ.setdefault("TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S", "0")

import numpy as np
import ray
import torch
import tyro
from ray import tune
from ray.tune.schedulers import ASHAScheduler
from ray.tune.search.basic_variant import BasicVariantGenerator
from ray_seeds import start_ray

from baselines.learning.config import preset_options
from baselines.learning.training import Streams, Training, training_problems
from baselines.meta_dqn import Args as Options
from baselines.meta_dqn import MetaLearner
from baselines.policies.evaluation import Evaluation, evaluate, find_optima, unseen_problems
from baselines.policies.policy import load_policy, save_policy
from baselines.policies.settings import Setting
from baselines.runs.folder import WEIGHTS_FILE
from mapp_env.grids import find_grid
from mapp_env.validation import check_count

METRIC = "excess %"
TUNING_SEED = 1  # of the held-out problems
BATCHES = (256, 512, 1024)
MAX_RETRIES = 2
GRACE = 5  # problems before a trial may be stopped


@dataclass
class Args:
    """Options of a search."""

    out: Path = Path("runs/tune")
    """folder for Ray Tune's files"""
    trials: int = 8
    """number of settings to try; the first are the preset's own"""
    states: int = 16_384
    """states learned from after each episode: updates times batch size; the preset's are 16,384"""
    problems: int = 500
    """problems held out for tuning"""
    jobs: int = 2
    """trials at a time, also on a cluster"""
    seed: int = 0
    """seed of the settings tried, and of every run"""
    address: str | None = None
    """Ray cluster to use ("auto": the one this machine belongs to); by default Ray starts here"""

    def __post_init__(self) -> None:
        check_count("trials", self.trials, 1, 100_000)
        check_count("states", self.states, max(BATCHES), 10_000_000)
        check_count("problems", self.problems, 1, 100_000)
        check_count("jobs", self.jobs, 1, 1024)


# -- search space ------------------------------------------------------------------------------


def search_space(states: int) -> dict[str, Any]:
    """Return the search space."""
    return {
        "learning_rate": tune.loguniform(0.002, 0.02),
        "hidden_units": tune.choice([128, 256, 384]),
        "final_discount": tune.uniform(0.93, 0.99),
        "target_rate": tune.loguniform(0.01, 0.1),
        "action_gap": tune.uniform(0.0, 0.8),
        "updates_per_episode": tune.choice([states // batch for batch in BATCHES]),
    }


def make_options(config: dict[str, Any], states: int, seed: int) -> Options:
    """Return the preset's options with a trial's settings."""
    batch_size = states // config["updates_per_episode"]
    return preset_options(
        Options, "default", seed=seed, prefetch=False, batch_size=batch_size, **config
    )


def preset_point(space: dict[str, Any], states: int) -> dict[str, Any]:
    """Return the preset's own settings."""
    preset = Options()
    own = {name: getattr(preset, name) for name in space}
    return {**own, "updates_per_episode": states // preset.batch_size}


# -- a trial -----------------------------------------------------------------------------------


def held_out(setting: Setting, n_problems: int, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return problems for tuning and for the final table: disjoint, and none trained on."""
    final = unseen_problems(setting, 1000, seen.tolist())
    tuning = unseen_problems(setting, n_problems, [*seen.tolist(), *final.tolist()], TUNING_SEED)
    return tuning, final


def excess(evaluation: Evaluation) -> float:
    """Return the mean excess over the optimum in percent, counting unsolved as the step limit.

    Unlike the gap, it does not shrink when hard problems are left unsolved.
    """
    assert evaluation.optima is not None
    return 100.0 * float((evaluation.steps / evaluation.optima.cover_time - 1.0).mean())


def run_trial(config: dict[str, Any], states: int, n_problems: int, seed: int) -> None:
    """Train, and report after every problem."""
    torch.set_num_threads(1)
    args = make_options(config, states, seed)
    grid = find_grid(args.grid)
    setting = Setting(grid, args.n_agents, args.n_landmarks, args.max_cycles)
    problems = training_problems(args, grid)
    tuning, _ = held_out(setting, n_problems, problems)
    optima = find_optima(setting, tuning)
    learner = MetaLearner(args, grid, Streams.spawn(args.seed))
    training = Training(args, grid, problems, learner)
    while not training.finished:
        if training.advance() is None or training.now.episodes % args.episodes_per_problem:
            continue
        found = evaluate(learner.policy(), setting, tuning, optima)
        metrics = {
            METRIC: excess(found),
            "solved %": 100.0 * float(found.success.mean()),
            "problems": training.now.episodes // args.episodes_per_problem,
            "CPU seconds": time.process_time(),
        }
        with tempfile.TemporaryDirectory() as folder:
            save_policy(Path(folder) / WEIGHTS_FILE, learner.policy().network, grid)
            tune.report(metrics, checkpoint=tune.Checkpoint.from_directory(folder))


# -- the search --------------------------------------------------------------------------------


def search(args: Args) -> "tune.ResultGrid":
    """Run all trials."""
    space = search_space(args.states)
    fixed = {"states": args.states, "n_problems": args.problems, "seed": args.seed}
    trial = tune.with_resources(tune.with_parameters(run_trial, **fixed), {"cpu": 1})
    return tune.Tuner(
        trial,
        param_space=space,
        tune_config=tune.TuneConfig(
            metric=METRIC,
            mode="min",
            num_samples=args.trials,
            max_concurrent_trials=args.jobs,
            search_alg=BasicVariantGenerator(
                points_to_evaluate=[preset_point(space, args.states)], random_state=args.seed
            ),
            scheduler=ASHAScheduler(
                time_attr="problems",
                max_t=Options().n_problems,
                grace_period=GRACE,
                reduction_factor=2,
            ),
        ),
        run_config=tune.RunConfig(
            name=f"{time.strftime('%Y%m%d-%H%M%S')}",
            storage_path=str(args.out.resolve()),
            checkpoint_config=tune.CheckpointConfig(num_to_keep=1),
            failure_config=tune.FailureConfig(max_failures=MAX_RETRIES),
            verbose=0,
        ),
    ).fit()


def print_trials(results: "tune.ResultGrid") -> None:
    """Print a Markdown table with one row per trial, the best first.

    Raises
    ------
    ValueError
        If all trials have failed.
    """
    ended = [result for result in results if result.error is None]
    for error in results.errors:
        print(f"failed: {error}")
    if not ended:
        raise ValueError("all trials have failed")
    ended.sort(key=lambda result: result.metrics[METRIC])
    names = list(ended[0].config)
    figures = [METRIC, "solved %", "problems", "CPU seconds"]
    print("| " + " | ".join([*names, *figures]) + " |")
    print("|" + "---:|" * (len(names) + len(figures)))
    for result in ended:
        cells = [f"{result.config[name]:.3g}" for name in names]
        cells += [f"{result.metrics[name]:.1f}" for name in figures[:2]]
        cells += [f"{result.metrics[name]:.0f}" for name in figures[2:]]
        print("| " + " | ".join(cells) + " |")


def final_figures(args: Args, result: "tune.Result") -> str:
    """Evaluate a trial's network on the final problems; return the figures."""
    options = make_options(result.config, args.states, args.seed)
    grid = find_grid(options.grid)
    setting = Setting(grid, options.n_agents, options.n_landmarks, options.max_cycles)
    _, final = held_out(setting, args.problems, training_problems(options, grid))
    with result.checkpoint.as_directory() as folder:
        policy = load_policy(Path(folder) / WEIGHTS_FILE)
    found = evaluate(policy, setting, final, find_optima(setting, final)).summary()
    return ", ".join(f"{name} {found[name]:.2f}" for name in ("solved %", "gap %", "optimal %"))


def main(args: Args) -> None:
    """Search, and print the results."""
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    start_ray(args.address, args.jobs, MAX_RETRIES)
    started = time.monotonic()
    try:
        results = search(args)
    finally:
        ray.shutdown()
    print_trials(results)
    best = results.get_best_result()
    first = next(
        result
        for result in results
        if result.config == preset_point(search_space(args.states), args.states)
    )
    print(f"\n{len(results)} trials in {time.monotonic() - started:.0f} s")
    print(f"best, 1,000 other problems: {final_figures(args, best)}")
    if first.error is None:
        print(
            f"the preset's own settings: {final_figures(args, first)}, "
            f"{first.metrics['problems']} training problems"
        )
    words = [f"--{name.replace('_', '-')} {value}" for name, value in best.config.items()]
    batch_size = args.states // best.config["updates_per_episode"]
    print(
        f"python baselines/meta_dqn.py --seed {args.seed} {' '.join(words)} "
        f"--batch-size {batch_size}"
    )


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error
