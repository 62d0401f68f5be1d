"""Shows scenes in one render mode; `rendering` is imported when the first is shown."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.scene import Scene

if TYPE_CHECKING:
    from mapp_env.rendering.human import Window


class Display:
    """The implementation of ``render()`` for every interface.

    ``mode`` is "human", "rgb_array", "ansi" or None; ``fps`` are pictures a second in the window.
    """

    def __init__(self, mode: str | None, fps: int) -> None:
        self.mode = mode
        self.fps = fps
        self._window: Window | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Copy all but the window: a copy opens its own when it has something to show."""
        return {**self.__dict__, "_window": None}

    def show(self, scene: Scene) -> NDArray[np.uint8] | str | None:
        """Return the picture, or show it in the window and return ``None``."""
        if self.mode is None:
            return None
        if self.mode == "ansi":
            from mapp_env.rendering.ansi import ansi

            return ansi(scene)
        from mapp_env.rendering.rgb_array import rgb_array

        frame = rgb_array(scene)
        if self.mode == "rgb_array":
            return frame
        if self._window is None:
            from mapp_env.rendering.human import Window

            self._window = Window()
        self._window.show(frame, self.fps)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None
