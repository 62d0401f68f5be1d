"""A callback of Stable-Baselines3 that keeps the returns of episodes and minds the clock."""

from __future__ import annotations

import time

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

__all__ = ["EpisodeReturns"]


class EpisodeReturns(BaseCallback):
    """Keep every episode's return, and stop each call of ``learn`` after some CPU seconds.

    Parameters
    ----------
    seconds : float
        CPU seconds of this process after which to stop, from the first step on: what a busy
        machine takes away does not count, nor what is compiled once. The update that would follow
        is left out.

    Attributes
    ----------
    returns : list of float
        Undiscounted return of each row's episodes, in the order in which they ended. Rows need
        ``infos[i]["episode"]``: ``make_sb3_vec`` has it, others get it from ``Monitor`` or
        ``VecMonitor``.
    elapsed : float
        CPU seconds since the first step of the last call.
    """

    def __init__(self, seconds: float = float("inf")) -> None:
        super().__init__()
        self.seconds = seconds
        self.returns: list[float] = []
        self.elapsed = 0.0
        self._started: float | None = None

    def _on_training_start(self) -> None:
        self._started = None

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        for index in np.flatnonzero(self.locals["dones"]).tolist():
            self.returns.append(float(infos[index]["episode"]["r"]))
        if self._started is None:
            self._started = time.process_time()
        self.elapsed = time.process_time() - self._started
        return self.elapsed < self.seconds
