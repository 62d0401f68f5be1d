"""The batched face: B problems at a time through the same kernels, as a Gymnasium ``VectorEnv``."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import logger
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mapp_env.central_env import CentralEnv, central_action_space
from mapp_env.dynamics import (
    action_masks,
    fill_fields,
    find_bad_action,
    measure_rows,
    reset_rows,
    step_rows,
)
from mapp_env.grid import Grid
from mapp_env.observation import Observation, observe_rows
from mapp_env.problem import check_landmarks
from mapp_env.rendering.display import Display
from mapp_env.simulation import scene_of
from mapp_env.task import Task
from mapp_env.validation import MAX_SEED, as_integer, check_choice, check_count, describe

__all__ = ["MAX_ENVS", "MappVectorEnv", "make_vec"]

MAX_ENVS = 1 << 20

VECTOR_RENDER_MODES = ("rgb_array", "ansi")

WORDS_AHEAD = 16
"""Random words fetched from a row's generator at a time: a call for each would dominate a step."""


class MappVectorEnv(VectorEnv[NDArray[np.float32], NDArray[np.int64], NDArray[Any]]):
    """Many independent problems stepped at once, for one meta-agent (see ``CentralEnv``).

    Row ``i`` is bit for bit the single environment that is reset with seed ``np_random_seed[i]``.
    Returned arrays are the caller's.

    Parameters
    ----------
    num_envs : int
        Number of rows B, 1 to 1,048,576.
    autoreset_mode : gymnasium.vector.AutoresetMode or str
        When a finished row starts its next episode: ``NEXT_STEP`` (Gymnasium's default),
        ``SAME_STEP`` or ``DISABLED``, with infos where Gymnasium puts them.
    central_action : {"multi", "joint", "auto"}
        Actions of shape (B, N), one an agent, or (B,), numbered joint actions.
    grid, n_agents, n_landmarks, max_cycles, reward, observation, allow_wait, render_mode
        As in :class:`mapp_env.parallel_env.MappParallelEnv`.

    Raises
    ------
    ValueError
        If an argument is not as said.
    """

    def __init__(
        self,
        num_envs: int,
        grid: str | os.PathLike[str] | Grid = "paper-7x7",
        n_agents: int = 3,
        n_landmarks: int = 5,
        max_cycles: int = 50,
        reward: str = "manhattan",
        observation: str = "global",
        allow_wait: bool = False,
        render_mode: str | None = None,
        central_action: str = "multi",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        self.num_envs = check_count("num_envs", num_envs, 1, MAX_ENVS)
        task = Task(
            grid,  # type: ignore[arg-type] - a name or a path becomes a grid
            n_agents,
            n_landmarks,
            max_cycles,
            reward,
            observation,
            allow_wait,
            render_mode,
        )
        task.check_memory(self.num_envs)
        self.task = task
        check_choice("render_mode", task.render_mode, (None, *VECTOR_RENDER_MODES))
        self.autoreset_mode = _find_mode(autoreset_mode)
        self.metadata = {
            **CentralEnv.metadata,
            "render_modes": list(VECTOR_RENDER_MODES),
            "autoreset_mode": self.autoreset_mode,
        }
        self.render_mode = task.render_mode
        view = task.central_view
        self.single_observation_space = Box(view.low, view.high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.single_action_space, self._joint_actions = central_action_space(task, central_action)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

        self._sizes = (task.n_agents, task.n_landmarks)
        self._n_views = 1 if task.observation_kind == Observation.GLOBAL else task.n_agents
        self._rows = np.zeros((self.num_envs, task.row_length), np.int32)
        self._distances = task.new_distances(self.num_envs)
        self._queue = np.empty(task.grid.n_cells if task.needs_fields else 0, np.int32)
        self._started = False
        self._ended = np.zeros(self.num_envs, np.bool_)  # finished, not yet reset
        self._nobody = np.zeros(self.num_envs, np.bool_)
        self._generators: list[np.random.Generator] = []
        self._seeds: list[int] = []
        self._words = np.zeros((self.num_envs, WORDS_AHEAD), np.uint64)
        self._words_used = np.full(self.num_envs, WORDS_AHEAD, np.int64)
        self._limits = np.full(self.num_envs, task.max_cycles, np.int64)
        self._trails: list[list[tuple[int, ...]]] = [[] for _ in range(self.num_envs)]

    # -- seeds ---------------------------------------------------------------------------------------

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each row; a single environment reset with it is that row."""
        self._seed_rows(None, [])
        return tuple(self._seeds)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generator of each row; up to 16 words of it may have been fetched ahead."""
        self._seed_rows(None, [])
        return tuple(self._generators)

    def _seed_rows(self, seed: int | list[int | None] | None, indices: list[int]) -> None:
        """Give rows new generators: those of ``indices`` as ``seed`` says, all if none has one yet."""
        if not self._generators:
            self._generators = [np.random.default_rng(0)] * self.num_envs
            self._seeds = [0] * self.num_envs
            spread = seed if isinstance(seed, int) else None
            self._set_seeds(_spread_seed(spread, self.num_envs), list(range(self.num_envs)))
        elif isinstance(seed, int):
            self._set_seeds(_spread_seed(seed, self.num_envs), indices)
        if isinstance(seed, list):
            self._set_seeds(seed, [index for index in indices if seed[index] is not None])

    def _set_seeds(self, seeds: Sequence[int | None], indices: list[int]) -> None:
        for index in indices:
            self._generators[index], self._seeds[index] = seeding.np_random(seeds[index])
        self._words_used[indices] = WORDS_AHEAD

    def _next_words(self, indices: NDArray[np.int64]) -> NDArray[np.uint64]:
        """Return the next random word of each row of ``indices``, shape (M,)."""
        used = self._words_used
        for index in indices[used[indices] == WORDS_AHEAD]:
            generator = self._generators[index]
            self._words[index] = generator.integers(2**64, size=WORDS_AHEAD, dtype=np.uint64)
            used[index] = 0
        words: NDArray[np.uint64] = self._words[indices, used[indices]]
        used[indices] += 1
        return words

    # -- episodes ------------------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode in every row, or in those of ``options["reset_mask"]``.

        Parameters
        ----------
        seed : int or sequence of B ints (or None), optional
            An int is spread over the rows by ``numpy.random.SeedSequence`` (row ``i`` gets the same
            seed whatever the number of rows, and seeds 0 and 1 have no row in common); a sequence
            seeds each row.
        options : dict, optional
            ``"reset_mask"``: bool, shape (B,). ``"landmarks"`` or ``"problem"``: as in the single
            environment, for all rows alike; or the landmarks of each row as an int array of cells,
            shape (B, K). Other keys are ignored.

        Returns
        -------
        observations : ndarray of float32, shape (B, ...)
            Of all rows.
        infos : dict
            Of the rows that were reset, as ``gymnasium.vector.SyncVectorEnv`` gives them.

        Raises
        ------
        ValueError
            If seed or options cannot be used; nothing has been reset then.
        """
        seeds = self._check_seed(seed)
        mask = self._check_reset_mask(options)
        landmarks, limit = self._check_problems(options)
        indices = np.flatnonzero(mask)
        self._seed_rows(seeds, indices.tolist())
        self._start(indices, landmarks, limit)
        self._started = True
        observations, action_mask = self._observe(self._rows)
        action_mask[~mask] = 0
        return observations, {"action_mask": action_mask, "_action_mask": mask}

    def _start(
        self,
        indices: NDArray[np.int64],
        landmarks: NDArray[np.int32] | None = None,
        limit: int | None = None,
    ) -> None:
        """Start an episode in the rows of ``indices``, on given or else on random landmarks."""
        task = self.task
        if landmarks is None:
            words = self._next_words(indices)
        else:
            words = np.zeros(len(indices), np.uint64)
        reset_rows(
            self._rows, indices, words, task.grid.reachable, task.grid.depot, *self._sizes
        )
        if landmarks is not None:
            self._rows[indices, task.n_agents : task.n_agents + task.n_landmarks] = landmarks[indices]
        if task.needs_fields:
            fill_fields(
                self._rows, indices, task.table, *self._sizes, self._distances, self._queue
            )
        self._limits[indices] = task.max_cycles if limit is None else limit
        self._ended[indices] = False
        if self.render_mode is not None:
            for index in indices:
                self._trails[index] = []
            self._extend_trails(indices)

    def step(
        self, actions: NDArray[np.integer[Any]]
    ) -> tuple[
        NDArray[np.float32],
        NDArray[np.float64],
        NDArray[np.bool_],
        NDArray[np.bool_],
        dict[str, Any],
    ]:
        """Carry out a joint action in every row.

        Parameters
        ----------
        actions : ndarray of int, shape (B, N) or, with ``central_action="joint"``, (B,)
            In next-step mode the actions of the rows that start a new episode are not looked at
            beyond being valid.

        Returns
        -------
        observations, rewards, terminations, truncations, infos
            Shapes (B, ...), (B,), (B,), (B,); infos as ``gymnasium.vector.SyncVectorEnv`` gives
            them: metrics (in same-step mode ``final_obs`` and ``final_info``) of rows that ended.

        Raises
        ------
        ValueError
            If an action is not valid; nothing has moved then.
        gymnasium.error.ResetNeeded
            Before the first reset, or with autoreset disabled if a row has ended.
        """
        if not self._started:
            raise ResetNeeded("step() needs episodes in progress: call reset() first")
        mode = self.autoreset_mode
        if mode == AutoresetMode.DISABLED and self._ended.any():
            raise ResetNeeded(
                f"row {int(np.argmax(self._ended))} has ended: reset it with "
                "reset(options={'reset_mask': mask})"
            )
        joint_actions = self._read_actions(actions)
        waiting = self._ended if mode == AutoresetMode.NEXT_STEP else self._nobody
        rewards = np.empty(self.num_envs)
        terminations = np.empty(self.num_envs, np.bool_)
        truncations = np.empty(self.num_envs, np.bool_)
        task = self.task
        step_rows(
            self._rows,
            joint_actions,
            waiting,
            *self._sizes,
            self._limits,
            int(task.reward_kind),
            task.table,
            self._distances,
            task.first_field,
            rewards,
            terminations,
            truncations,
        )
        if self.render_mode is not None:
            self._extend_trails(np.flatnonzero(~waiting))
        if mode == AutoresetMode.NEXT_STEP:
            self._start(np.flatnonzero(waiting))
        self._ended = terminations | truncations
        ended = np.flatnonzero(self._ended)
        infos: dict[str, Any] = {}
        if len(ended) and mode == AutoresetMode.SAME_STEP:
            self._add_finals(infos, ended)
            self._start(ended)
        elif len(ended):
            self._add_metrics(infos, ended)
        observations, infos["action_mask"] = self._observe(self._rows)
        infos["_action_mask"] = np.ones(self.num_envs, np.bool_)
        return observations, rewards, terminations, truncations, infos

    def _observe(
        self, rows: NDArray[np.int32]
    ) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
        """Return fresh observations and action masks, shapes (B, ...) and (B, N, A)."""
        task = self.task
        n_rows = len(rows)
        out = np.empty((n_rows, self._n_views, task.view.low.size), np.float32)
        masks = np.empty((n_rows, task.n_agents, task.n_actions), np.int8)
        kind = int(task.observation_kind)
        observe_rows(rows, kind, *self._sizes, task.table, self._distances, task.first_field, out)
        action_masks(rows, task.n_agents, task.table, masks)
        return out.reshape(n_rows, *task.central_view.shape), masks

    # -- infos of rows that ended -----------------------------------------------------------------------

    def _add_metrics(self, infos: dict[str, Any], ended: NDArray[np.int64]) -> None:
        """Add the metrics of the rows of ``ended``, in the manner of ``VectorEnv._add_info``."""
        costs = np.empty((len(ended), 3))
        measure_rows(self._rows, ended, *self._sizes, self.task.table, costs)
        columns = {
            "success": np.isfinite(costs[:, 0]),
            "cover_time": costs[:, 0],
            "makespan": costs[:, 1],
            "total_distance": costs[:, 2],
        }
        metrics: dict[str, Any] = {}
        for name, values in columns.items():
            metrics[name] = np.zeros(self.num_envs, values.dtype)
            metrics[name][ended] = values
            metrics[f"_{name}"] = self._flags(ended)
        infos["metrics"] = metrics
        infos["_metrics"] = self._flags(ended)

    def _add_finals(self, infos: dict[str, Any], ended: NDArray[np.int64]) -> None:
        """Add the last observation and info of the rows of ``ended``."""
        if self.task.needs_fields:  # fields are found by a row's place in the whole batch
            observations, masks = (array[ended] for array in self._observe(self._rows))
        else:
            observations, masks = self._observe(self._rows[ended])
        final_obs = np.full(self.num_envs, None, dtype=object)
        for index, observation in zip(ended, observations, strict=True):
            final_obs[index] = observation
        action_mask = np.zeros((self.num_envs, *masks.shape[1:]), np.int8)
        action_mask[ended] = masks
        final_info = {"action_mask": action_mask, "_action_mask": self._flags(ended)}
        self._add_metrics(final_info, ended)
        infos["final_obs"], infos["_final_obs"] = final_obs, self._flags(ended)
        infos["final_info"], infos["_final_info"] = final_info, self._flags(ended)

    def _flags(self, indices: NDArray[np.int64]) -> NDArray[np.bool_]:
        flags = np.zeros(self.num_envs, np.bool_)
        flags[indices] = True
        return flags

    # -- checks ----------------------------------------------------------------------------------------

    def _read_actions(self, actions: Any) -> NDArray[np.int64]:
        """Return each agent's action in each row, shape (B, N)."""
        joint = self._joint_actions is not None
        shape = (self.num_envs,) if joint else (self.num_envs, self.task.n_agents)
        array = np.asarray(actions)
        if array.shape != shape or array.dtype.kind not in "iu":
            raise ValueError(
                f"actions must be integers of shape {shape}, "
                f"got shape {array.shape} and dtype {array.dtype}"
            )
        n_actions = self.task.n_actions if self._joint_actions is None else len(self._joint_actions)
        array = np.ascontiguousarray(array, np.int64)
        bad = find_bad_action(array.reshape(-1), n_actions)
        if bad >= 0:
            place = ", ".join(str(int(index)) for index in np.unravel_index(bad, shape))
            raise ValueError(
                f"actions[{place}] must be in 0..{n_actions - 1}, got {np.asarray(actions).flat[bad]}"
            )
        return array if self._joint_actions is None else self._joint_actions[array]

    def _check_seed(self, seed: object) -> int | list[int | None] | None:
        if seed is None:
            return None
        if as_integer(seed) is not None:
            return check_count("seed", seed, 0, MAX_SEED)
        if not isinstance(seed, Sequence | np.ndarray) or isinstance(seed, str | bytes):
            raise ValueError(f"seed must be an integer, one for each row or None, got {describe(seed)}")
        if len(seed) != self.num_envs:
            raise ValueError(f"seed must hold {self.num_envs} seeds, one a row, got {len(seed)}")
        return [
            None if one is None else check_count(f"seed[{index}]", one, 0, MAX_SEED)
            for index, one in enumerate(seed)
        ]

    def _check_reset_mask(self, options: Mapping[str, Any] | None) -> NDArray[np.bool_]:
        """Return which rows to reset, shape (B,), the caller's array untouched."""
        if options is not None and not isinstance(options, Mapping):
            raise ValueError(f"options must be a dict or None, got {describe(options)}")
        mask = None if options is None else options.get("reset_mask")
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        valid = isinstance(mask, np.ndarray) and mask.dtype == np.bool_
        if not valid or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"options['reset_mask'] must be a bool array of shape ({self.num_envs},) with at "
                f"least one True, got {describe(mask)}"
            )
        return mask.copy()

    def _check_problems(
        self, options: Mapping[str, Any] | None
    ) -> tuple[NDArray[np.int32] | None, int | None]:
        """Return the landmarks that ``options`` ask for, shape (B, K), and the step limit."""
        landmarks = None if options is None else options.get("landmarks")
        if isinstance(landmarks, np.ndarray) and landmarks.ndim == 2:
            shape = (self.num_envs, self.task.n_landmarks)
            if landmarks.shape == shape:
                return self._check_landmarks(landmarks), None
        problem = self.task.check_options(options)
        if problem is None:
            return None, None
        cells = np.array(problem.landmarks, np.int32)
        return np.repeat(cells[None], self.num_envs, axis=0), problem.max_cycles

    def _check_landmarks(self, landmarks: NDArray[Any]) -> NDArray[np.int32]:
        """Return landmarks of each row, shape (B, K), if they satisfy rule R2."""
        grid = self.task.grid
        ok = landmarks.dtype.kind in "iu"
        if ok:
            ordered = np.sort(landmarks, axis=1)
            allowed = np.isin(landmarks, grid.reachable).all(axis=1)
            distinct = (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)
            ok = bool((allowed & distinct).all())
        if not ok:
            # Row by row, for the message that says which cell of which row is wrong and why.
            for index, cells in enumerate(landmarks):
                check_landmarks(grid, cells, name=f"options['landmarks'][{index}]")
        return landmarks.astype(np.int32)

    # -- pictures ----------------------------------------------------------------------------------------

    def _extend_trails(self, indices: NDArray[np.int64]) -> None:
        for index in indices:
            self._trails[index].append(tuple(self._rows[index, : self.task.n_agents].tolist()))

    def render(self) -> tuple[Any, ...] | None:
        """Return a picture of each row: arrays for "rgb_array", strings for "ansi".

        Raises
        ------
        gymnasium.error.ResetNeeded
            Before the first reset.
        """
        if not self._started:
            raise ResetNeeded("render() needs episodes: call reset() first")
        if self.render_mode is None:
            logger.warn("render() shows nothing: make the environment with a render_mode")
            return None
        display = Display(self.render_mode, self.metadata["render_fps"])
        return tuple(
            display.show(
                scene_of(self.task, row, self._trails[index], int(self._limits[index]))
            )
            for index, row in enumerate(self._rows)
        )


def make_vec(num_envs: int, **arguments: Any) -> MappVectorEnv:
    """Return ``num_envs`` problems stepped as one batch, for one meta-agent.

    Parameters
    ----------
    num_envs : int
        Number of rows, 1 to 1,048,576.
    **arguments
        Those of :class:`MappVectorEnv`: the environment's own, ``autoreset_mode`` and
        ``central_action``.

    Raises
    ------
    ValueError
        If an argument is not as said.

    Examples
    --------
    >>> import mapp_env
    >>> envs = mapp_env.make_vec(4096)
    >>> observations, infos = envs.reset(seed=0)
    >>> observations, rewards, terminations, truncations, infos = envs.step(
    ...     envs.action_space.sample()
    ... )
    """
    return MappVectorEnv(num_envs, **arguments)


def make_gymnasium_vec(num_envs: int, **arguments: Any) -> MappVectorEnv:
    """Return what ``gymnasium.make_vec("mapp_env/Central-v0")`` means: the single one's actions."""
    return MappVectorEnv(num_envs, **{"central_action": "auto", **arguments})


def _spread_seed(seed: int | None, count: int) -> list[int]:
    """Return ``count`` independent seeds that depend on ``seed`` and their place alone."""
    words: list[int] = np.random.SeedSequence(seed).generate_state(count, np.uint64).tolist()
    return words


def _find_mode(mode: object) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    names = [each.value for each in AutoresetMode]
    return AutoresetMode(check_choice("autoreset_mode", mode, names))
