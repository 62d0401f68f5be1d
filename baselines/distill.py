"""Train a network on the exact solver's answers: learning combined with mathematical optimisation.

Method: imitation of all optimal joint actions at once. In each state of episodes that the network
itself plays (as in DAgger, Ross et al. 2011) the exact solver says which joint actions are optimal,
and the loss is minus the logarithm of the probability that the network gives to them together.
States in which its greedy action is not optimal come again until it is. This is not reinforcement
learning, and policies made by it are called distilled.

Paper: section 6, last paragraph (arXiv 2110.01460): learning combined with optimisation.

Command::

    python baselines/distill.py --seed 0
    python baselines/distill.py --resume runs/distill-default-seed0-...

Output: a run folder as of meta_dqn.py (no figures), with a row of metrics.csv per 100 updates.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from baselines.learning.config import Units, UnitsOrNone, own_options, run_script
from baselines.learning.imitation import Imitation, ImitationOptions, good_actions_loss, start_of
from baselines.learning.ranges import Share, Within
from baselines.learning.train import run_training
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
from mapp_env.grid import MAX_ALL_PAIRS_CELLS
from mapp_env.grids import find_grid
from mapp_env.solvers.oracle.decisions import action_costs
from mapp_env.validation import check_count

ALGORITHM = "distill"
MAX_MISTAKES = 4096  # states that wait to come again; the oldest is forgotten


# -- configuration -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(ImitationOptions):
    """Options of a distillation."""

    grid: str = "paper-7x7"
    """bundled grid, or a map file"""
    n_agents: Annotated[int, Within(1, 16)] = 3
    """number of agents"""
    n_landmarks: Annotated[int, Within(1, 10)] = 5
    """number of landmarks in each problem"""
    max_cycles: Annotated[int, Within(1, 1_000_000)] = 50
    """step limit of an episode"""

    hidden_units: Units = 512
    """rectifier units in the hidden layer"""
    code_units: Units = 64
    """numbers that describe an agent"""
    landmark_units: UnitsOrNone = 48
    """numbers that describe a landmark"""
    route_units: UnitsOrNone = 16
    """numbers that describe an agent among pairs of landmarks"""

    policy: str | None = None
    """a distilled policy to go on from, with the same network: a run folder, or a name"""
    batch_size: Annotated[int, Within(1, 65_536)] = 512
    """states in an update"""
    asked_again: Annotated[int, Within(0, 65_536)] = 128
    """at most so many states in an update besides, those with a wrong answer before"""
    exploration: Share = 0.1
    """probability that an episode goes on with a random joint action"""
    from_depot: Share = 0.95
    """share of episodes that start at the depot with all landmarks unvisited"""
    max_length: Annotated[int, Within(1, 1_000_000)] = 12
    """step limit of an episode"""


# -- learner -----------------------------------------------------------------------------------


class Distilled(Imitation):
    """A network that learns in the states it comes to itself."""

    args: Args

    def __init__(self, args: Args, grid: Grid, start: Network | None = None) -> None:
        most = MAX_ALL_PAIRS_CELLS
        if grid.n_cells > most:
            raise ValueError(f"grid must have at most {most:,} cells, got {grid.n_cells:,}")
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
        # Here the grid may be read, as the solver reads it, too.
        reached = np.append(grid.reachable, grid.depot)
        self.states.moves[reached] = np.asarray(grid.moves)[reached, :N_ACTIONS]
        self.grid = grid
        self.mistakes = np.zeros((0, spec.observation_size), np.float32)  # the oldest first

    def batch_loss(self) -> Tensor:
        """Return the loss on the states of a batch, and go on to the next ones."""
        args, states, n = self.args, self.states, self.spec.n_agents
        states.start_over(self.rng)
        again = self.mistakes[: args.asked_again]
        obs = np.concatenate((states.observations(), again))
        whole = obs.astype(np.int64)
        cells, landmarks, flags = np.split(whole, (n, n + self.spec.n_landmarks), axis=1)
        steps = action_costs(self.grid, landmarks, flags == 0, cells, states.moves)
        scores = self.network(torch.from_numpy(obs))
        joint = scores.argmax(1).numpy()
        wrong = steps[np.arange(len(obs)), joint] > steps.min(axis=1)
        left = np.concatenate((self.mistakes[len(again) :], obs[wrong]))
        self.mistakes = left[-MAX_MISTAKES:] if args.asked_again else left[:0]
        n_rows, n_joint = len(states.cells), scores.shape[1]
        explores = self.rng.random(n_rows) < args.exploration
        joint = np.where(explores, self.rng.integers(n_joint, size=n_rows), joint[:n_rows])
        states.follow(split_joint(joint, n, self.spec.n_actions))
        optimal = torch.from_numpy(steps <= steps.min(axis=1, keepdims=True))
        return good_actions_loss(scores, optimal)

    def own_arrays(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the states, and those that come again."""
        return {"states": self.states.arrays_by_name(), "mistakes": {"obs": self.mistakes}}

    def restore_own(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`own_arrays` returned."""
        self.states.restore(part(arrays, "states"))
        self.mistakes = arrays["mistakes.obs"].copy()


def main(args: Args) -> int:
    """Train and evaluate; return the exit code.

    Raises a ValueError if an option, the policy or the folder cannot be used.
    """
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
    return run_training(args, ALGORITHM, setting, [], lambda: Distilled(args, grid, start))


if __name__ == "__main__":
    run_script(main, Args, __doc__)
