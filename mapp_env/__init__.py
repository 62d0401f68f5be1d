"""Multi-agent path planning on walled grids: a PettingZoo environment, also batched, and solvers.

The system of Çetinkaya, "Multi-Agent Path Planning Using Deep Reinforcement Learning",
arXiv 2110.01460. Importing this module registers the environments with PettingZoo (where it has a
registry) and Gymnasium, and loads neither torch nor any drawing library.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any, NoReturn

import gymnasium
import pettingzoo

from mapp_env import mapp_v0, solvers
from mapp_env.envs.vector_env import make_vec
from mapp_env.evaluation import evaluate
from mapp_env.files import FileError
from mapp_env.grid import Grid
from mapp_env.grids import grid_names, load_grids, make_grid, make_grids
from mapp_env.map_format import MapError
from mapp_env.plans.plan import Plan, replay
from mapp_env.problem import Problem, sample_problems
from mapp_env.solvers import solve

__all__ = [
    "FileError",
    "Grid",
    "MapError",
    "Plan",
    "Problem",
    "__version__",
    "evaluate",
    "grid_names",
    "load_grids",
    "make_grid",
    "make_grids",
    "make_vec",
    "mapp_v0",
    "replay",
    "sample_problems",
    "solve",
    "solvers",
]

__version__ = "0.1.0"


def _register() -> None:
    """Make the environments known by name; again on a reload does nothing."""
    if "mapp_env/Central-v0" not in gymnasium.registry:
        gymnasium.register(
            "mapp_env/Central-v0",
            entry_point="mapp_env.envs.central_env:CentralEnv",
            vector_entry_point="mapp_env.envs.vector_env:make_gymnasium_vec",
        )
    if "mapp_env/Tuple-v0" not in gymnasium.registry:
        gymnasium.register(
            "mapp_env/Tuple-v0",
            entry_point="mapp_env.envs.tuple_env:TupleEnv",
            disable_env_checker=True,  # it would warn that a list of rewards is no number
        )
    # PettingZoo has a registry from 1.27 on.
    if hasattr(pettingzoo, "register"):
        for kind, registry, entry_point in (
            ("parallel", pettingzoo.parallel_registry, "mapp_env.mapp_v0:parallel_env"),
            ("aec", pettingzoo.aec_registry, "mapp_env.mapp_v0:env"),
        ):
            if "mapp_env/mapp-v0" not in registry:
                pettingzoo.register(kind, "mapp_env/mapp-v0", entry_point)


_MEANT = {
    "env": "mapp_env.mapp_v0.env()",
    "raw_env": "mapp_env.mapp_v0.raw_env()",
    "mapp_v0": "mapp_env.mapp_v0.parallel_env()",
    "parallel_env": "mapp_env.mapp_v0.parallel_env()",
    "central_env": 'gymnasium.make("mapp_env/Central-v0")',
    "vector_env": "mapp_env.make_vec(num_envs)",
}
"""Names that are easily mistaken for environment constructors, and what to call instead."""


class _Module(ModuleType):
    """A module of the package that says what to call in its place."""

    def __call__(self, *_arguments: Any, **_options: Any) -> NoReturn:
        name = self.__name__
        meant = _MEANT[name.removeprefix("mapp_env.")]
        raise TypeError(f"{name} is a module: an environment is made by {meant}")


for _name in _MEANT:
    if f"mapp_env.{_name}" in sys.modules:
        sys.modules[f"mapp_env.{_name}"].__class__ = _Module

if not TYPE_CHECKING:  # type checkers would accept every attribute

    def __getattr__(name: str) -> Any:
        """Say where an environment is that is looked for at the top of the package."""
        hint = f": an environment is made by {_MEANT[name]}" if name in _MEANT else ""
        raise AttributeError(f"module 'mapp_env' has no attribute {name!r}{hint}", name=name)


_register()
