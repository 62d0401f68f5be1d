"""PettingZoo's module of version 0: ``parallel_env``, ``env`` (AEC) and ``raw_env``.

Examples
--------
>>> from mapp_env import mapp_v0
>>> env = mapp_v0.parallel_env()
>>> observations, infos = env.reset(seed=0)
"""

from __future__ import annotations

from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from mapp_env.envs.parallel_env import MappParallelEnv

__all__ = ["env", "parallel_env", "raw_env"]

parallel_env = MappParallelEnv


class HasLimit:
    """What is assigned to ``max_cycles`` of an AEC form reaches the environment inside."""

    unwrapped: MappParallelEnv

    @property
    def max_cycles(self) -> int:
        """Step at which an episode is truncated (R7); may be assigned, from the next reset on."""
        return self.unwrapped.max_cycles

    @max_cycles.setter
    def max_cycles(self, value: int) -> None:
        self.unwrapped.max_cycles = value


class MappAECEnv(HasLimit, parallel_to_aec_wrapper):
    """The AEC form, in which a bad action is refused when it is given, not when all agents move."""

    def step(self, action: int | None) -> None:
        """Give the selected agent's action; all agents move with the last one's.

        Raises
        ------
        ValueError
            If it is not an action; the agent stays selected.
        """
        agent = self.agent_selection
        if not (self.terminations[agent] or self.truncations[agent]):
            self.env.check_action(agent, action)
        super().step(action)


class OrderedAECEnv(HasLimit, OrderEnforcingWrapper):
    """The AEC form that refuses calls in the wrong order."""


def env(**arguments: Any) -> AECEnv[str, Any, Any]:
    """Return the environment in PettingZoo's AEC form, which refuses calls in the wrong order.

    Parameters are those of :class:`mapp_env.envs.parallel_env.MappParallelEnv`.
    """
    return OrderedAECEnv(MappAECEnv(parallel_env(**arguments)))


def raw_env(**arguments: Any) -> AECEnv[str, Any, Any]:
    """Return the AEC form without the order check."""
    return MappAECEnv(parallel_env(**arguments))
