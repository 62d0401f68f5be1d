"""Animations: the frames of the environment, in a file that says how long each is shown."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageSequence

import mapp_env
from mapp_env import mapp_v0
from mapp_env.rendering import animation, save_animation, save_gif

GRID = mapp_env.make_grid()
PROBLEM = mapp_env.Problem(GRID, (0, 6, 20, 42, 48), 3, max_cycles=50)


def read(path: Path) -> tuple[list[np.ndarray], list[int], Any]:
    """Return a GIF's frames as people see them, their times in milliseconds, and the file."""
    with Image.open(path) as image:
        assert image.format == "GIF"
        frames, times = [], []
        for frame in ImageSequence.Iterator(image):
            frames.append(np.array(frame.convert("RGB")))
            times.append(frame.info["duration"])
        return frames, times, dict(image.info)


def env_frames(problem: mapp_env.Problem, joint_actions: np.ndarray) -> list[np.ndarray]:
    """Return what the environment renders along joint actions."""
    env = mapp_v0.parallel_env(
        grid=problem.grid,
        n_agents=problem.n_agents,
        n_landmarks=len(problem.landmarks),
        allow_wait=True,
        render_mode="rgb_array",
    )
    env.reset(options={"problem": problem})
    frames = [env.render()]
    for joint_action in joint_actions.tolist():
        if env.agents:
            env.step(dict(zip(env.agents, joint_action, strict=True)))
            frames.append(env.render())
    env.close()
    return frames


def random_actions(n_steps: int, n_agents: int, seed: int = 0) -> np.ndarray:
    """Return joint actions with bumps and waits."""
    return np.random.default_rng(seed).integers(0, 5, (n_steps, n_agents))


def noise(n_frames: int, height: int = 8, width: int = 12) -> list[np.ndarray]:
    """Return frames of random pixels: far more colours than a GIF may have."""
    rng = np.random.default_rng(0)
    return list(rng.integers(0, 256, (n_frames, height, width, 3), np.uint8))


# -- what is shown -----------------------------------------------------------------------------


def test_an_optimum_is_played_to_its_end(tmp_path: Path) -> None:
    """A plan of T steps has T + 1 frames, and nothing but what the environment renders."""
    plan = mapp_env.solve(PROBLEM)
    save_animation(tmp_path / "a.gif", PROBLEM, plan.joint_actions())
    frames, _, _ = read(tmp_path / "a.gif")
    expected = env_frames(PROBLEM, plan.joint_actions())
    assert len(frames) == len(expected) == plan.cover_time + 1
    for frame, truth in zip(frames, expected, strict=True):
        difference = np.abs(frame.astype(int) - truth)
        assert difference.max() <= 24  # one of 255 colours for about 1,300, so near none differs
        assert difference.mean() < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_random_play_on_a_large_grid_is_the_environments(tmp_path: Path, seed: int) -> None:
    """At the environment's own size, a generated grid with many agents has its frames too."""
    grid = mapp_env.make_grid("rooms", rows=24, cols=40, seed=seed)
    problem = mapp_env.Problem(grid, grid.reachable[[0, 40, 90]].tolist(), 5, max_cycles=12)
    actions = random_actions(20, 5, seed)
    save_animation(tmp_path / "a.gif", problem, actions, max_side=1024)
    frames, _, _ = read(tmp_path / "a.gif")
    expected = env_frames(problem, actions)
    assert len(frames) == len(expected) == 13  # truncated, though there are more actions
    for frame, truth in zip(frames, expected, strict=True):
        assert np.abs(frame.astype(int) - truth).max() <= 24


def test_no_actions_are_a_picture_of_the_reset(tmp_path: Path) -> None:
    """Without a joint action the only frame is that of the reset."""
    save_animation(tmp_path / "a.gif", PROBLEM, [])
    frames, _, _ = read(tmp_path / "a.gif")
    assert len(frames) == 1


@pytest.mark.parametrize(("side", "most"), [(16, 512), (64, 512), (640, 650)])
def test_cells_are_scaled_down(tmp_path: Path, side: int, most: int) -> None:
    """The grid takes at most the pixels it may, or one a cell; the bar has room in any case."""
    grid = mapp_env.Grid(np.zeros((256, 256), bool))
    problem = mapp_env.Problem(grid, (0, 1), 2)
    save_animation(tmp_path / "a.gif", problem, random_actions(2, 2), max_side=side)
    frames, _, _ = read(tmp_path / "a.gif")
    height, width, _ = frames[0].shape
    assert max(256, side - 256) <= width <= most
    assert height <= most + 40


