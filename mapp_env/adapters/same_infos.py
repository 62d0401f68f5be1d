"""Infos that have the same entries at every step, as TorchRL's ``PettingZooWrapper`` needs them."""

from __future__ import annotations

from typing import Any

from pettingzoo.utils.wrappers import BaseParallelWrapper

__all__ = ["SameInfos"]


class SameInfos(BaseParallelWrapper):  # type: ignore[misc] # PettingZoo does not say its types
    """The PettingZoo environment without the ``metrics`` of an episode's last step.

    TorchRL makes a tensor of each entry that the first infos have besides ``action_mask``, here
    ``grid`` where there is a pool, and fails at a later step that has another. (Where there is no
    pool, it looks at no infos, and needs no such wrapper.)

    Parameters
    ----------
    env : MappParallelEnv
        The environment.

    Examples
    --------
    >>> import mapp_env
    >>> from mapp_env.adapters.same_infos import SameInfos
    >>> pool = mapp_env.make_grids("rooms", 10)
    >>> env = SameInfos(mapp_env.mapp_v0.parallel_env(grid=pool))
    """

    def step(self, actions: Any) -> Any:
        """Move all agents; return what the environment does, but for the metrics."""
        *found, infos = self.env.step(actions)
        for info in infos.values():
            info.pop("metrics", None)
        return *found, infos
