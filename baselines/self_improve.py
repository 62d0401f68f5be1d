"""Improve a trained policy by imitating the best of several of its own episodes.

Method: self-imitation. Several episodes are played at once of each random problem: one greedily,
the others with actions drawn from the policy, just so boldly that they become a few per cent
longer. Where one is shorter than the greedy one, it is played again from each of its states with
other likely actions, to find those that are as good; these states, with all good actions, are kept
as training data, and the problem comes again until the greedy episode is as short. Where nothing
shorter was found, the network imitates the greedy episode. This is reinforcement learning by trial
alone: all that is known of a problem is how long the policy's own episodes on it took, never the
optimum, and walls are met by bumping into them. In the spirit of self-imitation learning (Oh et al.
2018) and of rollout-based policy iteration by classification (Lagoudakis and Parr 2003). As many
problems are played as updates allow: on a small grid, in the end, nearly all there are.

It starts from a policy of ``meta_dqn.py``: the larger its values, the likelier its actions.

Command::

    python baselines/self_improve.py --policy runs/meta_dqn-default-seed0-...
    python baselines/self_improve.py --resume runs/self_improve-default-seed0-...

Output: a run folder as of meta_dqn.py (no figures), with a row of metrics.csv per 100 updates.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from baselines.learning.config import own_options, run_script
from baselines.learning.imitation import Imitation, ImitationOptions, good_actions_loss, start_of
from baselines.learning.ranges import Positive, Share, Within
from baselines.learning.train import run_training
from baselines.networks import Network, NetworkSpec, split_joint
from baselines.policies.episodes import Episodes, begin, draw_problems, make_envs, rollout
from baselines.policies.settings import Setting, load_run
from mapp_env.validation import check_count

ALGORITHM = "self_improve"
MAX_AGAIN = 4096  # problems that wait to be played again; the oldest is forgotten
COOLING = 1.02  # factor of the inverse temperature from round to round


# -- configuration -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(ImitationOptions):
    """Options of a self-improvement."""

    policy: str | None = None
    """a meta-agent with joint values to start from: a run folder, or a pretrained policy's name"""
    learning_rate: Annotated[float, Within(1e-12, 1.0)] = 0.001
    """step size of Adam; it falls in a straight line to 0"""
    weight_decay: Share = 0.0
    """share of every weight, times the step size, that each update takes off it"""
    problems: Annotated[int, Within(1, 65_536)] = 512
    """random problems that are played at a time"""
    played_again: Annotated[int, Within(0, 65_536)] = 128
    """at most so many of them are problems on which the greedy episode was not the shortest"""
    episodes: Annotated[int, Within(2, 1024)] = 8
    """episodes of each, the first of them greedy"""
    updates_per_round: Annotated[int, Within(1, 65_536)] = 16
    """updates after each time"""
    batch_size: Annotated[int, Within(1, 65_536)] = 256
    """states in an update, of the episodes just played"""
    kept_batch: Annotated[int, Within(0, 65_536)] = 256
    """states in an update besides, of episodes that were shorter than the greedy one"""
    alternatives: Annotated[int, Within(1, 1024)] = 12
    """likely joint actions that are tried in each state of a shorter episode"""
    kept_states: Annotated[int, Within(1, 10_000_000)] = 20_000
    """states of such episodes that are kept; the oldest is forgotten first"""
    max_length: Annotated[int, Within(1, 1_000_000)] = 16
    """step limit of an episode"""
    inverse_temperature: Positive = 8.0
    """what the values of the policy are multiplied by to be read as logits at the start"""
    detour: Annotated[float, Within(0.0, 10.0)] = 0.03
    """how much longer drawn episodes are to be than greedy ones, on average"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("played_again", self.played_again, 0, self.problems)


# -- learner -----------------------------------------------------------------------------------


class Labelled(NamedTuple):
    """States, and what is good in them."""

    obs: np.ndarray  # (B, N + 2K) float32
    good: np.ndarray  # (B, A ** N) bool, joint actions

    @classmethod
    def empty(cls, size: int, spec: NetworkSpec) -> "Labelled":
        """Make room for so many."""
        return cls(
            np.zeros((size, spec.observation_size), np.float32),
            np.zeros((size, spec.n_joint_actions), np.bool_),
        )


class SelfImproved(Imitation):
    """A network that learns from its own best episodes."""

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
        self.fresh = Labelled.empty(0, spec)  # of the episodes just played
        self.kept = Labelled.empty(args.kept_states, spec)
        self.n_kept = 0  # ever; the next goes to row n_kept % kept_states
        self.again = np.zeros((0, spec.n_landmarks), np.int64)  # problems to be played again
        self.left = 0  # updates until the next round
        self.inverse_temperature = 1.0  # of the network as it was scaled at the start

    def batch_loss(self) -> Tensor:
        """Return the loss on states of the best episodes; play a new round when it is time."""
        args = self.args
        if self.left == 0:
            self.play_round()
            self.left = args.updates_per_round
        self.left -= 1
        rows = self.rng.integers(len(self.fresh.obs), size=args.batch_size)
        obs, good = (array[rows] for array in self.fresh)
        if self.n_kept:
            rows = self.rng.integers(min(self.n_kept, args.kept_states), size=args.kept_batch)
            obs = np.concatenate((obs, self.kept.obs[rows]))
            good = np.concatenate((good, self.kept.good[rows]))
        return good_actions_loss(self.network(torch.from_numpy(obs)), torch.from_numpy(good))

    def play_round(self) -> None:
        """Play new problems; label the states of the best episode of each."""
        args, k = self.args, self.spec.n_landmarks
        landmarks = draw_problems(self.cells, k, args.problems, self.rng)
        again = self.again[: args.played_again]
        landmarks[: len(again)] = again
        obs, joint, lengths = self.episodes(np.repeat(landmarks, args.episodes, axis=0))
        lengths = lengths.reshape(args.problems, args.episodes)
        best = lengths.argmin(axis=1)  # of equally short ones the first, so the greedy one
        # The policy imitates what it does anyway, and becomes ever surer of it: bolder then.
        bold = lengths[:, 1:].mean() > (1.0 + args.detour) * lengths[:, 0].mean()
        self.inverse_temperature *= COOLING if bold else 1.0 / COOLING
        rows = np.arange(args.problems) * args.episodes + best
        obs, joint, shortest = obs[:, rows], joint[:, rows], lengths.min(axis=1)
        steps = np.arange(len(obs))[:, None]
        better = (shortest < lengths[:, 0]) | (lengths[:, 0] > args.max_length)
        left = np.concatenate((self.again[len(again) :], landmarks[better]))
        self.again = left[-MAX_AGAIN:] if args.played_again else left[:0]
        taken = (steps < shortest) & (shortest <= args.max_length)  # (T, problems)
        if not taken.any():
            raise ValueError(
                "policy: it solves no problem within max_length, so there is nothing to imitate"
            )
        self.fresh = Labelled(
            obs[taken], np.eye(self.spec.n_joint_actions, dtype=np.bool_)[joint[taken]]
        )
        shorter = taken & better
        if shorter.any():
            self.keep(self.label(landmarks, obs, joint, shortest, shorter))

    def episodes(self, landmarks: np.ndarray) -> Episodes:
        """Play one episode per row of landmarks; every n-th row is greedy."""
        greedy = np.arange(len(landmarks)) % self.args.episodes == 0
        limit = self.args.max_length
        return rollout(
            self.envs, self.network, landmarks, limit, self.inverse_temperature, greedy, self.rng
        )

    def label(
        self,
        landmarks: np.ndarray,  # (P, K); with the next three an episode on each problem
        obs: np.ndarray,  # (T, P, D)
        joint: np.ndarray,  # (T, P)
        lengths: np.ndarray,  # (P,)
        chosen: np.ndarray,  # (T, P) bool
    ) -> Labelled:
        """Return which likely actions are as good as those taken in some states of episodes.

        Each episode is played again up to the state, then with another action, then greedily.
        The states are the first of those chosen that the environments have room for.
        """
        spec, n_envs = self.spec, self.envs.num_envs
        n_tried = min(self.args.alternatives, spec.n_joint_actions)
        times, problems = (index[: n_envs // n_tried] for index in np.nonzero(chosen))
        states = obs[times, problems]
        good = np.zeros((len(states), spec.n_joint_actions), np.bool_)
        good[np.arange(len(states)), joint[times, problems]] = True
        if not len(states):
            return Labelled(states, good)
        with torch.inference_mode():
            tried = self.network(torch.from_numpy(states)).topk(n_tried).indices.numpy()
        # A row for each state and action; those left over are not looked at.
        running = np.arange(n_envs) < len(states) * n_tried
        index = np.resize(np.repeat(np.arange(len(states)), n_tried), n_envs)
        action = np.resize(tried.ravel(), n_envs)
        time, problem = times[index], problems[index]
        here = begin(self.envs, landmarks[problem])
        for step in range(int(lengths[problems].max())):
            commands = np.where(step < time, joint[step, problem], action)
            free = np.flatnonzero(running & (step > time))
            with torch.inference_mode():
                commands[free] = self.network(torch.from_numpy(here[free])).argmax(1).numpy()
            here, _, terminated, _, _ = self.envs.step(
                split_joint(commands, spec.n_agents, spec.n_actions)
            )
            solved = running & terminated
            good[index[solved], action[solved]] = True
            running &= ~terminated & (step + 1 < lengths[problem])
        return Labelled(states, good)

    def keep(self, states: Labelled) -> None:
        """Keep states of episodes that were shorter than the greedy one."""
        rows = (self.n_kept + np.arange(len(states.obs))) % self.args.kept_states
        self.kept.obs[rows], self.kept.good[rows] = states
        self.n_kept += len(states.obs)

    def own_arrays(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the episodes just played, and those that are kept."""
        n_rows = min(self.n_kept, self.args.kept_states)
        kept = Labelled(*(array[:n_rows] for array in self.kept))
        return {
            "round": {
                **self.fresh._asdict(),
                "again": self.again,
                "left": np.array(self.left),
                "inverse_temperature": np.array(self.inverse_temperature),
            },
            "kept": {**kept._asdict(), "n": np.array(self.n_kept)},
        }

    def restore_own(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`own_arrays` returned."""
        self.fresh = Labelled(arrays["round.obs"].copy(), arrays["round.good"].copy())
        self.again = arrays["round.again"].copy()
        self.left, self.n_kept = int(arrays["round.left"]), int(arrays["kept.n"])
        self.inverse_temperature = float(arrays["round.inverse_temperature"])
        for array, name in zip(self.kept, Labelled._fields, strict=True):
            array[: len(arrays[f"kept.{name}"])] = arrays[f"kept.{name}"]


def scale_outputs(network: Network, factor: float) -> None:
    """Multiply all outputs of a network: its greedy actions stay the same."""
    with torch.no_grad():
        for weights in network.head.parameters():
            weights.mul_(factor)


def main(args: Args) -> int:
    """Improve and evaluate; return the exit code.

    Raises a ValueError if no policy is named, or it cannot be improved.
    """
    args = own_options(args, ALGORITHM)
    start = start_of(args.resume, args.policy)
    if start is None:
        raise ValueError("policy must be the run folder of a trained meta-agent, got none")
    policy, setting, problems = load_run(start)
    if start != args.resume:  # its own copy is scaled already
        scale_outputs(policy.network, args.inverse_temperature)
    return run_training(
        args, ALGORITHM, setting, problems, lambda: SelfImproved(args, setting, policy.network)
    )


if __name__ == "__main__":
    run_script(main, Args, __doc__)
