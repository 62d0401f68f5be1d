"""What a ``VecEnv`` of Stable-Baselines3 has beside its steps, where rows are no environments."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

__all__ = ["RowsVecEnv", "Stepped"]

Stepped = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]
"""Observations (B, ...), rewards (B,), dones (B,) and B infos."""

MASKS = "action_masks"
"""The one method that can be called by row: sb3-contrib's ``MaskablePPO`` does."""

LIMIT = "max_cycles"
"""The one attribute that can be set."""


class RowsVecEnv(VecEnv):
    """Rows of one batch that has all attributes and methods itself.

    The spaces are those of one row; ``name`` is of the attribute that holds the batch, for
    messages.
    """

    def __init__(self, batch: Any, name: str, observation_space: Any, action_space: Any) -> None:
        self._batch, self._name = batch, name
        self._actions: Any = None
        self._seed: int | None = None  # of the next reset, and its options
        self._next_options: dict[str, Any] | None = None
        self._masks: NDArray[Any] | None = None  # (B, ...), once there are episodes
        super().__init__(batch.num_envs, observation_space, action_space)
        # For recorders of films, which take 30 a second where nothing is said.
        self.metadata = {**self.metadata, "render_fps": batch.metadata["render_fps"]}

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Keep the rows' actions, shape (B, ...), for :meth:`step_wait`."""
        self._actions = actions

    def action_masks(self) -> NDArray[np.bool_]:
        """Return which actions the masks advise, as sb3-contrib's ``MaskablePPO`` asks for it.

        False for a move that bumps an agent, or a landmark that is visited. Of one agent's actions
        (B, A), of numbered joint actions (B, A**N), or of each agent's actions, one agent after the
        other, (B, N * A). Raises a ResetNeeded before the first reset.
        """
        if self._masks is None:
            raise ResetNeeded("action_masks() needs episodes: call reset() first")
        return self._find_masks(self._masks)

    @abstractmethod
    def _find_masks(self, masks: NDArray[Any]) -> NDArray[np.bool_]:
        """Return fresh action masks, shape (B, ...), of what is kept in ``_masks``."""

    @property
    @abstractmethod
    def _limited(self) -> Sequence[Any]:
        """What has a step limit."""

    @property
    def max_cycles(self) -> int:
        """Step at which an episode is truncated (R7); may be assigned, from the next reset on."""
        limit: int = self._limited[0].max_cycles
        return limit

    @max_cycles.setter
    def max_cycles(self, value: int) -> None:
        for one in self._limited:
            one.max_cycles = value

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the batch's attribute, or the spaces of a row, once for each row asked for."""
        rows = list(self._get_indices(indices))
        if attr_name in ("observation_space", "action_space", LIMIT):
            return [getattr(self, attr_name)] * len(rows)  # the batch's are those of all rows
        if attr_name == MASKS:
            return [lambda row=row: self.action_masks()[row] for row in rows]
        return [getattr(self._batch, attr_name)] * len(rows)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set ``max_cycles``, of all rows; refuse all else, as rows have no other attributes.

        Raises a ValueError if it is another attribute, no limit, or of some rows only.
        """
        if attr_name != LIMIT:
            raise ValueError(f"{attr_name} cannot be set: rows of .{self._name} have no attributes")
        if len(set(self._get_indices(indices))) < self.num_envs:
            raise ValueError(f"indices must be all rows, or None, for {LIMIT}; got {indices}")
        self.max_cycles = value

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Return :meth:`action_masks` by row; refuse all else, as rows have no other methods.

        Raises a ValueError if ``method_name`` is not ``"action_masks"``.
        """
        if method_name == MASKS:
            return list(self.action_masks()[list(self._get_indices(indices))])
        raise ValueError(f"{method_name}() cannot be called by row: call it on .{self._name}")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return that no row is wrapped in anything."""
        return [False] * len(list(self._get_indices(indices)))

    def close(self) -> None:
        """Close the batch; may be called again."""
        self._batch.close()
