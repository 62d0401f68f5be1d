"""Episodes as animated GIFs, with Pillow: a palette for all frames, and only what changes."""

from __future__ import annotations

import io
import os
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapp_env.engine.scene import Scene
from mapp_env.engine.simulation import Simulation
from mapp_env.engine.task import Task
from mapp_env.files import check_writable, write_bytes
from mapp_env.plans.plan import replay
from mapp_env.problem import Problem
from mapp_env.rendering.rgb_array import Frame, rgb_array
from mapp_env.validation import as_array, check_count, check_flag, check_number, describe

MAX_FRAMES = 2_000
MAX_PIXELS = 1 << 28  # of all frames together: 960 of the default grid; they are kept in memory
MAX_BYTES = 1 << 28
MAX_SECONDS = 600
PALETTE = 255  # one less than a GIF may have: Pillow takes one for "as before"
FREQUENT = 128  # colours of the palette that are there for being frequent


def save_animation(
    path: str | os.PathLike[str],
    problem: Problem,
    joint_actions: ArrayLike,
    fps: float = 4,
    hold: float = 2.0,
    loop: bool = True,
    max_side: int = 640,
    regrets: ArrayLike | None = None,
) -> int:
    """Play joint actions by the rules and write the episode as an animated GIF.

    A frame for the reset and one for each step, as ``render_mode="rgb_array"`` draws them, with the
    counters of steps and visited landmarks. As in the environment the episode ends when every
    landmark is visited or at the problem's step limit, if it has one.

    Parameters
    ----------
    path : str or os.PathLike
        The file; replaced if it is there.
    problem : Problem
        What is played.
    joint_actions : array_like of int, shape (T, N)
        As :func:`~mapp_env.replay` takes them; ``plan.joint_actions()`` gives a plan's.
    fps : float
        Frames a second, 0.1 to 50.
    hold : float
        Seconds that the last frame stays, 0 to 600.
    loop : bool
        Whether it starts again at the end.
    max_side : int
        Pixels that the longer side of the grid may take, 16 to 1024 (the environment's own); cells
        are made smaller for it, but not larger than 72 pixels.
    regrets : array_like of int, shape (T,), optional
        Steps lost by each joint action, as :func:`~mapp_env.solvers.regrets` gives them: the moves
        of those that lost some are marked, and the sum is shown.

    Returns
    -------
    int
        Size of the file in bytes.

    Raises
    ------
    ValueError
        If an argument is invalid, the animation would have more than 2,000 frames or 2**28
        pixels, or the file cannot be written; nothing is written then.
    """
    side = check_count("max_side", max_side, 16, 1024)
    actions = replay(problem, joint_actions).actions
    lost = None if regrets is None else check_regrets(regrets, len(actions))
    frames = (rgb_array(scene, side) for scene in scenes(problem, actions, lost))
    return _save(path, frames, fps, hold, loop, len(actions) + 1)


def save_gif(
    path: str | os.PathLike[str],
    frames: Iterable[Frame],
    fps: float = 4,
    hold: float = 2.0,
    loop: bool = True,
) -> int:
    """Write frames, as ``env.render()`` returns them, as an animated GIF.

    Parameters
    ----------
    path : str or os.PathLike
        The file; replaced if it is there.
    frames : iterable of ndarray of uint8, shape (height, width, 3)
        At least one, all of one size; they may be made while they are taken. A frame that equals
        the one before prolongs it. Of more than 255 colours in all, those that are rare become the
        most similar ones.
    fps, hold, loop
        As in :func:`save_animation`.

    Returns
    -------
    int
        Size of the file in bytes.

    Raises
    ------
    ValueError
        If an argument is invalid, there are more than 2,000 frames or 2**28 pixels, or the file
        cannot be written; nothing is written then.
    """
    return _save(path, frames, fps, hold, loop, None)


def _save(
    path: str | os.PathLike[str],
    frames: Iterable[Frame],
    fps: float,
    hold: float,
    loop: bool,
    n_frames: int | None,
) -> int:
    """Write frames, whose number is known or not."""
    check_writable(path)
    # A GIF counts in hundredths of a second; viewers take less than two for ten.
    tick = max(round(100 / check_number("fps", fps, 0.1, 50)), 2) * 10
    pause = round(100 * check_number("hold", hold, 0, MAX_SECONDS)) * 10
    data = _encode(_checked(frames, n_frames), tick, tick + pause, check_flag("loop", loop))
    write_bytes(path, data, MAX_BYTES)
    return len(data)


def check_regrets(regrets: object, n_steps: int) -> tuple[int, ...]:
    """Return the regret of each step; raise a ValueError if they are not so many whole numbers."""
    array = as_array(regrets)
    if array.shape != (n_steps,) or array.dtype.kind not in "iu":
        raise ValueError(
            f"regrets must be integers, one for each of {n_steps} steps, got {describe(regrets)}"
        )
    return tuple(array.tolist())