def test_large_maps_are_animated(tmp_path: Path) -> None:
    """On 2048 x 2048 cells a picture is as large as asked for, and a hundred steps have room."""
    grid = mapp_env.Grid(np.zeros((2048, 2048), bool))
    problem = mapp_env.Problem(grid, (grid.depot + 40, 0), 1)
    save_animation(tmp_path / "a.gif", problem, [[1]] * 100, max_side=256)
    frames, _, _ = read(tmp_path / "a.gif")
    assert max(frames[0].shape) <= 256 + 40
    assert len(frames) == 101


@pytest.mark.parametrize("n_colours", [1, 2, 3, 254, 255])
def test_up_to_255_colours_are_exact(tmp_path: Path, n_colours: int) -> None:
    """Frames of few colours come back to the bit, whatever changes from one to the next."""
    rng = np.random.default_rng(n_colours)
    colours = rng.permutation(1 << 12)[:n_colours]
    table = np.stack([colours >> 8 << 4, (colours >> 4 & 15) << 4, (colours & 15) << 4], 1)
    numbers = rng.integers(0, n_colours, (5, 31, 17))
    numbers[:, 0, 0] = np.arange(5) % n_colours
    frames = [table[number].astype(np.uint8) for number in numbers]
    save_gif(tmp_path / "a.gif", frames)
    seen, _, _ = read(tmp_path / "a.gif")
    unlike = [frames[0], *(b for a, b in itertools.pairwise(frames) if (a != b).any())]
    assert len(seen) == len(unlike)
    assert all(np.array_equal(a, b) for a, b in zip(seen, unlike, strict=True))


def test_a_rare_colour_is_not_lost(tmp_path: Path) -> None:
    """One red pixel stays red among a thousand shades of grey-blue that are more frequent."""
    shades = np.zeros((64, 64, 3), np.uint8)
    shades[..., 1] = np.arange(64) * 2
    shades[..., 2] = np.arange(64)[:, None] * 2
    shades[0, 0] = (255, 0, 0)
    save_gif(tmp_path / "a.gif", [shades])
    (frame,), _, _ = read(tmp_path / "a.gif")
    assert frame[0, 0].tolist() == [255, 0, 0]
    assert np.abs(frame.astype(int) - shades).max() <= 12


def test_any_picture_is_written(tmp_path: Path) -> None:
    """Frames with more colours than fit are written as well, near to what they were."""
    frames = noise(3)
    save_gif(tmp_path / "a.gif", frames)
    seen, _, _ = read(tmp_path / "a.gif")
    assert len(seen) == 3
    assert np.abs(np.array(seen, int) - frames).mean() < 32


# -- how long ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("fps", "tick"), [(4, 250), (5, 200), (30, 30), (50, 20), (0.5, 2000)])
def test_times_are_those_asked_for(tmp_path: Path, fps: float, tick: int) -> None:
    """Each frame is shown for 1 / fps, to a hundredth of a second, and the last is held."""
    save_gif(tmp_path / "a.gif", noise(4), fps=fps, hold=1.5)
    _, times, _ = read(tmp_path / "a.gif")
    assert times == [tick, tick, tick, tick + 1500]


def test_a_frame_that_equals_the_last_prolongs_it(tmp_path: Path) -> None:
    """A standstill takes its time, though it is one frame of the file."""
    first, second = noise(2)
    save_gif(tmp_path / "a.gif", [first, first, second, second, second], fps=10, hold=0)
    frames, times, _ = read(tmp_path / "a.gif")
    assert len(frames) == 2
    assert times == [200, 300]


def test_it_loops_if_it_should(tmp_path: Path) -> None:
    """An animation starts again for ever by default, and never with loop=False."""
    save_gif(tmp_path / "ever.gif", noise(2))
    save_gif(tmp_path / "once.gif", noise(2), loop=False)
    assert read(tmp_path / "ever.gif")[2]["loop"] == 0
    assert "loop" not in read(tmp_path / "once.gif")[2]


# -- the file ----------------------------------------------------------------------------------


def test_size_is_told_and_small(tmp_path: Path) -> None:
    """The size returned is the file's, and an optimum's animation stays below 100 kB."""
    plan = mapp_env.solve(PROBLEM)
    size = save_animation(tmp_path / "a.gif", PROBLEM, plan.joint_actions())
    assert size == (tmp_path / "a.gif").stat().st_size < 100_000


