"""Teach a network the exact solver's answers: learning combined with mathematical optimisation.

Method: imitation of all optimal joint actions at once. In each state of episodes that the network
itself plays (as in DAgger, Ross et al. 2011) the exact solver says which joint actions are optimal,
and the loss is minus the logarithm of the probability that the network gives to them together.
States that it answers wrongly are asked again until it answers them rightly. This is not
reinforcement learning, and policies made by it are called distilled.

Paper: section 6, last paragraph (arXiv 2110.01460): learning combined with optimisation.

Command::

    python baselines/distill.py --seed 0
    python baselines/distill.py --resume runs/distill-default-seed0-...

Output: a run folder as of meta_dqn.py (no figures), with a row of metrics.csv per 100 updates.
"""

import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines.checkpoints import Checkpoints
from baselines.checks import check_count, check_number
from baselines.evaluation import evaluate, find_optima, format_table, save_table, unseen_problems
from baselines.exact_values import steps_left
from baselines.imagined_replay import ImaginedReplay
from baselines.networks import NetworkSpec, build_network, split_joint, torch_generator
from baselines.optimiser import optimiser_arrays, restore_optimiser
from baselines.policy import NetworkPolicy, save_policy
from baselines.q_learner import part
from baselines.runs import WEIGHTS_FILE, RunFolder, StopSignals, default_folder, read_config
from baselines.settings import N_ACTIONS, Setting, find_grid
from mapp_env import Grid

ALGORITHM = "distill"
METRICS = ("updates", "loss")
MAX_MISTAKES = 4096  # states that are waiting to be asked again; the oldest is forgotten
LOGGED = 100  # updates in a row of metrics.csv
MAX_CELLS = 4096  # of whose distances there is a table


# -- configuration -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Args:
    """Options of a distillation."""

    seed: int = 0
    """seed of everything random"""
    out: Path | None = None
    """the run folder, new or empty; by default runs/distill-default-seedSEED-TIME"""
    resume: Path | None = None
    """a run folder whose training goes on where it stopped, with its own options"""

    grid: str = "paper-7x7"
    """bundled grid, or a map file"""
    n_agents: int = 3
    """number of agents"""
    n_landmarks: int = 5
    """number of landmarks in each problem"""
    max_cycles: int = 50
    """step limit of an episode"""

    hidden_units: int = 384
    """rectifier units in the hidden layer"""
    code_units: int = 64
    """numbers that describe an agent"""
    landmark_units: int = 64
    """numbers that describe a landmark"""

    updates: int = 60_000
    """steps of Adam"""
    batch_size: int = 512
    """states in an update"""
    asked_again: int = 128
    """at most so many states in an update besides, those that were answered wrongly before"""
    learning_rate: float = 0.003
    """step size of Adam; it falls in a straight line to 0"""
    exploration: float = 0.1
    """probability that an episode goes on with a random joint action"""
    from_depot: float = 0.95
    """share of episodes that start at the depot with all landmarks unvisited"""
    max_length: int = 12
    """steps after which an episode is given up"""

    evaluation_problems: int = 1000
    """problems for the table at the end, 0 for none"""
    checkpoint_seconds: float = 30.0
    """seconds between two checkpoints; 0 for one after every update"""
    threads: int = 1
    """threads of PyTorch"""

    def __post_init__(self) -> None:
        check_count("seed", self.seed, 0, 2**63 - 1)
        check_count("n_landmarks", self.n_landmarks, 1, 10)
        check_count("max_cycles", self.max_cycles, 1, 1_000_000)
        check_count("updates", self.updates, 1, 1_000_000_000)
        check_count("batch_size", self.batch_size, 1, 65_536)
        check_count("asked_again", self.asked_again, 0, 65_536)
        check_number("learning_rate", self.learning_rate, 1e-12, 1.0)
        check_number("exploration", self.exploration, 0.0, 1.0)
        check_number("from_depot", self.from_depot, 0.0, 1.0)
        check_count("max_length", self.max_length, 1, 1_000_000)
        check_count("evaluation_problems", self.evaluation_problems, 0, 1_000_000)
        check_number("checkpoint_seconds", self.checkpoint_seconds, 0.0, 1e9)
        check_count("threads", self.threads, 1, 1024)


