"""Improve a trained policy by imitating the best of several of its own episodes.

Method: self-imitation. Of each random problem several episodes are played at once in the batched
environment: one greedily, the others with actions drawn from the policy, just so boldly that they
become a few per cent longer. Where one is shorter than the greedy one, it is played again from each
of its states with other likely actions, to see which of them are as good; those states, with all
good actions, are kept and taught for a while, and the problem comes again until the greedy episode
is as short. Besides, the network is taught to go on as it does where nothing shorter was found.
This is reinforcement learning by trial alone: all that is known of a problem is how long one's own
episodes on it took, never the optimum, and walls are met by bumping into them. In the spirit of
self-imitation learning (Oh et al. 2018) and of rollout-based policy iteration by classification
(Lagoudakis and Parr 2003). As many problems are played as updates allow: on a small grid, in the
end, nearly all there are.

It starts from a policy of ``meta_dqn.py``: the larger its values, the likelier its actions.

Command::

    python baselines/self_improve.py --policy runs/meta_dqn-default-seed0-...
    python baselines/self_improve.py --resume runs/self_improve-default-seed0-...

Output: a run folder as of meta_dqn.py (no figures), with a row of metrics.csv per 100 updates.
"""

import sys
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from baselines.learning.imitation import (
    ImitationOptions,
    Pupil,
    good_actions_loss,
    own_options,
    parse_arguments,
    run_imitation,
    start_of,
    starting_point,
)
from baselines.networks import Network, NetworkSpec, split_joint
from baselines.policies.episodes import Episodes, begin, draw_problems, make_envs, play
from baselines.policies.settings import Setting
from mapp_env.validation import check_count, check_number

ALGORITHM = "self_improve"
MAX_AGAIN = 4096  # problems that wait to be played again; the oldest is forgotten
SHARPER = 1.02  # factor from round to round


