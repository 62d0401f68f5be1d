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
from pettingzoo.utils.conversions import parallel_to_aec, parallel_to_aec_wrapper

from mapp_env.parallel_env import MappParallelEnv

__all__ = ["env", "parallel_env", "raw_env"]

parallel_env = MappParallelEnv


def env(**arguments: Any) -> AECEnv[str, Any, Any]:
    """Return the environment in PettingZoo's AEC form, which refuses calls in the wrong order.

    Parameters are those of :class:`mapp_env.parallel_env.MappParallelEnv`.
    """
    return parallel_to_aec(parallel_env(**arguments))


def raw_env(**arguments: Any) -> AECEnv[str, Any, Any]:
    """Return the AEC form without the order check."""
    return parallel_to_aec_wrapper(parallel_env(**arguments))
