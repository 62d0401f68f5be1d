"""Improve a trained policy by trying, in the states it comes to, what else it might have done.

Method: policy iteration by classification (Lagoudakis and Parr 2003). The policy plays random
problems in the batched environment, greedily but for a few random steps. In each state of some of
them, its likeliest joint actions and a few others are tried, side by side: the episode is played
again up to there, then the action, then on greedily until all is visited. Those after which that
was soonest are what the network is taught in this state, all alike. States in which the greedy
action was none of them are taught besides, and their problems come again. Trying takes long, and
few states are soon learned by heart: so in all other states that were passed, of which there are
many more, the network is taught what it does already, as the slowly moving average of it says. It
is also this average that plays.

This is reinforcement learning by trial alone: all that is known of a problem is how long one's own
episodes on it took, never the optimum, and walls are met by bumping into them. As many problems are
played as updates allow: on a small grid, in the end, many of those there are.

It starts from a policy of ``meta_dqn.py``: the larger its values, the likelier its actions.

Command::

    python baselines/self_improve.py --policy runs/meta_dqn-default-seed0-...
    python baselines/self_improve.py --resume runs/self_improve-default-seed0-...

Output: a run folder as of meta_dqn.py (no figures), with a row of metrics.csv per 100 updates.
"""

import copy
import sys
from dataclasses import dataclass
from typing import NamedTuple

import gymnasium
import numpy as np
import torch
import tyro
from torch import Tensor, nn

from baselines.checkpoints import part
from baselines.checks import check_count, check_number
from baselines.imitation import (
    ImitationOptions,
    Pupil,
    good_actions_loss,
    own_options,
    run_imitation,
)
from baselines.networks import Network, NetworkSpec, split_joint
from baselines.policy import find_weights, load_policy
from baselines.settings import Setting, check_fits, read_setting
from mapp_env import make_vec

ALGORITHM = "self_improve"
MAX_AGAIN = 4096  # problems that wait to be played again; the oldest is forgotten


