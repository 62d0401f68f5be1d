"""Teach a trained policy the problems that it does not solve, and leave all else as it is.

Method: all problems (or very many) are played greedily. On each that is not solved in time,
hundreds of episodes are drawn from the policy, and the shortest that solves it is taught from then
on: its actions in its states. A frozen copy of the policy is the anchor: in the states of fresh
episodes on random problems the network is held to the copy's probabilities (Kullback-Leibler), in
the spirit of learning without forgetting (Li and Hoiem 2016). Every so many updates all problems
are played again, as mending one may break another. This is reinforcement learning by trial alone:
all that is known of a problem is which of one's own episodes solved it.

Command::

    python baselines/repair.py --policy runs/self_improve-default-seed0-...
    python baselines/repair.py --resume runs/repair-default-seed0-...

Output: a run folder as of meta_dqn.py (no figures), with a row of metrics.csv per 100 updates.
"""

import copy
import sys
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from baselines.learning.imitation import (
    ImitationOptions,
    Pupil,
    own_options,
    parse_arguments,
    run_imitation,
    start_of,
    starting_point,
)
from baselines.networks import Network
from baselines.policies.episodes import draw_problems, make_envs, play
from baselines.policies.evaluation import count_problems, evaluate, every_problem
from baselines.policies.policy import NetworkPolicy
from baselines.policies.settings import Setting
from baselines.runs.checkpoints import part
from mapp_env.validation import check_count, check_number

ALGORITHM = "repair"


