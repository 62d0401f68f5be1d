"""The batched engine as a Stable-Baselines3 ``VecEnv``: no copy of rows, no environment a row."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor

from mapp_env.adapters.sb3_rows import RowsVecEnv, Stepped
from mapp_env.engine.options import check_grid_number
from mapp_env.engine.seeds import spread_seed
from mapp_env.envs.central_env import central_action_masks
from mapp_env.envs.vector_env import MappVectorEnv
from mapp_env.envs.vector_infos import Transition
from mapp_env.problem import Problem
from mapp_env.validation import MAX_SEED, check_count, describe

__all__ = ["MappSb3VecEnv", "make_sb3_vec"]


class MappSb3VecEnv(RowsVecEnv):
    """Many problems for one meta-agent, stepped as one batch, as Stable-Baselines3 wants them.

    A row that ends starts its next episode in the same step. Its info holds

    - ``terminal_observation``: the last observation;
    - ``TimeLimit.truncated``: whether the step limit ended it, so that its value is bootstrapped;
    - ``is_success``: whether the problem was solved, for the logged success rate;
    - ``metrics``: success, cover_time, makespan and total_distance;
    - ``episode``: return ``r``, length ``l`` and seconds ``t``, as ``Monitor`` gives them, so that
      no ``VecMonitor`` is needed.

    With a pool, every info has ``grid``, the number of the grid that the step was played on, and
    ``reset_infos`` those of the first episodes. Else infos of the other rows are empty. Each is its
    row's own, as wrappers write into them: with
    4,096 rows the form has 0.44 of the engine's speed for it, where one dict for all left 0.75
    (``benchmarks/sb3_vec.py``); a training by PPO takes no longer. Action masks are
    :meth:`action_masks`.

    Parameters
    ----------
    num_envs : int
        Number of rows B, 1 to 1,048,576.
    **arguments
        Those of :class:`mapp_env.envs.vector_env.MappVectorEnv` but ``autoreset_mode``:
        ``central_action="multi"`` (the default) gives ``MultiDiscrete`` actions, ``"joint"``
        numbered ones, which DQN needs. ``render_mode`` is ``"rgb_array"`` or None.

    Attributes
    ----------
    engine : MappVectorEnv
        What is stepped.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """

    def __init__(self, num_envs: int, **arguments: Any) -> None:
        if "autoreset_mode" in arguments:
            raise ValueError(
                "autoreset_mode cannot be chosen: Stable-Baselines3 needs the same-step mode; "
                f"got {describe(arguments['autoreset_mode'])}"
            )
        if arguments.get("render_mode") not in (None, "rgb_array"):
            raise ValueError(
                "render_mode must be 'rgb_array' or None: rows are shown side by side; "
                f"got {describe(arguments['render_mode'])}"
            )
        self.engine = MappVectorEnv(num_envs, autoreset_mode="SameStep", **arguments)
        self._returns = np.zeros(self.engine.num_envs)
        self._lengths = np.zeros(self.engine.num_envs, np.int64)
        self._started = time.perf_counter()
        spaces = self.engine.single_observation_space, self.engine.single_action_space
        super().__init__(self.engine, "engine", *spaces)

    @property
    def _limited(self) -> list[MappVectorEnv]:
        return [self.engine]

    # -- episodes ----------------------------------------------------------------------

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next :meth:`reset`; the rows' seeds are spread as the engine spreads them.

        Returns
        -------
        list of int, length B
            A single environment that is reset with the row's seed is that row.

        Raises
        ------
        ValueError
            If it is no seed.
        """
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        self._seed = check_count("seed", seed, 0, MAX_SEED)
        return spread_seed(self._seed, self.num_envs)

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Set the options of the next :meth:`reset`.

        Parameters
        ----------
        options : dict or list of dict, optional
            As the batch takes them: ``"grid"``, ``"landmarks"`` or ``"problem"``, for all rows
            alike or for each. A list has a dict for each row, all with ``"problem"`` or
            ``"landmarks"`` (and ``"grid"``, in an environment with a pool), or all with ``"grid"``
            alone.

        Raises
        ------
        ValueError
            If it is none of these.
        """
        if options is None or isinstance(options, Mapping):
            if options is not None and "reset_mask" in options:
                raise ValueError("options['reset_mask'] cannot be chosen: reset() is for all rows")
            self._next_options = None if options is None else deepcopy(dict(options))
            return
        if not isinstance(options, Sequence) or len(options) != self.num_envs:
            raise ValueError(
                f"options must be a dict, or a list of {self.num_envs} dicts, one a row, got "
                f"{describe(options)}"
            )
        if all(isinstance(wanted, Mapping) and set(wanted) == {"grid"} for wanted in options):
            task = self.engine.task
            numbers = [
                check_grid_number(task, wanted["grid"], f"options[{row}]['grid']")
                for row, wanted in enumerate(options)
            ]
            self._next_options = {"grid": numbers}
        else:
            problems = [self._problem_of(row, wanted) for row, wanted in enumerate(options)]
            self._next_options = {"problem": problems}

    def _problem_of(self, row: int, wanted: Any) -> Problem:
        """Return the problem that a row's options fix."""
        keys = set(wanted) if isinstance(wanted, Mapping) else set()
        if keys not in ({"landmarks"}, {"grid", "landmarks"}, {"problem"}):
            raise ValueError(
                f"options[{row}] must be a dict with 'problem', 'landmarks', or 'landmarks' and "
                f"'grid' alone (or all rows with 'grid' alone), got {describe(wanted)}"
            )
        try:
            problem = self.engine.find_problem(wanted)
        except ValueError as error:
            raise ValueError(f"options[{row}]: {error}") from error
        if problem is None:
            raise ValueError(f"options[{row}] must fix the landmarks, got {describe(wanted)}")
        return problem

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every row; return the observations, shape (B, ...).

        Raises
        ------
        ValueError
            If the options cannot be used.
        """
        observations, infos = self.engine.reset(seed=self._seed, options=self._next_options)
        self._masks = infos["action_mask"]
        self.reset_infos = self._fresh_infos(infos.get("grid"))
        self._seed, self._next_options = None, None
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return observations

    def step_wait(self) -> Stepped:
        """Carry out the joint actions.

        Returns
        -------
        observations, rewards, dones, infos
            Shapes (B, ...), (B,) float32, (B,) bool, and a list of length B.

        Raises
        ------
        ValueError
            If an action is not valid; nothing has moved then.
        """
        transition = self.engine.advance(self._actions)
        self._masks = transition.masks
        self._returns += transition.rewards
        self._lengths += 1
        infos = self._fresh_infos(transition.played_grids)
        if len(transition.ended):
            last = self._last_infos(transition)
            for index, info in zip(transition.ended.tolist(), last, strict=True):
                infos[index].update(info)
            self._returns[transition.ended] = 0.0
            self._lengths[transition.ended] = 0
        rewards = transition.rewards.astype(np.float32)
        return transition.observations, rewards, transition.dones, infos

    def _fresh_infos(self, grids: NDArray[np.int64] | None) -> list[dict[str, Any]]:
        """Return a dict for each row, with the number of its grid, (B,), if there is a pool."""
        if grids is None:
            return [{} for _ in range(self.num_envs)]
        return [{"grid": grid} for grid in grids.tolist()]

    def _last_infos(self, transition: Transition) -> list[dict[str, Any]]:
        """Return the infos of the rows that have ended."""
        ended, costs = transition.ended, transition.costs
        seconds = round(time.perf_counter() - self._started, 6)
        # Columns as lists and dicts written out: this is most of what the adapter costs.
        return [
            {
                "terminal_observation": last,
                "TimeLimit.truncated": truncated,
                "is_success": success,
                "metrics": {
                    "success": success,
                    "cover_time": cover_time,
                    "makespan": makespan,
                    "total_distance": distance,
                },
                "episode": {"r": total, "l": length, "t": seconds},
            }
            for last, truncated, success, cover_time, makespan, distance, total, length in zip(
                transition.last_observations,
                transition.truncations[ended].tolist(),
                np.isfinite(costs[:, 0]).tolist(),
                *costs.T.tolist(),
                self._returns[ended].tolist(),
                self._lengths[ended].tolist(),
                strict=True,
            )
        ]

    def _find_masks(self, masks: NDArray[np.int8]) -> NDArray[np.bool_]:
        return central_action_masks(masks, self.engine.joint_actions)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return that rows have what ``Monitor`` gives: evaluations read ``episode`` then."""
        monitored = wrapper_class is Monitor
        return [monitored] * len(list(self._get_indices(indices)))

    # -- pictures ----------------------------------------------------------------------

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return a picture of each row, with ``render_mode="rgb_array"``.

        All have one size, that of the largest grid of a pool.
        """
        pictures = self.engine.render()
        if pictures is None:
            return [None] * self.num_envs
        task = self.engine.task
        if not task.is_pool:
            return pictures
        from mapp_env.rendering.rgb_array import pad_frames

        shapes = {grid.walls.shape for grid in task.grids}
        return pad_frames(
            pictures, ((*shape, task.n_landmarks, self.max_cycles) for shape in shapes)
        )


def make_sb3_vec(num_envs: int, **arguments: Any) -> MappSb3VecEnv:
    """Return ``num_envs`` problems stepped as one batch, as a Stable-Baselines3 ``VecEnv``.

    Parameters are those of :class:`MappSb3VecEnv`.

    Raises
    ------
    ValueError
        If an argument is invalid.

    Examples
    --------
    >>> from stable_baselines3 import PPO
    >>> from mapp_env.adapters.sb3_vec import make_sb3_vec
    >>> model = PPO("MlpPolicy", make_sb3_vec(256), n_steps=64, batch_size=2048, seed=0)
    """
    return MappSb3VecEnv(num_envs, **arguments)
