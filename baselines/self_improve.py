"""Improve a trained policy by imitating the best of several of its own episodes.

Method: self-imitation. Of each random problem several episodes are played at once in the batched
environment: one greedily, the others with actions drawn from the policy, just so boldly that they
become a few per cent longer. The shortest is what the network is taught, the greedy one if none is
shorter; what was shorter is kept and taught again for a while. This is reinforcement learning by
trial alone: all that is known of a problem is how long one's own episodes on it took, never the
optimum, and walls are met by bumping into them. In the spirit of
self-imitation learning (Oh et al. 2018) and of the classifiers of rollout-based policy iteration
(Lagoudakis and Parr 2003).

It starts from a policy of ``meta_dqn.py``: the larger its values, the likelier its actions.

Command::

    python baselines/self_improve.py --policy runs/meta_dqn-default-seed0-...
    python baselines/self_improve.py --resume runs/self_improve-default-seed0-...

Output: a run folder as of meta_dqn.py (no figures), with a row of metrics.csv per 100 updates.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np
import torch
import tyro
from torch import Tensor, nn

from baselines.checks import check_count, check_number
from baselines.imitation import Options, Pupil, own_options, run_imitation
from baselines.networks import Network, split_joint
from baselines.policy import find_weights, load_policy
from baselines.settings import Setting, check_fits, read_setting
from mapp_env import make_vec

ALGORITHM = "self_improve"
SHARPER = 1.02  # factor from round to round


# -- configuration -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(Options):
    """Options of a self-improvement."""

    policy: Path | None = None
    """the run folder of a meta-agent with joint values, to start from"""
    learning_rate: float = 0.001
    """step size of Adam; it falls in a straight line to 0"""
    problems: int = 512
    """random problems that are played at a time"""
    episodes: int = 8
    """episodes of each, the first of them greedy"""
    updates_per_round: int = 16
    """updates after each time"""
    batch_size: int = 256
    """states in an update, of the episodes just played"""
    kept_batch: int = 256
    """states in an update besides, of episodes that were shorter than the greedy one"""
    kept_states: int = 60_000
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
        check_count("episodes", self.episodes, 2, 1024)
        check_count("updates_per_round", self.updates_per_round, 1, 65_536)
        check_count("batch_size", self.batch_size, 1, 65_536)
        check_count("kept_batch", self.kept_batch, 0, 65_536)
        check_count("kept_states", self.kept_states, 1, 10_000_000)
        check_count("max_length", self.max_length, 1, 1_000_000)
        check_number("sharpness", self.sharpness, 1e-6, 1e6)
        check_number("detour", self.detour, 0.0, 10.0)


# -- learner -----------------------------------------------------------------------------------


class SelfImproved(Pupil):
    """A network that is taught by its own best episodes."""

    args: Args

    def __init__(self, args: Args, setting: Setting, network: Network) -> None:
        if network.spec.outputs != "joint":
            raise ValueError("policy must be a meta-agent's with joint values (--outputs joint)")
        super().__init__(args, network, np.random.default_rng(args.seed))
        with torch.no_grad():
            for weights in network.head.parameters():
                weights.mul_(args.sharpness)
        self.cells = setting.grid.reachable
        self.envs = make_vec(
            args.problems * args.episodes,
            autoreset_mode=gymnasium.vector.AutoresetMode.NEXT_STEP,
            grid=setting.grid,
            n_agents=setting.n_agents,
            n_landmarks=setting.n_landmarks,
            max_cycles=args.max_length,
        )
        self.envs.reset(seed=args.seed)  # each later problem is given, so nothing of it is random
        size = self.spec.observation_size
        self.seen = np.zeros((0, size), np.float32)  # states of the episodes just played
        self.taught = np.zeros(0, np.int64)  # the joint action to take in each
        self.left = 0  # updates until the next round
        self.sharpness = 1.0  # what logits are multiplied by before actions are drawn
        self.kept_seen = np.zeros((args.kept_states, size), np.float32)
        self.kept_taught = np.zeros(args.kept_states, np.int64)
        self.n_kept = 0  # ever; the next goes to row n_kept % kept_states

    def lesson(self) -> Tensor:
        """Return the loss on states of the best episodes; play a new round when it is time."""
        args = self.args
        if self.left == 0:
            self.play()
            self.left = args.updates_per_round
        self.left -= 1
        rows = self.rng.integers(len(self.seen), size=args.batch_size)
        seen, taught = self.seen[rows], self.taught[rows]
        if self.n_kept:
            n_rows = min(self.n_kept, args.kept_states)
            rows = self.rng.integers(n_rows, size=args.kept_batch)
            seen = np.concatenate((seen, self.kept_seen[rows]))
            taught = np.concatenate((taught, self.kept_taught[rows]))
        scores = self.network(torch.from_numpy(seen))
        return nn.functional.cross_entropy(scores, torch.from_numpy(taught))

    def play(self) -> None:
        """Play new problems, and keep of each the best episode."""
        args, k = self.args, self.spec.n_landmarks
        drawn = self.rng.random((args.problems, len(self.cells))).argpartition(k - 1, axis=1)
        # In the order that the environment gives them in.
        landmarks = np.sort(self.cells[drawn[:, :k]], axis=1)
        observations, actions, lengths = self.episodes(np.repeat(landmarks, args.episodes, axis=0))
        lengths = lengths.reshape(args.problems, args.episodes)
        shortest = lengths.min(axis=1)
        best = lengths.argmin(axis=1)  # of equally short ones the first, so the greedy one
        # Taught what it does anyway, the policy becomes ever surer of itself: bolder then.
        bold = lengths[:, 1:].mean() > (1.0 + args.detour) * lengths[:, 0].mean()
        self.sharpness *= SHARPER if bold else 1.0 / SHARPER
        rows = np.arange(args.problems) * args.episodes + best
        steps = np.arange(len(observations))[:, None]
        solved = shortest <= args.max_length
        taken = (steps < shortest) & solved  # (T, problems)
        self.seen, self.taught = observations[:, rows][taken], actions[:, rows][taken]
        better = taken & (shortest < lengths[:, 0])
        self.keep(observations[:, rows][better], actions[:, rows][better])
        if not len(self.seen):
            raise ValueError("policy: it solves no problem within max_length, so nothing is taught")

    def episodes(self, landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Play an episode on each row of landmarks: every so-many-th greedily.

        Returns
        -------
        observations, actions
            (T, rows, D) float32 and (T, rows) int64, joint; zero after the end of an episode.
        lengths
            (rows,) steps until all was visited, ``max_length + 1`` if it was not.
        """
        args, spec = self.args, self.spec
        seen, _ = self.envs.reset(options={"landmarks": landmarks})
        n_rows = len(landmarks)
        playing = np.arange(n_rows)
        lengths = np.full(n_rows, args.max_length + 1)
        observations, actions = [], []
        for step in range(1, args.max_length + 1):
            here = np.zeros_like(seen)
            here[playing] = seen[playing]
            with torch.inference_mode():
                scores = self.network(torch.from_numpy(seen[playing])).numpy()
            # The largest of logits and Gumbel noise is a draw from the policy.
            chance = self.rng.standard_exponential(scores.shape, np.float32)
            noise = -np.log(np.maximum(chance, np.finfo(np.float32).tiny))
            noise[playing % args.episodes == 0] = 0.0
            joint = np.zeros(n_rows, np.int64)
            joint[playing] = (self.sharpness * scores + noise).argmax(axis=1)
            observations.append(here)
            actions.append(joint)
            commands = split_joint(joint, spec.n_agents, spec.n_actions)
            seen, _, terminated, _, _ = self.envs.step(commands)
            lengths[playing[terminated[playing]]] = step
            playing = playing[~terminated[playing]]
            if not len(playing):
                break
        return np.stack(observations), np.stack(actions), lengths

    def keep(self, seen: np.ndarray, taught: np.ndarray) -> None:
        """Keep states of episodes that were shorter than the greedy one."""
        rows = (self.n_kept + np.arange(len(seen))) % self.args.kept_states
        self.kept_seen[rows], self.kept_taught[rows] = seen, taught
        self.n_kept += len(seen)

    def own_arrays(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the episodes just played, and those that are kept."""
        n_rows = min(self.n_kept, self.args.kept_states)
        return {
            "round": {
                "seen": self.seen,
                "taught": self.taught,
                "left": np.array(self.left),
                "sharpness": np.array(self.sharpness),
            },
            "kept": {
                "seen": self.kept_seen[:n_rows],
                "taught": self.kept_taught[:n_rows],
                "n": np.array(self.n_kept),
            },
        }

    def restore_own(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`own_arrays` returned."""
        self.seen, self.taught = arrays["round.seen"].copy(), arrays["round.taught"].copy()
        self.left, self.n_kept = int(arrays["round.left"]), int(arrays["kept.n"])
        self.sharpness = float(arrays["round.sharpness"])
        n_rows = len(arrays["kept.seen"])
        self.kept_seen[:n_rows] = arrays["kept.seen"]
        self.kept_taught[:n_rows] = arrays["kept.taught"]


def main(args: Args) -> int:
    """Improve and evaluate; return the exit code."""
    args, _ = own_options(args, ALGORITHM)
    if args.policy is None:
        raise ValueError("policy must be the run folder of a trained meta-agent, got none")
    trained = load_policy(args.policy)
    folder = find_weights(args.policy).parent
    setting, seen = read_setting(folder)
    check_fits(trained.spec, setting, folder)
    return run_imitation(
        args, ALGORITHM, setting, lambda: SelfImproved(args, setting, trained.network), seen
    )


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args, description=__doc__)))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error
