"""The batched face: B problems at a time through the same kernels, as a Gymnasium ``VectorEnv``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import logger
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mapp_env.engine.loops import find_bad_action
from mapp_env.engine.observation import Observation
from mapp_env.engine.options import (
    BATCH_OPTIONS,
    check_options,
    check_problems,
    check_reset_mask,
    warn_of_unknown,
)
from mapp_env.engine.rows import Rows
from mapp_env.engine.seeds import RowSeeds
from mapp_env.engine.sources import NO_GRIDS, OWN_LIMIT, Source
from mapp_env.engine.task import Task
from mapp_env.envs.arguments import BATCH_RENDER_MODES, AutoresetMode, BatchTask, takes
from mapp_env.envs.central_env import CentralEnv, central_action_space
from mapp_env.envs.vector_infos import Transition, add_joint_masks, make_infos
from mapp_env.problem import MAX_CYCLES, Problem
from mapp_env.rendering.display import Display
from mapp_env.validation import as_array, check_count

MAX_ENVS = 1 << 20


class MappVectorEnv(VectorEnv[NDArray[np.float32], NDArray[np.int64], NDArray[Any]]):
    """Many independent problems stepped at once, for one meta-agent (see ``CentralEnv``).

    Row ``i`` is bit for bit the single environment that is reset with seed ``np_random_seed[i]``.
    Returned arrays can be kept and written to: nothing in the environment changes with them.

    Parameters
    ----------
    num_envs : int
        Number of rows B, 1 to 1,048,576.
    autoreset_mode : gymnasium.vector.AutoresetMode or str
        When a finished row starts its next episode: ``NEXT_STEP`` (Gymnasium's default),
        ``SAME_STEP`` or ``DISABLED``, as a string in this or Gymnasium's spelling (``"NextStep"``),
        with infos where Gymnasium puts them.
    central_action : {"multi", "joint", "auto"}
        Actions of shape (B, N), one per agent, or (B,), numbered joint actions.
    grid, n_agents, n_landmarks, max_cycles, reward, observation, allow_wait, render_mode
    actions, return_home
        As in :class:`mapp_env.envs.parallel_env.MappParallelEnv`.

    Attributes
    ----------
    joint_actions : ndarray of int64, shape (A**N, N), or None
        Each agent's action for each numbered joint action.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """

    @takes(BatchTask)
    def __init__(self, num_envs: int, task: BatchTask) -> None:
        self.num_envs = check_count("num_envs", num_envs, 1, MAX_ENVS)
        self.single_action_space, self.joint_actions = central_action_space(task)
        self._n_joint_actions = 0 if self.joint_actions is None else len(self.joint_actions)
        task.check_memory(self.num_envs, self._n_joint_actions)
        self.task: Task = task
        self.autoreset_mode = AutoresetMode(task.autoreset_mode)
        self.metadata = {
            **CentralEnv.metadata,
            "render_modes": list(BATCH_RENDER_MODES),
            "autoreset_mode": self.autoreset_mode,
        }
        self.render_mode = task.render_mode
        view = task.central_view
        self.single_observation_space = Box(view.low, view.high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

        n_views = 1 if task.observation_kind == Observation.GLOBAL else task.n_agents
        self._source = Source(task)
        self._rows = Rows(task, self.num_envs, n_views)
        self._observations_shape = self.observation_space.shape
        self._seeds = RowSeeds(self.num_envs)
        self._started = False
        self._ended = np.zeros(self.num_envs, np.bool_)  # finished, not yet reset
        self._nobody = np.zeros(self.num_envs, np.bool_)
        self._no_endings = (
            np.empty((0, 3)),
            np.empty((0, *self.single_observation_space.shape), np.float32),
            np.empty((0, task.n_agents, task.n_actions), np.int8),
        )

    @property
    def max_cycles(self) -> int:
        """Step at which an episode is truncated (R7); may be assigned, from the next reset on."""
        return self._rows.max_cycles

    @max_cycles.setter
    def max_cycles(self, value: int) -> None:
        self._rows.max_cycles = check_count("max_cycles", value, 1, MAX_CYCLES)

    def state(self) -> NDArray[np.float32]:
        """Return each row's global observation (R9), shape (B, N + 2K), whatever agents see.

        It is for central critics. In same-step mode rows that ended have begun their next episode.
        Raises a ResetNeeded before the first reset.
        """
        if not self._started:
            raise ResetNeeded("state() needs episodes: call reset() first")
        return self._rows.state.head.astype(np.float32)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each row; a single environment reset with it is that row."""
        self._seeds.seed(None, [])
        return tuple(self._seeds.seeds)

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generator of each row; up to 64 words of it may have been fetched ahead."""
        self._seeds.seed(None, [])
        return tuple(self._seeds.generators)

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
            An int is spread over the rows, see :meth:`mapp_env.engine.seeds.RowSeeds.seed`; a
            sequence seeds each row, but those of ``None``.
        options : dict, optional
            ``"reset_mask"``: bool, shape (B,). ``"landmarks"``, ``"grid"`` or ``"problem"``: as in
            the single environment, for all rows alike; or for each row: an int array of landmarks'
            cells, shape (B, K), or of (row, col) pairs, shape (B, K, 2); the numbers of grids,
            shape (B,); a sequence of B problems. Other keys are ignored, with a warning.

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
        seeds = self._seeds.check(seed)
        mask = check_reset_mask(options, self.num_envs)
        if not self._started and not mask.all():
            raise ValueError("options['reset_mask'] must be all True in the first reset")
        asked = check_problems(self._source, self.task, options, self.num_envs)
        warn_of_unknown(options, BATCH_OPTIONS)
        indices = np.flatnonzero(mask)
        self._seeds.seed(seeds, indices.tolist())
        if asked.problems is not None:
            self._rows.start(indices, asked.problems.take(indices))
        else:
            self._draw(indices, asked.grids[indices] if len(asked.grids) else NO_GRIDS)
        self._ended[indices] = False
        self._started = True
        views, action_mask = self._rows.observe()
        action_mask[~mask] = 0
        infos = {"action_mask": action_mask, "_action_mask": mask}
        if self._n_joint_actions:
            add_joint_masks(infos, self._n_joint_actions)
        if self.task.is_pool:
            infos["grid"], infos["_grid"] = np.where(mask, self._rows.grids, 0), mask.copy()
        return views.reshape(self._observations_shape), infos

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
        transition = self.advance(actions)
        return (*transition[:4], make_infos(transition, self._n_joint_actions))

    def advance(self, actions: NDArray[np.integer[Any]]) -> Transition:
        """Do what :meth:`step` does, but for the infos: adapters give theirs in another form.

        Raises
        ------
        ValueError, gymnasium.error.ResetNeeded
            As :meth:`step` does.
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
        skip = self._nobody
        if mode == AutoresetMode.NEXT_STEP:
            skip = self._ended
            starting = np.flatnonzero(skip)
            if len(starting):
                self._draw(starting)
        rewards, terminations, truncations, views, masks = self._rows.step(joint_actions, skip)
        observations = views.reshape(self._observations_shape)
        self._ended = terminations | truncations
        ended = np.flatnonzero(self._ended)
        restarted = mode == AutoresetMode.SAME_STEP
        # With few rows most steps end none, and looking for them takes longest.
        endings = self._no_endings
        grids = self._rows.grids if self.task.is_pool else None
        if len(ended):
            last = observations.take(ended, axis=0), masks.take(ended, axis=0)
            endings = (self._rows.measure(ended), *last)
            if restarted:
                self._draw(ended)
                self._rows.observe_again(ended, views, masks)
        found = observations, rewards, terminations, truncations, masks, self._ended.copy(), ended
        played = grids, self._rows.grids if restarted and self.task.is_pool else grids
        return Transition(*found, *endings, restarted, *played)

    def find_problem(self, options: Mapping[str, Any]) -> Problem | None:
        """Return the problem that options of a single environment fix, or ``None``.

        Raises
        ------
        ValueError
            If the options cannot be used.
        """
        problems = check_options(self._source, self.task, options).problems
        if problems is None:
            return None
        limit = int(problems.limits[0])
        return Problem(
            self.task.grids[problems.grids[0]],
            tuple(problems.landmarks[0].tolist()),
            self.task.n_agents,
            None if limit == OWN_LIMIT else limit,
            tuple(problems.cells[0].tolist()),
        )

    def _draw(self, indices: NDArray[np.int64], grids: NDArray[np.int64] = NO_GRIDS) -> None:
        """Start an episode on a random problem in some rows, (M,), on given grids or any."""
        self._rows.start(indices, self._source.draw(self._seeds.next_words(indices), grids))

    def _read_actions(self, actions: Any) -> NDArray[np.int64]:
        """Return each agent's action in each row, shape (B, N)."""
        joint = self.joint_actions is not None
        shape = (self.num_envs,) if joint else (self.num_envs, self.task.n_agents)
        array = as_array(actions)
        if array.shape != shape or array.dtype.kind not in "iu":
            raise ValueError(
                f"actions must be integers of shape {shape}, "
                f"got shape {array.shape} and dtype {array.dtype}"
            )
        array = np.ascontiguousarray(array, np.int64)
        if self.joint_actions is None:
            n_actions, bad = self.task.n_actions, self._rows.find_bad_action(array)
        else:
            n_actions = len(self.joint_actions)
            bad = find_bad_action(array.view(np.uint64), n_actions)
        if bad >= 0:
            place = ", ".join(str(int(index)) for index in np.unravel_index(bad, shape))
            raise ValueError(
                f"actions[{place}] must be in 0..{n_actions - 1}, "
                f"got {np.asarray(actions).flat[bad]}"
            )
        return array if self.joint_actions is None else self.joint_actions[array]

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
        return tuple(display.show(self._rows.scene(index)) for index in range(self.num_envs))


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
        If an argument is invalid.

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


def make_gymnasium_vec(
    num_envs: int, max_episode_steps: int | None = None, **arguments: Any
) -> MappVectorEnv:
    """Return what ``gymnasium.make_vec("mapp_env/Central-v0")`` means: the single one's actions.

    Arguments are those of :class:`MappVectorEnv`, but that ``central_action`` is ``"auto"`` by
    default. At ``max_episode_steps``, unless None or -1, every episode is truncated that goes on so
    long, as Gymnasium's ``TimeLimit`` does it. Such an episode has metrics like any other, and one
    that is solved at that very step is terminated only (R7).

    Raises a ValueError if an argument is invalid.
    """
    envs = MappVectorEnv(num_envs, **{"central_action": "auto", **arguments})
    if max_episode_steps not in (None, -1):
        name = "max_episode_steps"
        envs._rows.longest = check_count(name, max_episode_steps, 1, np.iinfo(np.int64).max)
    return envs