# -- loss --------------------------------------------------------------------------------------


def optimal_actions_loss(scores: Tensor, steps: np.ndarray) -> Tensor:
    """Return minus the log-probability of acting optimally, its mean over states.

    Parameters
    ----------
    scores
        (B, A ** N) the network's output, read as logits.
    steps
        (B, A ** N) the least steps left after each joint action.
    """
    optimal = torch.from_numpy(steps <= steps.min(axis=1, keepdims=True))
    of_optimal = scores.masked_fill(~optimal, -torch.inf).logsumexp(1)
    return (scores.logsumexp(1) - of_optimal).mean()


# -- learner -----------------------------------------------------------------------------------


class Pupil:
    """The network, its optimiser, and the states it is taught in."""

    def __init__(self, args: Args, grid: Grid) -> None:
        if grid.n_cells > MAX_CELLS:
            raise ValueError(f"grid must have at most {MAX_CELLS:,} cells, got {grid.n_cells:,}")
        self.args = args
        seeds, states = np.random.SeedSequence(args.seed).spawn(2)
        self.spec = NetworkSpec(
            kind="pairs",
            n_agents=args.n_agents,
            n_landmarks=args.n_landmarks,
            n_actions=N_ACTIONS,
            n_cells=grid.n_cells,
            hidden_units=args.hidden_units,
            outputs="joint",
            code_units=args.code_units,
            landmark_units=args.landmark_units,
        )
        self.network = build_network(self.spec, torch_generator(seeds))
        self.optimiser = torch.optim.Adam(self.network.parameters(), fused=True)
        self.rng = np.random.default_rng(states)
        self.states = ImaginedReplay(
            *(self.spec, grid.depot, args.batch_size, 1, 1.0, 0.0),
            *(args.from_depot, args.max_length),
        )
        # Here the grid may be read: the solver knows it as well.
        reached = np.append(grid.reachable, grid.depot)
        self.states.moves[reached] = np.asarray(grid.moves)[reached, :N_ACTIONS]
        self.distances = np.asarray(grid.distances, np.int64)
        self.mistakes = np.zeros((0, self.spec.observation_size), np.float32)  # the oldest first
        self.updates = 0
        self.losses: list[float] = []  # since the last row of metrics.csv

    def update(self) -> float:
        """Learn from one batch of states, go on to the next; return the loss."""
        args, states, n = self.args, self.states, self.spec.n_agents
        states.start_over(self.rng)
        again = self.mistakes[: args.asked_again]
        seen = np.concatenate((states.observations(), again))
        whole = seen.astype(np.int64)
        cells, landmarks, flags = np.split(whole, (n, n + self.spec.n_landmarks), axis=1)
        steps = steps_left(cells, landmarks, flags > 0, states.moves, self.distances)
        scores = self.network(torch.from_numpy(seen))
        loss = optimal_actions_loss(scores, steps)
        rate = args.learning_rate * (1 - self.updates / args.updates)
        for group in self.optimiser.param_groups:
            group["lr"] = rate * min(1.0, (self.updates + 1) / 200)
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        joint = scores.argmax(1).numpy()
        wrong = steps[np.arange(len(seen)), joint] > steps.min(axis=1)
        left = np.concatenate((self.mistakes[len(again) :], seen[wrong]))
        self.mistakes = left[-MAX_MISTAKES:] if args.asked_again else left[:0]
        n_rows, n_joint = len(states.cells), scores.shape[1]
        explores = self.rng.random(n_rows) < args.exploration
        joint = np.where(explores, self.rng.integers(n_joint, size=n_rows), joint[:n_rows])
        states.follow(split_joint(joint, n, self.spec.n_actions))
        self.updates += 1
        return loss.item()

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that change, by name."""
        parts = {
            "network": {name: t.numpy() for name, t in self.network.state_dict().items()},
            "optimiser": optimiser_arrays(self.optimiser),
            "states": self.states.arrays_by_name(),
            "mistakes": {"seen": self.mistakes},
        }
        return {
            f"{part}.{key}": value for part, named in parts.items() for key, value in named.items()
        }

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Take over what was saved."""
        weights = part(arrays, "network")
        self.network.load_state_dict({k: torch.from_numpy(v) for k, v in weights.items()})
        restore_optimiser(self.optimiser, part(arrays, "optimiser"))
        self.states.restore(part(arrays, "states"))
        self.mistakes = arrays["mistakes.seen"].copy()
        self.updates = state["updates"]
        self.rng.bit_generator.state = state["rng"]
        self.losses = list(state["losses"])