# -- configuration -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(ImitationOptions):
    """Options of a self-improvement."""

    policy: str | None = None
    """a meta-agent with joint values to start from: a run folder, or a pretrained policy's name"""
    learning_rate: float = 0.001
    """step size of Adam; it falls in a straight line to 0"""
    weight_decay: float = 0.0
    """share of every weight, times the step size, that each update takes off it"""
    problems: int = 512
    """random problems that are played at a time"""
    played_again: int = 128
    """at most so many of them are problems on which the greedy episode was not the shortest"""
    episodes: int = 8
    """episodes of each, the first of them greedy"""
    updates_per_round: int = 16
    """updates after each time"""
    batch_size: int = 256
    """states in an update, of the episodes just played"""
    kept_batch: int = 256
    """states in an update besides, of episodes that were shorter than the greedy one"""
    alternatives: int = 12
    """likely joint actions that are tried in each state of a shorter episode"""
    kept_states: int = 20_000
    """states of such episodes that are kept; the oldest is forgotten first"""
    max_length: int = 16
    """steps after which an episode is given up"""
    sharpness: float = 8.0
    """what the values of the policy are multiplied by to be read as logits at the start"""
    detour: float = 0.03
    """how much longer the drawn episodes shall be than the greedy ones, on average"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("problems", self.problems, 1, 65_536)
        check_count("played_again", self.played_again, 0, self.problems)
        check_count("episodes", self.episodes, 2, 1024)
        check_count("updates_per_round", self.updates_per_round, 1, 65_536)
        check_count("batch_size", self.batch_size, 1, 65_536)
        check_count("kept_batch", self.kept_batch, 0, 65_536)
        check_count("alternatives", self.alternatives, 1, 1024)
        check_count("kept_states", self.kept_states, 1, 10_000_000)
        check_count("max_length", self.max_length, 1, 1_000_000)
        check_number("sharpness", self.sharpness, 1e-6, 1e6)
        check_number("detour", self.detour, 0.0, 10.0)


# -- learner -----------------------------------------------------------------------------------


class Lessons(NamedTuple):
    """States, and what is good in them."""

    seen: np.ndarray  # (B, N + 2K) float32
    good: np.ndarray  # (B, A ** N) bool, joint actions

    @classmethod
    def of(cls, size: int, spec: NetworkSpec) -> "Lessons":
        """Make room for so many."""
        return cls(
            np.zeros((size, spec.observation_size), np.float32),
            np.zeros((size, spec.n_joint_actions), np.bool_),
        )


class SelfImproved(Pupil):
    """A network that is taught by its own best episodes."""

    args: Args

    def __init__(self, args: Args, setting: Setting, network: Network) -> None:
        if network.spec.outputs != "joint":
            raise ValueError("policy must be a meta-agent's with joint values (--outputs joint)")
        check_count("alternatives", args.alternatives, 1, args.problems * args.episodes)
        super().__init__(args, network, np.random.default_rng(args.seed))
        self.cells = setting.grid.reachable
        self.envs = make_envs(setting, args.problems * args.episodes, args.max_length)
        self.envs.reset(seed=args.seed)  # each later problem is given, so nothing of it is random
        spec = self.spec
        self.lesson_states = Lessons.of(0, spec)  # of the episodes just played
        self.kept = Lessons.of(args.kept_states, spec)
        self.n_kept = 0  # ever; the next goes to row n_kept % kept_states
        self.again = np.zeros((0, spec.n_landmarks), np.int64)  # to be played again
        self.left = 0  # updates until the next round
        self.sharpness = 1.0  # what logits are multiplied by before actions are drawn

    def lesson(self) -> Tensor:
        """Return the loss on states of the best episodes; play a new round when it is time."""
        args = self.args
        if self.left == 0:
            self.play()
            self.left = args.updates_per_round
        self.left -= 1
        rows = self.rng.integers(len(self.lesson_states.seen), size=args.batch_size)
        seen, good = (array[rows] for array in self.lesson_states)
        if self.n_kept:
            rows = self.rng.integers(min(self.n_kept, args.kept_states), size=args.kept_batch)
            seen = np.concatenate((seen, self.kept.seen[rows]))
            good = np.concatenate((good, self.kept.good[rows]))
        return good_actions_loss(self.network(torch.from_numpy(seen)), torch.from_numpy(good))

    def play(self) -> None:
        """Play new problems, and keep of each the best episode."""
        args, k = self.args, self.spec.n_landmarks
        landmarks = draw_problems(self.cells, k, args.problems, self.rng)
        again = self.again[: args.played_again]
        landmarks[: len(again)] = again
        observations, joint, lengths = self.episodes(np.repeat(landmarks, args.episodes, axis=0))
        lengths = lengths.reshape(args.problems, args.episodes)
        best = lengths.argmin(axis=1)  # of equally short ones the first, so the greedy one
        # Taught what it does anyway, the policy becomes ever surer of itself: bolder then.
        bold = lengths[:, 1:].mean() > (1.0 + args.detour) * lengths[:, 0].mean()
        self.sharpness *= SHARPER if bold else 1.0 / SHARPER
        rows = np.arange(args.problems) * args.episodes + best
        observations, joint, shortest = observations[:, rows], joint[:, rows], lengths.min(axis=1)
        steps = np.arange(len(observations))[:, None]
        better = (shortest < lengths[:, 0]) | (lengths[:, 0] > args.max_length)
        left = np.concatenate((self.again[len(again) :], landmarks[better]))
        self.again = left[-MAX_AGAIN:] if args.played_again else left[:0]
        taken = (steps < shortest) & (shortest <= args.max_length)  # (T, problems)
        if not taken.any():
            raise ValueError("policy: it solves no problem within max_length, so nothing is taught")
        self.lesson_states = Lessons(
            observations[taken], np.eye(self.spec.n_joint_actions, dtype=np.bool_)[joint[taken]]
        )
        shorter = taken & better
        if shorter.any():
            self.keep(self.as_good(landmarks, observations, joint, shortest, shorter))

    def as_good(
        self,
        landmarks: np.ndarray,
        observations: np.ndarray,
        joint: np.ndarray,
        lengths: np.ndarray,
        chosen: np.ndarray,
    ) -> "Lessons":
        """Return which likely actions are as good as those taken in some states of episodes.

        Each episode is played again up to the state, then with another action, then greedily.

        Parameters
        ----------
        landmarks, observations, joint, lengths
            (P, K), (T, P, D), (T, P) and (P,): an episode on each problem.
        chosen
            (T, P) bool, in which states; the first that the environments have room for.
        """
        n_tried = min(self.args.alternatives, self.spec.n_joint_actions)
        room = self.envs.num_envs // n_tried
        times, problems = (index[:room] for index in np.nonzero(chosen))
        seen = observations[times, problems]
        good = np.zeros((len(seen), self.spec.n_joint_actions), np.bool_)
        good[np.arange(len(seen)), joint[times, problems]] = True
        if not len(seen):
            return Lessons(seen, good)
        with torch.inference_mode():
            scores = self.network(torch.from_numpy(seen))
        tried = scores.topk(n_tried).indices.numpy()
        # A row for each state and action; those left over play something, and nobody looks.
        count = len(seen) * n_tried
        index = np.resize(np.repeat(np.arange(len(seen)), n_tried), self.envs.num_envs)
        action = np.resize(tried.ravel(), self.envs.num_envs)
        time, problem = times[index], problems[index]
        here = begin(self.envs, landmarks[problem])
        playing = np.arange(self.envs.num_envs) < count
        for step in range(int(lengths[problems].max())):
            commands = np.where(step < time, joint[step, problem], action)
            free = np.flatnonzero(playing & (step > time))
            with torch.inference_mode():
                commands[free] = self.network(torch.from_numpy(here[free])).argmax(1).numpy()
            here, _, terminated, _, _ = self.envs.step(self.split(commands))
            solved = playing & terminated
            good[index[solved], action[solved]] = True
            playing &= ~terminated & (step + 1 < lengths[problem])
        return Lessons(seen, good)

    def episodes(self, landmarks: np.ndarray) -> Episodes:
        """Play an episode on each row of landmarks: every so-many-th greedily."""
        greedy = np.arange(len(landmarks)) % self.args.episodes == 0
        limit = self.args.max_length
        return play(self.envs, self.network, landmarks, limit, self.sharpness, greedy, self.rng)

    def split(self, joint: np.ndarray) -> np.ndarray:
        """Return the agents' actions (B, N) of joint ones (B,)."""
        return split_joint(joint, self.spec.n_agents, self.spec.n_actions)

    def keep(self, lessons: "Lessons") -> None:
        """Keep states of episodes that were shorter than the greedy one."""
        rows = (self.n_kept + np.arange(len(lessons.seen))) % self.args.kept_states
        self.kept.seen[rows], self.kept.good[rows] = lessons
        self.n_kept += len(lessons.seen)

    def own_arrays(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the episodes just played, and those that are kept."""
        n_rows = min(self.n_kept, self.args.kept_states)
        kept = Lessons(*(array[:n_rows] for array in self.kept))
        return {
            "round": {
                **self.lesson_states._asdict(),
                "again": self.again,
                "left": np.array(self.left),
                "sharpness": np.array(self.sharpness),
            },
            "kept": {**kept._asdict(), "n": np.array(self.n_kept)},
        }

    def restore_own(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`own_arrays` returned."""
        self.lesson_states = Lessons(arrays["round.seen"].copy(), arrays["round.good"].copy())
        self.again = arrays["round.again"].copy()
        self.left, self.n_kept = int(arrays["round.left"]), int(arrays["kept.n"])
        self.sharpness = float(arrays["round.sharpness"])
        for array, saved in zip(self.kept, (arrays["kept.seen"], arrays["kept.good"]), strict=True):
            array[: len(saved)] = saved


def sharpen(network: Network, factor: float) -> None:
    """Multiply all outputs of a network: its greedy actions stay the same."""
    with torch.no_grad():
        for weights in network.head.parameters():
            weights.mul_(factor)


def main(args: Args) -> int:
    """Improve and evaluate; return the exit code."""
    args = own_options(args, ALGORITHM)
    start = start_of(args.resume, args.policy)
    policy, setting, seen = starting_point(start)
    if start != args.resume:  # its own copy is sharp already
        sharpen(policy.network, args.sharpness)
    return run_imitation(
        args, ALGORITHM, setting, lambda: SelfImproved(args, setting, policy.network), seen
    )


if __name__ == "__main__":
    try:
        sys.exit(main(parse_arguments(Args, __doc__ or "")))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error