# -- configuration -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(ImitationOptions):
    """Options of a self-improvement."""

    policy: str | None = None
    """a meta-agent with joint values to start from: a run folder, or a pretrained policy's name"""
    learning_rate: float = 0.0003
    """step size of Adam; it falls in a straight line to 0"""
    weight_decay: float = 0.1
    """share of every weight, times the step size, that each update takes off it"""
    problems: int = 1024
    """random problems that are played at a time"""
    tried_problems: int = 128
    """so many of them in whose states other actions are tried"""
    played_again: int = 32
    """at most so many of those are problems on which a mistake was made before"""
    exploration: float = 0.1
    """probability that an episode goes on with a random joint action"""
    alternatives: int = 12
    """likeliest joint actions that are tried in each state"""
    others: int = 4
    """random other joint actions that are tried besides"""
    max_length: int = 16
    """steps after which an episode is given up"""
    updates_per_round: int = 16
    """updates after each time"""
    batch_size: int = 384
    """states in an update of all that were passed"""
    tried_batch: int = 128
    """states in an update besides, of those in which other actions were tried"""
    mistakes_batch: int = 128
    """states in an update besides, of those in which the greedy action was a mistake"""
    learning_starts: int = 20_000
    """states that are tried before the first update"""
    kept_states: int = 100_000
    """states that are kept to be taught, the newest"""
    kept_mistakes: int = 5_000
    """mistakes that are kept, the newest"""
    averaging: float = 0.001
    """how far the average of the network goes towards the network with each update"""
    sharpness: float = 8.0
    """what the values of the policy are multiplied by to be read as logits at the start"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("problems", self.problems, 1, 65_536)
        check_count("tried_problems", self.tried_problems, 1, self.problems)
        check_count("played_again", self.played_again, 0, self.tried_problems)
        check_number("exploration", self.exploration, 0.0, 1.0)
        check_count("alternatives", self.alternatives, 2, 1024)
        check_count("others", self.others, 0, 1024)
        check_count("max_length", self.max_length, 1, 1_000_000)
        check_count("updates_per_round", self.updates_per_round, 1, 65_536)
        check_count("batch_size", self.batch_size, 1, 65_536)
        check_count("tried_batch", self.tried_batch, 0, 65_536)
        check_count("mistakes_batch", self.mistakes_batch, 0, 65_536)
        check_count("learning_starts", self.learning_starts, 0, 10_000_000)
        check_count("kept_states", self.kept_states, 1, 10_000_000)
        check_count("kept_mistakes", self.kept_mistakes, 1, 10_000_000)
        check_number("averaging", self.averaging, 1e-9, 1.0)
        check_number("sharpness", self.sharpness, 1e-6, 1e6)


# -- what is taught ----------------------------------------------------------------------------


class Lessons(NamedTuple):
    """States, and what is good in them."""

    seen: np.ndarray  # (B, N + 2K) float32
    good: np.ndarray  # (B, A ** N) bool, joint actions

    def where(self, chosen: np.ndarray | slice) -> "Lessons":
        """Return some of them."""
        return Lessons(*(array[chosen] for array in self))


class NewestLessons:
    """The newest lessons; the oldest goes first."""

    def __init__(self, size: int, spec: NetworkSpec) -> None:
        self.rows = Lessons(
            np.zeros((size, spec.observation_size), np.float32),
            np.zeros((size, spec.n_joint_actions), np.bool_),
        )
        self.n = 0  # so many ever; the next goes to row n % size

    def __len__(self) -> int:
        """Return how many there are."""
        return min(self.n, len(self.rows.seen))

    def add(self, lessons: Lessons) -> None:
        """Keep more of them."""
        size = len(self.rows.seen)
        newest = lessons.where(slice(-size, None))
        places = (self.n + np.arange(len(newest.seen))) % size
        for rows, new in zip(self.rows, newest, strict=True):
            rows[places] = new
        self.n += len(newest.seen)

    def draw(self, size: int, rng: np.random.Generator) -> Lessons:
        """Return random ones, none if there are none."""
        places = rng.integers(len(self), size=size) if len(self) else np.zeros(0, np.int64)
        return self.rows.where(places)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what is needed to go on."""
        kept = {name: array[: len(self)] for name, array in self.rows._asdict().items()}
        return {**kept, "n": np.array(self.n)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`arrays` returned."""
        self.n = int(arrays["n"])
        for name, array in self.rows._asdict().items():
            array[: len(self)] = arrays[name]


# -- learner -----------------------------------------------------------------------------------


class SelfImproved(Pupil):
    """A network that is taught what turned out best when it tried."""

    args: Args

    def __init__(self, args: Args, setting: Setting, network: Network) -> None:
        if network.spec.outputs != "joint":
            raise ValueError("policy must be a meta-agent's with joint values (--outputs joint)")
        super().__init__(args, network, np.random.default_rng(args.seed))
        self.player = copy.deepcopy(network).requires_grad_(False)  # the average
        self.n_tried = min(args.alternatives + args.others, self.spec.n_joint_actions)
        self.cells = setting.grid.reachable
        self.envs = make_vec(
            max(args.problems, args.tried_problems * self.n_tried),
            autoreset_mode=gymnasium.vector.AutoresetMode.NEXT_STEP,
            grid=setting.grid,
            n_agents=setting.n_agents,
            n_landmarks=setting.n_landmarks,
            max_cycles=args.max_length,
        )
        self.envs.reset(seed=args.seed)  # each later problem is given, so nothing of it is random
        self.kept = NewestLessons(args.kept_states, self.spec)
        self.mistakes = NewestLessons(args.kept_mistakes, self.spec)
        self.passed = np.zeros((0, self.spec.observation_size), np.float32)  # in the last round
        self.again = np.zeros((0, self.spec.n_landmarks), np.int64)  # problems to be played again
        self.left = 0  # updates until the next round

    def lesson(self) -> Tensor:
        """Return the loss on states of the last rounds; play a new round when it is time."""
        args = self.args
        if self.left == 0:
            self.play()
            while self.kept.n < args.learning_starts:
                self.play()
            self.left = args.updates_per_round
        self.left -= 1
        passed = self.passed[self.rng.integers(len(self.passed), size=args.batch_size)]
        tried = self.kept.draw(args.tried_batch, self.rng)
        mistakes = self.mistakes.draw(args.mistakes_batch, self.rng)
        seen = torch.from_numpy(np.concatenate((passed, tried.seen, mistakes.seen)))
        good = torch.from_numpy(np.concatenate((tried.good, mistakes.good)))
        scores = self.network(seen)
        with torch.no_grad():
            usual = self.player(seen[: len(passed)]).softmax(1)
        losses = nn.functional.cross_entropy(scores[: len(passed)], usual) * len(passed)
        if len(good):
            losses = losses + good_actions_loss(scores[len(passed) :], good) * len(good)
        return losses / len(seen)

    def update(self) -> None:
        """Learn from one batch, and move the average."""
        super().update()
        for mean, weights in zip(self.player.parameters(), self.network.parameters(), strict=True):
            mean.lerp_(weights.detach(), self.args.averaging)

    def play(self) -> None:
        """Play new problems, and keep what is best in each state on the way."""
        args, k = self.args, self.spec.n_landmarks
        drawn = self.rng.random((args.problems, len(self.cells))).argpartition(k - 1, axis=1)
        # In the order that the environment gives them in.
        landmarks = np.sort(self.cells[drawn[:, :k]], axis=1)
        again = self.again[: args.played_again]
        landmarks[: len(again)] = again
        seen, joint, lengths = self.episodes(landmarks)
        visited = np.arange(len(seen))[:, None] < lengths
        self.passed = seen[visited]
        times, problems = np.nonzero(visited[:, : args.tried_problems])
        seen = seen[times, problems]
        lessons = self.best_actions(landmarks, joint, times, problems, seen)
        greedy = self.scores(seen).argmax(axis=1)
        mistaken = ~lessons.good[np.arange(len(seen)), greedy]  # or nothing was good
        of_problem = np.zeros(args.problems, np.bool_)
        of_problem[problems[mistaken]] = True
        self.again = np.concatenate((self.again[len(again) :], landmarks[of_problem]))[-MAX_AGAIN:]
        known = lessons.good.any(axis=1)
        self.kept.add(lessons.where(known))
        self.mistakes.add(lessons.where(known & mistaken))
        if not len(self.kept):
            raise ValueError("policy: it solves no problem within max_length, so nothing is taught")

    def episodes(self, landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Play an episode on each problem (P, K).

        Returns
        -------
        observations, actions
            (T, P, D) float32 and (T, P) int64, joint; zero after the end of an episode.
        lengths
            (P,) steps until all was visited, at most ``max_length``.
        """
        args, n_problems = self.args, len(landmarks)
        here = self.begin(landmarks)
        lengths = np.full(n_problems, args.max_length)
        playing = np.arange(n_problems)
        observations, actions = [], []
        for step in range(1, args.max_length + 1):
            joint = np.zeros(self.envs.num_envs, np.int64)
            joint[playing] = self.scores(here[playing]).argmax(axis=1)
            explores = playing[self.rng.random(len(playing)) < args.exploration]
            joint[explores] = self.rng.integers(self.spec.n_joint_actions, size=len(explores))
            seen = np.zeros((n_problems, self.spec.observation_size), np.float32)
            seen[playing] = here[playing]
            observations.append(seen)
            actions.append(joint[:n_problems])
            here, _, terminated, _, _ = self.envs.step(self.split(joint))
            lengths[playing[terminated[playing]]] = step
            playing = playing[~terminated[playing]]
            if not len(playing):
                break
        return np.stack(observations), np.stack(actions), lengths

    def best_actions(
        self,
        landmarks: np.ndarray,
        joint: np.ndarray,
        times: np.ndarray,
        problems: np.ndarray,
        seen: np.ndarray,
    ) -> Lessons:
        """Return after which of the tried actions all is visited soonest, going on greedily.

        Parameters
        ----------
        landmarks, joint
            (P, K) and (T, P): an episode on each problem.
        times, problems
            (S,) each: the states, after so many steps of which episode.
        seen
            (S, D) the observations there.

        Returns
        -------
        Lessons
            None is good in a state after which ``max_length`` was never enough.
        """
        scores = self.scores(seen)
        tried = self.tried(scores)
        good = np.zeros(scores.shape, np.bool_)
        for first in range(0, len(times), self.args.tried_problems):
            some = slice(first, first + self.args.tried_problems)
            self.try_actions(landmarks, joint, times[some], problems[some], tried[some], good[some])
        return Lessons(seen, good)

    def tried(self, scores: np.ndarray) -> np.ndarray:
        """Return the likeliest joint actions and random others: (S, n_tried).

        The others, since what is never tried is never found. Of scores (S, A ** N).
        """
        order = np.argsort(-scores, axis=1)
        n_likeliest = min(self.args.alternatives, self.n_tried)
        rest = self.rng.permuted(order[:, n_likeliest:], axis=1)
        return np.concatenate((order[:, :n_likeliest], rest), axis=1)[:, : self.n_tried]

    def try_actions(
        self,
        landmarks: np.ndarray,
        joint: np.ndarray,
        times: np.ndarray,
        problems: np.ndarray,
        tried: np.ndarray,
        good: np.ndarray,
    ) -> None:
        """Mark in `good` which of the tried actions (S, n_tried) are best.

        There are at most `tried_problems` states.
        """
        # An environment for each state and action.
        index = np.repeat(np.arange(len(times)), self.n_tried)
        action, time, problem = tried.ravel(), times[index], problems[index]
        here = self.begin(landmarks[problem])
        playing = np.arange(len(index))
        known = np.zeros(len(times), np.bool_)  # which states' shortest way is
        for step in range(self.args.max_length):
            commands = np.zeros(self.envs.num_envs, np.int64)
            commands[: len(index)] = joint[min(step, len(joint) - 1), problem]
            now = time == step
            commands[: len(index)][now] = action[now]
            free = playing[time[playing] < step]
            if len(free):
                commands[free] = self.scores(here[free]).argmax(axis=1)
            here, _, terminated, _, _ = self.envs.step(self.split(commands))
            solved = playing[terminated[playing]]
            good[index[solved], action[solved]] = True
            known[index[solved]] = True
            playing = playing[~known[index[playing]]]
            if not len(playing):
                break

    def begin(self, landmarks: np.ndarray) -> np.ndarray:
        """Start an environment on each problem (P, K), the rest on any; return all observations."""
        problems = np.resize(landmarks, (self.envs.num_envs, landmarks.shape[1]))
        return self.envs.reset(options={"landmarks": problems})[0]

    def scores(self, seen: np.ndarray) -> np.ndarray:
        """Return the average network's scores (B, A ** N) of observations."""
        with torch.inference_mode():
            scores: np.ndarray = self.player(torch.from_numpy(seen)).numpy()
        return scores

    def split(self, joint: np.ndarray) -> np.ndarray:
        """Return the agents' actions (B, N) of joint ones (B,)."""
        return split_joint(joint, self.spec.n_agents, self.spec.n_actions)

    def own_arrays(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the average, the lessons, and what is played again."""
        return {
            "player": {name: t.numpy() for name, t in self.player.state_dict().items()},
            "kept": self.kept.arrays(),
            "mistakes": self.mistakes.arrays(),
            "round": {
                "again": self.again,
                "left": np.array(self.left),
                "passed": self.passed,
            },
        }

    def restore_own(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`own_arrays` returned."""
        average = part(arrays, "player")
        self.player.load_state_dict({k: torch.from_numpy(v) for k, v in average.items()})
        self.kept.restore(part(arrays, "kept"))
        self.mistakes.restore(part(arrays, "mistakes"))
        self.again, self.left = arrays["round.again"].copy(), int(arrays["round.left"])
        self.passed = arrays["round.passed"].copy()


def sharpen(network: Network, factor: float) -> None:
    """Multiply all outputs of a network: its greedy actions stay the same."""
    with torch.no_grad():
        for weights in network.head.parameters():
            weights.mul_(factor)


def main(args: Args) -> int:
    """Improve and evaluate; return the exit code."""
    args = own_options(args, ALGORITHM)
    # A resumed run has what it started from in its own folder, until it has something better.
    start = args.policy if args.resume is None else args.resume
    if start is None:
        raise ValueError("policy must be the run folder of a trained meta-agent, got none")
    trained = load_policy(start)
    folder = find_weights(start).parent
    setting, seen = read_setting(folder)
    check_fits(trained.spec, setting, folder)
    network = trained.network
    if args.resume is None:
        sharpen(network, args.sharpness)
    return run_imitation(
        args, ALGORITHM, setting, lambda: SelfImproved(args, setting, network), seen
    )


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args, description=__doc__)))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error
