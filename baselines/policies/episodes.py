"""Episodes of a meta-agent on many problems at once, greedy or drawn from its policy."""

from typing import NamedTuple

import gymnasium
import numpy as np
import torch

from baselines.networks import Network, split_joint
from baselines.policies.settings import Setting
from mapp_env import make_vec
from mapp_env.grid import pairs_of


class Episodes(NamedTuple):
    """One episode on each of P problems; zero after its end."""

    obs: np.ndarray  # (T, P, N + 2K) float32
    joint: np.ndarray  # (T, P) int64, joint actions
    lengths: np.ndarray  # (P,) int64 steps until all was visited, the limit + 1 if it was not


def make_envs(setting: Setting, n_rows: int, max_length: int) -> gymnasium.vector.VectorEnv:
    """Return environments for :func:`rollout`, which gives them their problems."""
    return make_vec(
        n_rows,
        autoreset_mode=gymnasium.vector.AutoresetMode.NEXT_STEP,
        grid=setting.grid,
        n_agents=setting.n_agents,
        n_landmarks=setting.n_landmarks,
        max_cycles=max_length,
    )


def begin(
    envs: gymnasium.vector.VectorEnv, landmarks: np.ndarray, seed: int | None = None
) -> np.ndarray:
    """Start an episode on each row of landmarks (P, K); return the observations (P, N + 2K)."""
    # As pairs: two rows of two cells could as well be two pairs.
    pairs = pairs_of(envs.unwrapped.task.grid, landmarks)  # type: ignore[attr-defined]
    obs: np.ndarray = envs.reset(seed=seed, options={"landmarks": pairs})[0]
    return obs


def rollout(
    envs: gymnasium.vector.VectorEnv,
    network: Network,
    landmarks: np.ndarray,  # (P, K), each row ascending
    max_length: int,  # step limit
    inverse_temperature: float,
    greedy: np.ndarray,  # (P,) bool, rows that take the action of the largest value
    rng: np.random.Generator,
) -> Episodes:
    """Play an episode on each row of landmarks, an environment each.

    The network's values, times the inverse temperature, are the logits of the joint actions.
    """
    obs = begin(envs, landmarks)
    spec, n_rows = network.spec, len(landmarks)
    running = np.arange(n_rows)
    lengths = np.full(n_rows, max_length + 1)
    observations, actions = [], []
    for step in range(1, max_length + 1):
        here = np.zeros_like(obs)
        here[running] = obs[running]
        with torch.inference_mode():
            scores = network(torch.from_numpy(obs[running])).numpy()
        # The largest of logits and Gumbel noise is a draw from the policy.
        chance = rng.standard_exponential(scores.shape, np.float32)
        noise = -np.log(np.maximum(chance, np.finfo(np.float32).tiny))
        noise[greedy[running]] = 0.0
        joint = np.zeros(n_rows, np.int64)
        joint[running] = (inverse_temperature * scores + noise).argmax(axis=1)
        observations.append(here)
        actions.append(joint)
        obs, _, terminated, _, _ = envs.step(split_joint(joint, spec.n_agents, spec.n_actions))
        lengths[running[terminated[running]]] = step
        running = running[~terminated[running]]
        if not len(running):
            break
    return Episodes(np.stack(observations), np.stack(actions), lengths)


def draw_problems(
    cells: np.ndarray, n_landmarks: int, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Return random sets of landmarks (count, K) in the order that environments give them in."""
    drawn = rng.random((count, len(cells))).argpartition(n_landmarks - 1, axis=1)
    return np.sort(cells[drawn[:, :n_landmarks]], axis=1)