# -- the run -----------------------------------------------------------------------------------


def train(pupil: Pupil, run: RunFolder, checkpoints: Checkpoints, signals: StopSignals) -> None:
    """Teach until all updates are done, or a signal comes; then leave a checkpoint."""
    args = pupil.args

    def save() -> None:
        state = {
            "updates": pupil.updates,
            "rng": pupil.rng.bit_generator.state,
            "losses": pupil.losses,
            "metrics": run.position(),
        }
        checkpoints.save(pupil.updates, pupil.arrays(), state)

    bar = tqdm(total=args.updates, initial=pupil.updates, unit=" updates", disable=None)
    saved = time.monotonic()
    while pupil.updates < args.updates and signals.received is None:
        pupil.losses.append(pupil.update())
        bar.update()
        if pupil.updates % LOGGED == 0:
            run.log({"updates": pupil.updates, "loss": sum(pupil.losses) / LOGGED})
            pupil.losses.clear()
        if time.monotonic() - saved >= args.checkpoint_seconds:
            save()
            saved = time.monotonic()
    bar.close()
    save()
    save_policy(run.path(WEIGHTS_FILE), pupil.network)


def main(args: Args) -> int:
    """Teach and evaluate; return the exit code."""
    resumed = args.resume
    if resumed is not None:
        if args != Args(resume=resumed):
            raise ValueError("resume goes on with the run's own options: leave out all others")
        config = read_config(resumed)
        options = config.get("options")
        if config.get("algorithm") != ALGORITHM or not isinstance(options, dict):
            raise ValueError(f"{resumed}: not a run of {ALGORITHM}")
        try:
            args = Args(**{**options, "out": None, "resume": None})
        except TypeError as error:
            raise ValueError(f"{resumed}: {error}") from error
    torch.set_num_threads(args.threads)
    grid = find_grid(args.grid) if resumed is None else Grid.from_text(config["grid"])
    setting = Setting(grid, args.n_agents, args.n_landmarks, args.max_cycles)
    pupil = Pupil(args, grid)
    folder = resumed or args.out or default_folder(ALGORITHM, "default", args.seed)
    identity = {
        "algorithm": ALGORITHM,
        "options": {**asdict(args), "out": None, "resume": None},
        "grid": grid.to_text(),
        "training_problems": [],
    }
    run = RunFolder(folder, METRICS, resume=resumed is not None)
    signals = StopSignals()
    try:
        checkpoints = Checkpoints(folder, identity)
        if resumed is None:
            run.write_config(identity)
        else:
            go_on(pupil, run, checkpoints)
        with signals:
            train(pupil, run, checkpoints, signals)
        if signals.received is not None:
            print(f"stopped early; go on with --resume {folder}", flush=True)
            return 128 + signals.received
        if args.evaluation_problems:
            problems = unseen_problems(setting, args.evaluation_problems)
            optima = find_optima(setting, problems)
            policy = NetworkPolicy(pupil.network)
            table = {"network alone": evaluate(policy, setting, problems, optima)}
            save_table(folder, table)
            print(format_table(table))
    except OSError as error:
        raise ValueError(f"{folder}: cannot be written: {error}") from error
    finally:
        run.close()
    print(f"\nrun folder: {folder}")
    return 0


def go_on(pupil: Pupil, run: RunFolder, checkpoints: Checkpoints) -> None:
    """Bring a training to its newest whole checkpoint, or to its start if there is none."""
    checkpoint, problems = checkpoints.latest()
    for problem in problems:
        print(f"not used: {problem}")
    if checkpoint is None:
        run.restart()
        return
    run.rewind(checkpoint.state["metrics"])
    pupil.restore(checkpoint.arrays, checkpoint.state)
    print(f"going on from update {pupil.updates + 1:,}")


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args, description=__doc__)))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error
