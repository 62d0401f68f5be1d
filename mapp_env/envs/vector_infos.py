"""What one joint action did in every row, and the infos that Gymnasium wants of it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.loops import fill_joint_masks


class Transition(NamedTuple):
    """A step of all B rows, M of which have ended; whoever steps the engine makes infos from it."""

    observations: NDArray[np.float32]  # (B, ...), of the next episode in rows that restarted
    rewards: NDArray[np.float64]  # (B,)
    terminations: NDArray[np.bool_]  # (B,)
    truncations: NDArray[np.bool_]  # (B,)
    masks: NDArray[np.int8]  # (B, N, A), of the next episode in rows that restarted
    dones: NDArray[np.bool_]  # (B,), terminations or truncations
    ended: NDArray[np.int64]  # (M,), the rows of dones
    costs: NDArray[np.float64]  # (M, 3), cover time, makespan, total distance (R8); inf: unsolved
    last_observations: NDArray[np.float32]  # (M, ...)
    last_masks: NDArray[np.int8]  # (M, N, A)
    restarted: bool  # whether the rows of ended have begun their next episode
    played_grids: NDArray[np.int64] | None  # (B,), of the pool: where the step was; None without
    grids: NDArray[np.int64] | None  # (B,), of the next episode in rows that restarted


def make_infos(transition: Transition, n_joint_actions: int) -> dict[str, Any]:
    """Return the infos of a step as ``gymnasium.vector.SyncVectorEnv`` gives them.

    ``n_joint_actions`` is A**N if rows take numbers of joint actions, else 0.
    """
    infos: dict[str, Any] = {}
    if len(transition.ended) and transition.restarted:
        _add_finals(infos, transition, n_joint_actions)
    elif len(transition.ended):
        _add_metrics(infos, transition)
    infos["action_mask"] = transition.masks
    infos["_action_mask"] = np.ones(len(transition.dones), np.bool_)
    if n_joint_actions:
        add_joint_masks(infos, n_joint_actions)
    if transition.grids is not None:
        infos["grid"], infos["_grid"] = transition.grids, np.ones(len(transition.dones), np.bool_)
    return infos


def add_joint_masks(infos: dict[str, Any], n_joint_actions: int) -> None:
    """Add the masks of numbered joint actions, shape (B, A**N), beside those of the agents."""
    masks, rows = infos["action_mask"], infos["_action_mask"]
    joint = np.empty((len(masks), n_joint_actions), np.int8)
    fill_joint_masks(masks, joint)
    infos["joint_action_mask"], infos["_joint_action_mask"] = joint, rows.copy()


def _add_metrics(infos: dict[str, Any], transition: Transition) -> None:
    """Add the metrics of the rows that ended, in the manner of ``VectorEnv._add_info``."""
    dones, ended, costs = transition.dones, transition.ended, transition.costs
    columns = np.zeros((3, len(dones)))
    columns[:, ended] = costs.T
    success = np.zeros(len(dones), np.bool_)
    success[ended] = np.isfinite(costs[:, 0])
    # One array for all flags: to copy them one by one takes longer than the rest of this.
    flags = np.repeat(dones[None], 5, axis=0)
    metrics: dict[str, NDArray[Any]] = {"success": success, "_success": flags[0]}
    for place, name in enumerate(("cover_time", "makespan", "total_distance")):
        metrics[name], metrics[f"_{name}"] = columns[place], flags[place + 1]
    infos["metrics"], infos["_metrics"] = metrics, flags[4]


def _add_finals(infos: dict[str, Any], transition: Transition, n_joint_actions: int) -> None:
    """Add the last observations and infos of the rows that ended."""
    dones, ended = transition.dones, transition.ended
    final_obs = np.empty(len(dones), dtype=object)  # of None
    final_obs[ended] = np.fromiter(transition.last_observations, object, len(ended))
    action_mask = np.zeros(transition.masks.shape, np.int8)
    action_mask[ended] = transition.last_masks
    final_info = {"action_mask": action_mask, "_action_mask": dones.copy()}
    if n_joint_actions:
        add_joint_masks(final_info, n_joint_actions)
    if transition.played_grids is not None:
        final_info["grid"] = np.where(dones, transition.played_grids, 0)
        final_info["_grid"] = dones.copy()
    _add_metrics(final_info, transition)
    infos["final_obs"], infos["_final_obs"] = final_obs, dones.copy()
    infos["final_info"], infos["_final_info"] = final_info, dones.copy()
