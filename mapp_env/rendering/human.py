"""A window that shows frames on the screen, with pygame-ce."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

_PROMPT = "PYGAME_HIDE_SUPPORT_PROMPT"
_had_prompt = os.environ.get(_PROMPT)
os.environ[_PROMPT] = "1"  # a library does not greet on the standard output
try:
    import pygame

    if not hasattr(pygame, "Window"):
        raise ImportError(f"{pygame.__name__} {pygame.version.ver} has no Window")
except ImportError as error:
    raise ImportError(
        'render_mode="human" needs pygame-ce 2.5 or later: pip install "pygame-ce>=2.5"'
    ) from error
finally:
    if _had_prompt is None:
        del os.environ[_PROMPT]
    else:
        os.environ[_PROMPT] = _had_prompt


class Window:
    """A window that shows frames at a steady pace.

    It opens with the first frame. Once the user has closed it, further frames are ignored and the
    program goes on. Several windows may be open at once. Only pygame's display is initialised, and
    the last window to close gives it up, unless it was running before the first one opened. Key
    presses are left in the queue for a program that wants to steer by them.

    Parameters
    ----------
    title : str, default "mapp_env"
        Shown by the window manager.
    """

    def __init__(self, title: str = "mapp_env") -> None:
        self._title = title
        self._window: pygame.Window | None = None
        self._clock = pygame.time.Clock()
        self._closed = False

    def show(self, frame: NDArray[np.uint8], fps: int) -> None:
        """Show a frame, wait until the next one is due, and answer the user's events.

        The window takes the size of ``frame``, shape (height, width, 3) uint8; with 0 frames a
        second it does not wait.

        Raises
        ------
        ValueError
            If ``frame`` is not a picture.
        """
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise ValueError(
                "frame must be a uint8 array of shape (height, width, 3), "
                f"got shape {frame.shape} and dtype {frame.dtype}"
            )
        if self._window is not None and not pygame.display.get_init():
            self.close()  # somebody else has ended the display, and the window with it
        if self._closed:
            return
        size = (frame.shape[1], frame.shape[0])
        if self._window is None:
            self._window = _open(self, self._title, size)
        elif self._window.size != size:
            self._window.size = size
        picture = pygame.image.frombuffer(frame.tobytes(), size, "RGB")
        self._window.get_surface().blit(picture, (0, 0))
        self._window.flip()
        self._clock.tick(fps)
        _answer_events()

    def close(self) -> None:
        """Close the window for good; closing it again does nothing."""
        self._closed = True
        if self._window is not None:
            window, self._window = self._window, None
            _close(self, window)


# The display and the event queue are the process's, so all windows share this record of who is
# open, and whether the display was running before, for somebody else.
_open_windows: list[Window] = []
_display_was_running = False


def _open(owner: Window, title: str, size: tuple[int, int]) -> pygame.Window:
    global _display_was_running
    if not _open_windows:
        _display_was_running = pygame.display.get_init()
    pygame.display.init()
    try:
        window = pygame.Window(title, size)
    except pygame.error:
        _release_display()
        raise
    _open_windows.append(owner)
    return window


def _close(owner: Window, window: pygame.Window) -> None:
    _open_windows.remove(owner)
    if pygame.display.get_init():
        window.destroy()
        _release_display()


def _release_display() -> None:
    if not _open_windows and not _display_was_running:
        pygame.display.quit()


def _answer_events() -> None:
    """Take the user's events, which also keeps the windows responsive; close what is to close."""
    for event in pygame.event.get(exclude=(pygame.KEYDOWN, pygame.KEYUP)):
        if event.type == pygame.QUIT:
            closing = list(_open_windows)
        elif event.type == pygame.WINDOWCLOSE:
            closing = [owner for owner in _open_windows if owner._window is event.window]
        else:
            continue
        for owner in closing:
            owner.close()
