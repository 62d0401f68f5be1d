"""What a ``VecEnv`` of Stable-Baselines3 has beside its steps, where rows are no environments."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.vec_env import VecEnv

__all__ = ["RowsVecEnv"]


class RowsVecEnv(VecEnv):
    """Rows of one batch that has all attributes and methods itself.

    Parameters
    ----------
    batch : object
        What is stepped: it has ``num_envs`` rows, attributes and ``close()``.
    name : str
        Of the attribute that holds it, for messages.
    observation_space, action_space : gymnasium.Space
        Of one row.
    """

    def __init__(self, batch: Any, name: str, observation_space: Any, action_space: Any) -> None:
        self._batch, self._name = batch, name
        super().__init__(batch.num_envs, observation_space, action_space)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the batch's attribute once for each row asked for."""
        return [getattr(self._batch, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: rows have no attributes of their own.

        Raises
        ------
        ValueError
            Always.
        """
        raise ValueError(f"{attr_name} cannot be set: rows of .{self._name} have no attributes")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refuse: rows have no methods of their own.

        Raises
        ------
        ValueError
            Always.
        """
        raise ValueError(f"{method_name}() cannot be called by row: call it on .{self._name}")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return that no row is wrapped in anything."""
        return [False] * len(list(self._get_indices(indices)))

    def close(self) -> None:
        """Close the batch; may be called again."""
        self._batch.close()