# -- configuration -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(ImitationOptions):
    """Options of a repair."""

    policy: str | None = None
    """a meta-agent with joint values to mend: a run folder, or a pretrained policy's name"""
    updates: int = 8_000
    """steps of Adam"""
    learning_rate: float = 0.0001
    """step size of Adam; it falls in a straight line to 0"""
    weight_decay: float = 0.0
    """share of every weight, times the step size, that each update takes off it"""
    half_precision: bool = False
    """keep the finished policy's weights in 16 bits: rounding may undo some of what was mended"""
    surveyed: int = 1_000_000
    """problems that are played to find the unsolved ones: all, if there are no more than that"""
    updates_per_survey: int = 500
    """updates from one to the next"""
    attempts: int = 512
    """episodes that are drawn on a problem to find one that solves it"""
    max_length: int = 16
    """steps after which such an episode is given up"""
    sharpness: float = 0.5
    """what the network's output is multiplied by when actions are drawn: less is bolder"""
    problems: int = 1024
    """random problems that are played at a time for the anchor's states"""
    updates_per_round: int = 16
    """updates on their states"""
    batch_size: int = 512
    """states in an update that are held to the anchor"""
    taught_batch: int = 128
    """states in an update besides, of episodes that solved what was not solved"""
    anchor: float = 10.0
    """weight of the anchor's part of the loss"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("surveyed", self.surveyed, 1, 10_000_000)
        check_count("updates_per_survey", self.updates_per_survey, 1, 1_000_000_000)
        check_count("attempts", self.attempts, 1, 65_536)
        check_count("max_length", self.max_length, 1, 1_000_000)
        check_number("sharpness", self.sharpness, 1e-6, 1e6)
        check_count("problems", self.problems, 1, 65_536)
        check_count("updates_per_round", self.updates_per_round, 1, 65_536)
        check_count("batch_size", self.batch_size, 1, 65_536)
        check_count("taught_batch", self.taught_batch, 1, 65_536)
        check_number("anchor", self.anchor, 0.0, 1e6)


# -- learner -----------------------------------------------------------------------------------


class Repaired(Pupil):
    """A network that is taught what it does not solve, and held to a copy of itself elsewhere."""

    args: Args

    def __init__(self, args: Args, setting: Setting, network: Network) -> None:
        if network.spec.outputs != "joint":
            raise ValueError("policy must be a meta-agent's with joint values (--outputs joint)")
        super().__init__(args, network, np.random.default_rng(args.seed))
        self.setting = setting
        self.cells = setting.grid.reachable
        self.model = copy.deepcopy(network)  # the anchor: it stays as it is
        self.envs = make_envs(setting, args.problems, args.max_length)
        self.trials = make_envs(setting, args.attempts, args.max_length)
        self.seen = np.zeros((0, self.spec.observation_size), np.float32)  # of fresh episodes
        self.taught_seen = self.seen  # of episodes that solved what was not solved
        self.taught_joint = np.zeros(0, np.int64)  # what they did there
        self.unsolved = -1  # problems at the last survey
        self.left = 0  # updates until fresh episodes

    def lesson(self) -> Tensor:
        """Return the loss on a batch of each kind; survey and play when it is time."""
        args = self.args
        if self.updates % args.updates_per_survey == 0:
            self.survey()
        if self.left == 0:
            self.play()
        self.left -= 1
        seen = self.seen[self.rng.integers(len(self.seen), size=args.batch_size)]
        with torch.no_grad():
            wanted = self.model(torch.from_numpy(seen)).log_softmax(1)
        given = self.network(torch.from_numpy(seen)).log_softmax(1)
        loss = args.anchor * nn.functional.kl_div(
            given, wanted, reduction="batchmean", log_target=True
        )
        if len(self.taught_seen):
            rows = self.rng.integers(len(self.taught_seen), size=args.taught_batch)
            scores = self.network(torch.from_numpy(self.taught_seen[rows]))
            taught = torch.from_numpy(self.taught_joint[rows])
            loss = loss + nn.functional.cross_entropy(scores, taught)
        return loss

    def survey(self) -> None:
        """Play all problems, and try those that are not solved until an episode solves them."""
        args, setting = self.args, self.setting
        if count_problems(setting) <= args.surveyed:
            problems = every_problem(setting)
        else:
            problems = draw_problems(self.cells, setting.n_landmarks, args.surveyed, self.rng)
        played = evaluate(NetworkPolicy(self.as_kept()), setting, problems)
        unsolved = problems[~played.success]
        self.unsolved = len(unsolved)
        for landmarks in unsolved:
            self.attempt(landmarks)
        print(
            f"update {self.updates:,}: {len(unsolved):,} of {len(problems):,} problems unsolved, "
            f"{len(self.taught_seen):,} states taught",
            flush=True,
        )

    def as_kept(self) -> Network:
        """Return the network with its weights as they would be kept."""
        kept = copy.deepcopy(self.network)
        return kept.half().float() if self.args.half_precision else kept

    def attempt(self, landmarks: np.ndarray) -> None:
        """Draw episodes on a problem, and teach the shortest if it is solved."""
        args = self.args
        observations, joint, lengths = play(
            self.trials,
            self.network,
            np.repeat(landmarks[None], args.attempts, axis=0).astype(np.int64),
            args.max_length,
            args.sharpness,
            np.zeros(args.attempts, np.bool_),
            self.rng,
        )
        best = lengths.argmin()
        if lengths[best] <= args.max_length:
            taken = slice(0, lengths[best])
            self.taught_seen = np.concatenate((self.taught_seen, observations[taken, best]))
            self.taught_joint = np.concatenate((self.taught_joint, joint[taken, best]))

    def play(self) -> None:
        """Play fresh random problems greedily: their states are held to the anchor."""
        args = self.args
        observations, _, lengths = play(
            self.envs,
            self.network,
            draw_problems(self.cells, self.spec.n_landmarks, args.problems, self.rng),
            args.max_length,
            1.0,
            np.ones(args.problems, np.bool_),
            self.rng,
        )
        self.seen = observations[np.arange(len(observations))[:, None] < lengths]
        self.left = args.updates_per_round

    # -- checkpoints

    def own_arrays(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the anchor, the states and what is taught."""
        return {
            "model": {name: t.numpy() for name, t in self.model.state_dict().items()},
            "round": {"seen": self.seen, "left": np.array(self.left)},
            "taught": {
                "seen": self.taught_seen,
                "joint": self.taught_joint,
                "unsolved": np.array(self.unsolved),
            },
        }

    def restore_own(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`own_arrays` returned."""
        weights = part(arrays, "model")
        self.model.load_state_dict({k: torch.from_numpy(v) for k, v in weights.items()})
        self.seen, self.left = arrays["round.seen"].copy(), int(arrays["round.left"])
        self.taught_seen = arrays["taught.seen"].copy()
        self.taught_joint = arrays["taught.joint"].copy()
        self.unsolved = int(arrays["taught.unsolved"])


def main(args: Args) -> int:
    """Mend and evaluate; return the exit code."""
    args = own_options(args, ALGORITHM)
    start = start_of(args.resume, args.policy)
    policy, setting, seen = starting_point(start)
    return run_imitation(
        args, ALGORITHM, setting, lambda: Repaired(args, setting, policy.network), seen
    )


if __name__ == "__main__":
    try:
        sys.exit(main(parse_arguments(Args, __doc__ or "")))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error
