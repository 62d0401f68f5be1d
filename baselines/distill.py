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
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from baselines.learning.exact_values import steps_left
from baselines.learning.imitation import (
    ImitationOptions,
    Pupil,
    good_actions_loss,
    own_options,
    parse_arguments,
    run_imitation,
    start_of,
)
from baselines.networks import (
    Network,
    build_network,
    spec_from_options,
    split_joint,
    torch_generator,
)
from baselines.policies.acting import check_grid
from baselines.policies.policy import load_policy
from baselines.policies.settings import N_ACTIONS, Setting, read_setting
from baselines.replay.imagined import ImaginedReplay
from baselines.runs.checkpoints import part
from mapp_env import Grid
from mapp_env.grids import find_grid
from mapp_env.validation import check_count, check_number

ALGORITHM = "distill"
MAX_MISTAKES = 4096  # states that are waiting to be asked again; the oldest is forgotten
MAX_CELLS = 4096  # of whose distances there is a table


# -- configuration -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(ImitationOptions):
    """Options of a distillation."""

    grid: str = "paper-7x7"
    """bundled grid, or a map file"""
    n_agents: int = 3
    """number of agents"""
    n_landmarks: int = 5
    """number of landmarks in each problem"""
    max_cycles: int = 50
    """step limit of an episode"""

    hidden_units: int = 512
    """rectifier units in the hidden layer"""
    code_units: int = 64
    """numbers that describe an agent"""
    landmark_units: int = 48
    """numbers that describe a landmark"""
    route_units: int = 16
    """numbers that describe an agent among pairs of landmarks"""

    policy: str | None = None
    """a distilled policy to go on from, with the same network: a run folder, or a name"""
    batch_size: int = 512
    """states in an update"""
    asked_again: int = 128
    """at most so many states in an update besides, those that were answered wrongly before"""
    exploration: float = 0.1
    """probability that an episode goes on with a random joint action"""
    from_depot: float = 0.95
    """share of episodes that start at the depot with all landmarks unvisited"""
    max_length: int = 12
    """steps after which an episode is given up"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("n_landmarks", self.n_landmarks, 1, 10)
        check_count("max_cycles", self.max_cycles, 1, 1_000_000)
        check_count("batch_size", self.batch_size, 1, 65_536)
        check_count("asked_again", self.asked_again, 0, 65_536)
        check_number("exploration", self.exploration, 0.0, 1.0)
        check_number("from_depot", self.from_depot, 0.0, 1.0)
        check_count("max_length", self.max_length, 1, 1_000_000)


# -- learner -----------------------------------------------------------------------------------


class Distilled(Pupil):
    """A network that is taught in the states it comes to itself."""

    args: Args

    def __init__(self, args: Args, grid: Grid, start: Network | None = None) -> None:
        if grid.n_cells > MAX_CELLS:
            raise ValueError(f"grid must have at most {MAX_CELLS:,} cells, got {grid.n_cells:,}")
        check_count("n_landmarks", args.n_landmarks, 1, grid.reachable.size)
        seeds, states = np.random.SeedSequence(args.seed).spawn(2)
        spec = spec_from_options(args, "pairs", grid, outputs="joint")
        network = start or build_network(spec, torch_generator(seeds))
        if network.spec != spec:
            raise ValueError(f"policy must have the network {spec}, got {network.spec}")
        super().__init__(args, network, np.random.default_rng(states))
        self.states = ImaginedReplay(
            *(spec, grid),
            n_rows=args.batch_size,
            from_depot=args.from_depot,
            max_length=args.max_length,
        )
        # Here the grid may be read: the solver knows it as well.
        reached = np.append(grid.reachable, grid.depot)
        self.states.moves[reached] = np.asarray(grid.moves)[reached, :N_ACTIONS]
        self.distances = np.asarray(grid.distances, np.int64)
        self.mistakes = np.zeros((0, spec.observation_size), np.float32)  # the oldest first

    def lesson(self) -> Tensor:
        """Return the loss on the states of a batch, and go on to the next ones."""
        args, states, n = self.args, self.states, self.spec.n_agents
        states.start_over(self.rng)
        again = self.mistakes[: args.asked_again]
        seen = np.concatenate((states.observations(), again))
        whole = seen.astype(np.int64)
        cells, landmarks, flags = np.split(whole, (n, n + self.spec.n_landmarks), axis=1)
        steps = steps_left(cells, landmarks, flags > 0, states.moves, self.distances)
        scores = self.network(torch.from_numpy(seen))
        joint = scores.argmax(1).numpy()
        wrong = steps[np.arange(len(seen)), joint] > steps.min(axis=1)
        left = np.concatenate((self.mistakes[len(again) :], seen[wrong]))
        self.mistakes = left[-MAX_MISTAKES:] if args.asked_again else left[:0]
        n_rows, n_joint = len(states.cells), scores.shape[1]
        explores = self.rng.random(n_rows) < args.exploration
        joint = np.where(explores, self.rng.integers(n_joint, size=n_rows), joint[:n_rows])
        states.follow(split_joint(joint, n, self.spec.n_actions))
        optimal = torch.from_numpy(steps <= steps.min(axis=1, keepdims=True))
        return good_actions_loss(scores, optimal)

    def own_arrays(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the states, and those that are asked again."""
        return {"states": self.states.arrays_by_name(), "mistakes": {"seen": self.mistakes}}

    def restore_own(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`own_arrays` returned."""
        self.states.restore(part(arrays, "states"))
        self.mistakes = arrays["mistakes.seen"].copy()


def main(args: Args) -> int:
    """Teach and evaluate; return the exit code."""
    args = own_options(args, ALGORITHM)
    if args.resume is None:
        setting = Setting(find_grid(args.grid), args.n_agents, args.n_landmarks, args.max_cycles)
    else:
        setting, _ = read_setting(args.resume)
    policy = args.policy and start_of(args.resume, args.policy)
    grid, start = setting.grid, None
    if policy:
        loaded = load_policy(policy)
        check_grid(loaded, grid)
        start = loaded.network
    return run_imitation(args, ALGORITHM, setting, lambda: Distilled(args, grid, start), [])


if __name__ == "__main__":
    try:
        sys.exit(main(parse_arguments(Args, __doc__ or "")))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error