def test_same_actions_same_bytes(tmp_path: Path) -> None:
    """The same episode gives the same file."""
    for name in ("a.gif", "b.gif"):
        save_animation(tmp_path / name, PROBLEM, random_actions(5, 3))
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()


def test_a_failure_leaves_the_earlier_file(tmp_path: Path) -> None:
    """What stops half-way through the frames leaves the file as it was, and nothing beside it."""
    target = tmp_path / "a.gif"
    target.write_bytes(b"earlier")

    def broken() -> Iterator[np.ndarray]:
        yield from noise(3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save_gif(target, broken())
    assert target.read_bytes() == b"earlier"
    assert list(tmp_path.iterdir()) == [target]


# -- refusals ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ([], "at least one"),
        (3, "frames must be an iterable, got 3"),
        ([None], r"frames\[0\] must be a uint8 array of shape .* got None"),
        (["frame"], r"frames\[0\] must be a uint8 array"),
        ([np.zeros((4, 4, 3))], r"frames\[0\] must be a uint8 array"),
        ([np.zeros((4, 4), np.uint8)], r"frames\[0\] must be a uint8 array"),
        ([np.zeros((4, 4, 4), np.uint8)], r"frames\[0\] must be a uint8 array"),
        ([np.zeros((0, 4, 3), np.uint8)], r"frames\[0\] must be a uint8 array"),
        ([*noise(1), None], r"frames\[1\] must be a uint8 array"),
        ([*noise(1), *noise(1, 9)], r"frames\[1\] must have the shape of the first"),
        (itertools.repeat(np.zeros((2, 2, 3), np.uint8)), "may have 2000 frames"),
        (
            [np.broadcast_to(np.uint8(0), (1 << 15, 1 << 14, 3))],
            "16384 x 32768 pixels may have 0 frames",
        ),
    ],
)
def test_wrong_frames_are_refused(tmp_path: Path, frames: Any, words: str) -> None:
    """What is no picture, of another size or too much is a ValueError that says which."""
    with pytest.raises(ValueError, match=words):
        save_gif(tmp_path / "a.gif", frames)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "options",
    [
        {"fps": 0},
        {"fps": 51},
        {"fps": float("nan")},
        {"fps": "4"},
        {"fps": True},
        {"hold": -1},
        {"hold": float("inf")},
        {"loop": 1},
        {"max_side": 15},
        {"max_side": 1025},
        {"max_side": 64.0},
        {"joint_actions": [[0, 1]]},
        {"joint_actions": [[0, 1, 5]]},
        {"problem": None},
        {"path": 7},
        {"path": "no/such/folder/a.gif"},
        {"path": "."},
        {"path": "a\0.gif"},
    ],
    ids=str,
)
def test_wrong_arguments_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any]
) -> None:
    """Every argument out of its range is a ValueError that names it, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    given = {"path": "a.gif", "problem": PROBLEM, "joint_actions": [[0, 1, 2]], **options}
    name = next(iter(options))
    with pytest.raises(ValueError, match="written|regular|path" if name == "path" else name):
        save_animation(**given)
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_is_refused_before_any_frame_is_made(tmp_path: Path) -> None:
    """A slip in the path costs no episode: frames are not even asked for."""
    frames = iter(noise(2))
    with pytest.raises(ValueError, match="cannot be written"):
        save_gif(tmp_path / "no" / "a.gif", frames)
    assert len(list(frames)) == 2


def test_too_long_an_episode_is_refused_at_its_first_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The number of frames is known from the plan, so that none is drawn in vain."""
    drawn = []
    real = animation.rgb_array
    monkeypatch.setattr(animation, "rgb_array", lambda *args: drawn.append(1) or real(*args))
    actions = np.full((2000, 3), 4)
    problem = mapp_env.Problem(GRID, (0,), 3)
    with pytest.raises(ValueError, match="got 2001"):
        save_animation(tmp_path / "a.gif", problem, actions, max_side=16)
    assert len(drawn) == 1


def test_two_thousand_frames_are_allowed(tmp_path: Path) -> None:
    """The largest number of frames is written, one more is not."""
    frames = np.zeros((2001, 2, 2, 3), np.uint8)
    frames[::2] = 255
    save_gif(tmp_path / "a.gif", frames[:2000], fps=50, hold=0)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 2000
    with pytest.raises(ValueError, match="may have 2000 frames"):
        save_gif(tmp_path / "b.gif", frames)