def scenes(
    problem: Problem, actions: tuple[tuple[int, ...], ...], lost: tuple[int, ...] | None = None
) -> Iterator[Scene]:
    """Yield what the environment would show of an episode, and of the regrets of its steps."""
    limit = problem.max_cycles if problem.max_cycles is not None else max(len(actions), 1)
    task = Task(
        problem.grid,
        problem.n_agents,
        len(problem.landmarks),
        limit,
        reward="step",  # nobody sees it, and it needs no table
        allow_wait=True,
        render_mode="rgb_array",
    )
    simulation = Simulation(task, 1)
    asked = simulation.check_options({"problem": problem})
    simulation.reset(asked, np.random.default_rng(0))
    for step in range(len(actions) + 1):
        if step > 0:
            simulation.step(np.array(actions[step - 1], np.int64))
        yield replace(simulation.scene(), lost=None if lost is None else lost[:step])


def _checked(frames: Iterable[Frame], n_frames: int | None) -> Iterator[Frame]:
    """Yield frames after a look at each; refuse too many as soon as it is known."""
    try:
        source = iter(frames)
    except TypeError:
        raise ValueError(f"frames must be an iterable, got {describe(frames)}") from None
    shape = None
    for index, frame in enumerate(source):
        picture = isinstance(frame, np.ndarray) and frame.dtype == np.uint8 and frame.ndim == 3
        if not picture or frame.shape[2] != 3 or frame.size == 0 or max(frame.shape) > 65535:
            raise ValueError(
                f"frames[{index}] must be a uint8 array of shape (height, width, 3), "
                f"got {describe(frame)}"
            )
        shape = shape or frame.shape
        if frame.shape != shape:
            raise ValueError(
                f"frames[{index}] must have the shape of the first, {shape}, got {frame.shape}"
            )
        pixels = shape[0] * shape[1]
        allowed = min(MAX_FRAMES, MAX_PIXELS // pixels)
        if max(index + 1, n_frames or 0) > allowed:
            raise ValueError(
                f"an animation of {shape[1]} x {shape[0]} pixels may have {allowed} frames, "
                f"got {n_frames or 'more'}"
            )
        yield frame
    if shape is None:
        raise ValueError("frames must hold at least one frame, got none")


# -- writing -------------------------------------------------------------------


def _encode(frames: Iterator[Frame], tick: int, last: int, loop: bool) -> bytes:
    """Return frames as a GIF; times are in milliseconds."""
    from PIL import Image

    colours = _Colours()
    shape: tuple[int, ...] = ()
    kept: list[bytes] = []
    durations: list[int] = []
    for frame in frames:
        shape = frame.shape[:2]
        # Flat pictures: a hundredth of their size.
        packed = zlib.compress(colours.index(frame).tobytes(), 1)
        if kept and packed == kept[-1]:
            durations[-1] += tick
        else:
            kept.append(packed)
            durations.append(tick)
    durations[-1] += last - tick
    palette, places = colours.reduce()

    def pictures() -> Iterator[Image.Image]:
        for packed in kept:
            index = np.frombuffer(zlib.decompress(packed), np.int32).reshape(shape)
            picture = Image.fromarray(places[index])
            picture.putpalette(palette.tobytes())
            yield picture

    source = pictures()
    first = next(source)
    options: dict[str, Any] = {"loop": 0} if loop else {}
    buffer = io.BytesIO()
    first.save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=source,
        duration=durations,
        disposal=1,
        palette=palette.tobytes(),  # one for all frames
        transparency=len(palette),
        optimize=True,  # writes what changes alone
        **options,
    )
    return buffer.getvalue()


class _Colours:
    """The colours of all frames, numbered as they come."""

    def __init__(self) -> None:
        self._numbers = np.full(1 << 24, -1, np.int32)  # of each colour
        self._found: list[NDArray[np.int32]] = []  # packed colours, in order of their numbers
        self._counts = np.zeros(0, np.int64)

    def index(self, frame: Frame) -> NDArray[np.int32]:
        """Return the number of each pixel's colour."""
        parts = frame.astype(np.int32)
        packed = parts[..., 0] << 16 | parts[..., 1] << 8 | parts[..., 2]
        numbers: NDArray[np.int32] = self._numbers[packed]
        unknown = numbers < 0
        if unknown.any():
            new = np.unique(packed[unknown]).astype(np.int32)
            size = len(self._counts)
            self._numbers[new] = np.arange(size, size + len(new), dtype=np.int32)
            self._found.append(new)
            numbers = self._numbers[packed]
        counts = np.bincount(numbers.ravel(), minlength=len(self._counts))
        counts[: len(self._counts)] += self._counts
        self._counts = counts
        return numbers

    def reduce(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return a palette, shape (P, 3), and for each number its place there.

        The most frequent colours are kept as they are; then, again and again, the one that is most
        unlike all that are kept, so that no colour is far from what it becomes.
        """
        packed = np.concatenate(self._found)
        colours = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], axis=1)
        n_colours = len(colours)
        if n_colours <= PALETTE:
            return colours.astype(np.uint8), np.arange(n_colours, dtype=np.uint8)
        chosen = np.argsort(-self._counts, kind="stable")[:FREQUENT].tolist()
        places = np.zeros(n_colours, np.uint8)
        apart = np.full(n_colours, np.iinfo(np.int32).max, np.int32)
        for place in range(PALETTE):
            if place == len(chosen):
                chosen.append(int(np.argmax(apart)))
            distance = ((colours - colours[chosen[place]]) ** 2).sum(axis=1, dtype=np.int32)
            nearer = distance < apart
            places[nearer] = place
            apart[nearer] = distance[nearer]
        return colours[chosen].astype(np.uint8), places
