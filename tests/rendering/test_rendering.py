"""Pictures: properties that hold for any scene, so that their looks stay free to improve."""

from __future__ import annotations

import copy
import importlib
import itertools
import pickle
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest

from mapp_env import mapp_v0
from mapp_env.grid import Grid
from mapp_env.plans.plan import Plan
from mapp_env.problem import Problem
from mapp_env.rendering import Scene, ansi, draw_plan, rgb_array
from mapp_env.rendering.palette import AGENTS, FLAG, FLAG_VISITED, FLOOR, WALL, agent_colour, to_hex

GRID = Grid.from_text(".......\n.##..#.\n.....#.\n..#D...\n.....#.\n.#.....\n...#...\n")
LANDMARKS = (0, 6, 20, 42, 48)
CELL = 72  # pixels of a cell on this grid


def start(grid: Grid = GRID, landmarks: tuple[int, ...] = LANDMARKS, n_agents: int = 3) -> Scene:
    """Return the scene right after a reset."""
    return Scene(
        grid=grid,
        landmarks=landmarks,
        visited=(False,) * len(landmarks),
        cells=(grid.depot,) * n_agents,
        trails=((grid.depot,),) * n_agents,
        step=0,
        max_cycles=50,
    )


def walk(scene: Scene, n_steps: int, seed: int = 0) -> list[Scene]:
    """Return the scenes of a random walk by the rules, the first one included."""
    rng = np.random.default_rng(seed)
    scenes = [scene]
    for _ in range(n_steps):
        actions = rng.integers(0, 4, len(scene.cells))
        cells = tuple(int(c) for c in scene.grid.moves[list(scene.cells), actions])
        visited = zip(scene.landmarks, scene.visited, strict=True)
        scene = replace(
            scene,
            visited=tuple(was or landmark in cells for landmark, was in visited),
            cells=cells,
            trails=tuple((*t, c) for t, c in zip(scene.trails, cells, strict=True)),
            step=scene.step + 1,
        )
        scenes.append(scene)
    return scenes


def has_colour(picture: np.ndarray, colour: tuple[int, int, int]) -> bool:
    """Whether some pixel has exactly this colour."""
    return bool((picture == colour).all(axis=-1).any())


def without_trails(scene: Scene) -> Scene:
    """Return the scene with trails that leave no line."""
    return replace(scene, trails=tuple((cell,) for cell in scene.cells))


# -- imports -----------------------------------------------------------------------------------


def run_python(code: str) -> None:
    subprocess.run([sys.executable, "-c", code], check=True)


def test_import_loads_no_drawing_library() -> None:
    """Importing the package loads none of Pillow, matplotlib and pygame."""
    run_python(
        "import sys, mapp_env.rendering as r; assert {'ansi', 'draw_plan'} <= set(dir(r));"
        "assert not {'PIL', 'matplotlib', 'pygame'} & set(sys.modules), 'loaded too early'"
    )


def test_names_are_functions_in_any_order_of_import() -> None:
    """A submodule of the same name never takes the place of its function."""
    run_python(
        "import mapp_env.rendering.ansi, mapp_env.rendering.rgb_array, mapp_env.rendering.figures;"
        "from mapp_env.rendering import ansi, rgb_array, draw_plan;"
        "assert callable(ansi) and callable(rgb_array) and callable(draw_plan)"
    )


def test_unknown_name_is_an_attribute_error() -> None:
    """The lazy package refuses names that it does not have."""
    with pytest.raises(AttributeError, match="no_such_picture"):
        _ = importlib.import_module("mapp_env.rendering").no_such_picture


def test_sixteen_agents_have_sixteen_colours() -> None:
    """No two of the most agents there may be look alike."""
    assert len(set(AGENTS)) == 16


# -- ansi --------------------------------------------------------------------------------------


def test_ansi_shows_the_paper_grid() -> None:
    """Every cell has its sign, agents hide what they stand on and shared cells are explained."""
    scene = replace(start(), cells=(24, 24, 20), visited=(True, False, True, False, False), step=7)
    assert ansi(scene).splitlines() == [
        "step 7/50  landmarks 2/5",
        "x . . . . . *",
        ". # # . . # .",
        ". . . . . # 2",
        ". . # & . . .",
        ". . . . . # .",
        ". # . . . . .",
        "* . . # . . *",
        "& at row 3, col 3: agents 0, 1",
    ]
    assert " D " in ansi(replace(scene, cells=(0, 0, 20)))


@pytest.mark.parametrize("seed", range(5))
def test_ansi_names_every_agent(seed: int) -> None:
    """Each of sixteen agents is named once, and the rows stay aligned."""
    for scene in walk(start(n_agents=16), 12, seed):
        status, *lines = ansi(scene).splitlines()
        rows, notes = lines[: GRID.rows], lines[GRID.rows :]
        assert len({len(row) for row in rows}) == 1
        assert status == f"step {scene.step}/50  landmarks {sum(scene.visited)}/5"
        named = [sign for row in rows for sign in row.split() if sign.isdigit()]
        named += [name for note in notes for name in note.split("agents ")[1].split(", ")]
        assert sorted(map(int, named)) == list(range(16))


# -- rgb_array ---------------------------------------------------------------------------------


@pytest.mark.parametrize("n_agents", [1, 3, 16])
def test_frames_of_an_episode_have_one_size(n_agents: int) -> None:
    """Frames are uint8 RGB of even sides, and no step changes their size."""
    frames = [rgb_array(scene) for scene in walk(start(n_agents=n_agents), 50)]
    assert {frame.shape for frame in frames} == {frames[0].shape}
    height, width, channels = frames[0].shape
    assert channels == 3
    assert height % 2 == 0
    assert width % 2 == 0
    assert all(frame.dtype == np.uint8 for frame in frames)


def test_same_scene_same_bytes() -> None:
    """A picture depends on nothing but the scene, not even on pictures drawn before it."""
    scenes = walk(start(), 30)
    first = [rgb_array(scene).tobytes() for scene in scenes]
    again = [rgb_array(scene).tobytes() for scene in reversed(scenes)]
    assert first == again[::-1]


def test_frames_are_fresh() -> None:
    """Writing into a frame changes no later frame."""
    before = rgb_array(start())
    kept = before.copy()
    before[:] = 0
    assert np.array_equal(rgb_array(start()), kept)


@pytest.mark.parametrize("which", range(len(LANDMARKS)))
def test_a_visit_changes_its_cell(which: int) -> None:
    """Visiting a landmark changes the picture at its cell and the count, and nothing else."""
    scene = start()
    visited = tuple(index == which for index in range(len(LANDMARKS)))
    before, after = rgb_array(scene), rgb_array(replace(scene, visited=visited))
    differs = (before != after).any(axis=-1)
    row, col = divmod(LANDMARKS[which], GRID.cols)
    margin = (differs.shape[1] - GRID.cols * CELL) // 2
    top, left = margin + row * CELL, margin + col * CELL
    assert differs[top : top + CELL, left : left + CELL].any()
    differs[top : top + CELL, left : left + CELL] = False
    assert differs.any()
    assert not differs[: GRID.rows * CELL].any()


@pytest.mark.parametrize("side", [7, 100, 512])
def test_visited_flags_are_not_red(side: int) -> None:
    """The red of unvisited flags is gone from the picture once all are visited, on any grid."""
    scene = start(Grid(np.zeros((side, side), dtype=bool)), (0, side - 1, side * side - 1))
    assert has_colour(rgb_array(scene), FLAG)
    assert not has_colour(rgb_array(replace(scene, visited=(True,) * 3)), FLAG)


def test_a_move_changes_the_frame() -> None:
    """Every agent's move can be seen, and so can its trail."""
    for agent in range(3):
        scene = start()
        cells, trails = list(scene.cells), list(scene.trails)
        cells[agent] = 25
        trails[agent] = (24, 25)
        moved = replace(scene, cells=tuple(cells))
        trailed = replace(moved, trails=tuple(trails))
        assert not np.array_equal(rgb_array(scene), rgb_array(moved))
        assert not np.array_equal(rgb_array(moved), rgb_array(trailed))


def test_steps_are_counted() -> None:
    """The status bar changes with the step."""
    scene = start()
    assert not np.array_equal(rgb_array(scene), rgb_array(replace(scene, step=1)))


@pytest.mark.parametrize("side", [1, 7, 32, 100, 200, 512])
def test_agents_sharing_a_cell_are_all_seen(side: int) -> None:
    """Sixteen agents on one cell, in a corner or not, all show their colours, whatever the size."""
    grid = GRID if side == 7 else Grid(np.zeros((side, max(side, 2)), dtype=bool))
    for cell in (0, grid.depot, grid.n_cells - 1):
        scene = without_trails(replace(start(grid, (), 16), cells=(cell,) * 16))
        frame = rgb_array(scene)
        assert all(has_colour(frame, agent_colour(agent)) for agent in range(16))


def test_agents_on_neighbouring_tiny_cells_are_all_seen() -> None:
    """Where agents are drawn larger than cells, they still do not cover one another."""
    grid = Grid(np.zeros((300, 300), dtype=bool))
    scene = without_trails(replace(start(grid, (), 16), cells=tuple(range(1000, 1016))))
    frame = rgb_array(scene)
    assert all(has_colour(frame, agent_colour(agent)) for agent in range(16))


def test_shared_trails_are_all_seen() -> None:
    """Agents that went the same way and left it show as many lines."""
    trail = (24, 25, 26, 27)
    frame = rgb_array(replace(start(n_agents=16), cells=(0,) * 16, trails=(trail,) * 16))
    fewer = rgb_array(replace(start(n_agents=16), cells=(0,) * 16, trails=((24,),) * 16))
    margin = (frame.shape[1] - GRID.cols * CELL) // 2
    crossing = frame[margin + 3 * CELL : margin + 4 * CELL, margin + 4 * CELL + 54]
    empty = fewer[margin + 3 * CELL : margin + 4 * CELL, margin + 4 * CELL + 54]
    assert len(np.unique(crossing, axis=0)) - len(np.unique(empty, axis=0)) == 16


@pytest.mark.parametrize(
    ("rows", "cols", "n_landmarks"),
    [
        *[(1, 2, 1), (2, 1, 1), (1, 512, 64), (512, 1, 64), (512, 512, 64), (9, 9, 64)],
        *[(1, 2048, 64), (2048, 1, 64), (2048, 2048, 64), (656, 1491, 64)],
    ],
)
def test_extreme_grids(rows: int, cols: int, n_landmarks: int) -> None:
    """The smallest, longest and largest grids with the most agents and landmarks are drawn."""
    grid = Grid(np.zeros((rows, cols), dtype=bool), 0)
    landmarks = tuple(range(1, n_landmarks + 1))
    scenes = walk(start(grid, landmarks, 16), 40)
    frames = [rgb_array(scene) for scene in (scenes[0], scenes[-1])]
    assert frames[0].shape == frames[1].shape
    assert min(frames[0].shape[:2]) >= 64
    assert max(frames[0].shape[:2]) <= 1080
    assert not np.array_equal(*frames)
    assert ansi(scenes[-1]).count("\n") >= rows


@pytest.mark.parametrize(("side", "merged"), [(1024, 2), (400, 3), (16, 75)])
def test_cells_of_large_grids_share_pixels(side: int, merged: int) -> None:
    """A pixel has the mean colour of its square of cells; signs stand on their cells' pixels."""
    walls = np.random.default_rng(3).random((1030, 1200)) < 0.3
    walls[:8, :8] = walls[500:540, 500:540] = False
    grid = Grid(walls, (520, 520))
    scene = without_trails(start(grid, (0,), 1))
    frame = rgb_array(scene, side)
    height, width = -(-1030 // merged), -(-1200 // merged)
    assert max(height, width) <= side
    top, left = (frame.shape[0] - 32 - height) // 2, (frame.shape[1] - width) // 2
    seen = frame[top : top + height, left : left + width]
    padded = np.full((height * merged, width * merged), np.nan)
    padded[:1030, :1200] = walls
    shares = np.nanmean(padded.reshape(height, merged, width, merged), axis=(1, 3))[:, :, None]
    means = shares * np.array(WALL) + (1 - shares) * np.array(FLOOR)
    wrong = (abs(seen - means) > 1).any(axis=2)
    signs = np.zeros((height, width), bool)
    for row, col in ((0, 0), (520 // merged, 520 // merged)):
        signs[max(row - 30, 0) : row + 30, max(col - 30, 0) : col + 30] = True
    assert not (wrong & ~signs).any()
    if side > 100:
        assert wrong[:20, :20].any()
        assert wrong[520 // merged - 5 :, 520 // merged - 5 :][:10, :10].all()


def test_long_trails_are_drawn_up_to_a_limit() -> None:
    """What lies far back in a long episode costs no time: it is not drawn."""
    scene = start()
    recent = (24, 25) * 300
    long = replace(scene, trails=((0, 1) * 1000 + recent,) * 3)
    assert np.array_equal(rgb_array(long), rgb_array(replace(scene, trails=(recent,) * 3)))


# -- the window --------------------------------------------------------------------------------


@pytest.fixture
def human(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return the window's file, with a display that needs no screen."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    yield importlib.import_module("mapp_env.rendering.human")
    assert not pygame.display.get_init(), "a window left the display running"


def test_window_shows_and_closes_twice(human: Any) -> None:
    """A window takes frames of any size, closes twice, ignores later frames; no sound is opened."""
    import pygame

    window = human.Window()
    assert not pygame.display.get_init()
    for scene in walk(start(), 3):
        assert window.show(rgb_array(scene), 0) is None
    assert window.show(np.zeros((40, 60, 3), np.uint8), 0) is None
    assert pygame.display.get_init()
    assert pygame.mixer.get_init() is None
    assert window.close() is None
    assert not pygame.display.get_init()
    assert window.close() is None
    assert window.show(rgb_array(start()), 0) is None


def test_window_shows_the_frame(human: Any) -> None:
    """What is on the screen is the frame, pixel by pixel."""
    import pygame

    frame = rgb_array(start())
    window = human.Window()
    window.show(frame, 0)
    shown = pygame.surfarray.array3d(window._window.get_surface()).transpose(1, 0, 2)
    window.close()
    assert np.array_equal(shown, frame)


def test_user_closes_one_of_two_windows(human: Any) -> None:
    """Closing a window by hand ends that window only; its later frames are ignored."""
    import pygame

    frame = rgb_array(start())
    first, second = human.Window(), human.Window()
    first.show(frame, 0)
    second.show(frame, 0)
    pygame.event.post(pygame.event.Event(pygame.WINDOWCLOSE, window=first._window))
    second.show(frame, 0)
    assert first._window is None
    assert second._window is not None
    first.show(frame, 0)
    assert first._window is None
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    second.show(frame, 0)
    assert second._window is None


def test_window_leaves_key_presses(human: Any) -> None:
    """A program that steers by keys still finds them after a frame."""
    import pygame

    window = human.Window()
    frame = rgb_array(start())
    window.show(frame, 0)
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_LEFT))
    window.show(frame, 0)
    keys = [event.key for event in pygame.event.get(pygame.KEYDOWN)]
    window.close()
    assert keys == [pygame.K_LEFT]


def test_window_leaves_a_running_display_alone(human: Any) -> None:
    """A display that somebody else started is not ended by our window, which bears its end."""
    import pygame

    pygame.display.init()
    window = human.Window()
    window.show(rgb_array(start()), 0)
    window.close()
    assert pygame.display.get_init()
    window = human.Window()
    window.show(rgb_array(start()), 0)
    pygame.display.quit()
    window.show(rgb_array(start()), 0)
    window.close()


@pytest.mark.parametrize("copier", ["pickle", "deepcopy"])
@pytest.mark.parametrize("face", ["parallel", "aec", "central", "tuple"])
def test_copies_open_windows_of_their_own(human: Any, face: str, copier: str) -> None:
    """A copy made when a frame has been shown shows what follows, in a window of its own."""
    make: dict[str, Any] = {
        "parallel": mapp_v0.parallel_env,
        "aec": mapp_v0.env,
        "central": lambda **more: gymnasium.make("mapp_env/Central-v0", **more),
        "tuple": lambda **more: gymnasium.make("mapp_env/Tuple-v0", **more),
    }
    env = make[face](render_mode="human", observation="global")
    env.unwrapped._display.fps = 0  # no waiting between frames
    env.reset(seed=3)
    twin = pickle.loads(pickle.dumps(env)) if copier == "pickle" else copy.deepcopy(env)
    assert len(human._open_windows) == 1
    frames = []
    for each in (twin, env):
        for action in (0, 1, 2):
            if face == "parallel":
                each.step(dict.fromkeys(each.agents, action))
            elif face == "aec":
                for _ in each.agents:
                    each.step(action)
            else:
                each.step((action,) * 3 if face == "tuple" else action)
        assert len(human._open_windows) == 2
        surface = human._open_windows[-1 if each is twin else 0]._window.get_surface()
        frames.append(pygame_array(surface))
    assert np.array_equal(frames[0], frames[1])
    env.close()
    assert len(human._open_windows) == 1
    twin.render()
    twin.close()


def pygame_array(surface: Any) -> np.ndarray:
    """Return a copy of a surface's pixels."""
    import pygame

    return pygame.surfarray.array3d(surface)


def test_window_keeps_the_pace(human: Any) -> None:
    """Frames are not shown faster than asked for."""
    import time

    window = human.Window()
    frame = rgb_array(start())
    window.show(frame, 50)
    began = time.perf_counter()
    for _ in range(5):
        window.show(frame, 50)
    window.close()
    assert time.perf_counter() - began >= 0.08


def test_window_refuses_what_is_no_picture(human: Any) -> None:
    """A frame of another shape or type is a ValueError and opens nothing."""
    for wrong in (np.zeros((5, 5), np.uint8), np.zeros((5, 5, 3), np.float32)):
        with pytest.raises(ValueError, match="frame"):
            human.Window().show(wrong, 0)


def test_missing_pygame_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without pygame-ce the error says what to install, and the environment is as before."""
    import os

    monkeypatch.setitem(sys.modules, "pygame", None)
    monkeypatch.delitem(sys.modules, "mapp_env.rendering.human", raising=False)
    rendering = importlib.import_module("mapp_env.rendering")
    monkeypatch.delitem(vars(rendering), "Window", raising=False)
    before = dict(os.environ)
    with pytest.raises(ImportError, match=r'pip install "pygame-ce>=2.5"'):
        _ = rendering.Window
    assert dict(os.environ) == before


# -- figures -----------------------------------------------------------------------------------


def plan_of(problem: Problem, orders: list[tuple[int, ...]], **more: Any) -> Plan:
    """Return the plan in which each agent visits its landmarks in order by shortest paths."""
    tours = []
    for order in orders:
        tour = [problem.grid.depot]
        for cell in (*order, problem.grid.depot):
            tour += problem.grid.path(tour[-1], cell)[1:]
        tours.append(tuple(tour) if order else ())
    lengths = [max(len(tour) - 1, 0) for tour in tours]
    return Plan(
        tours=tuple(tours),
        claims=tuple(orders),
        cover_time=max(lengths),
        makespan=max(lengths),
        total_distance=sum(lengths),
        **more,
    )


def segments(ax: Any, agent: int) -> set[tuple[tuple[float, float], ...]]:
    """Return the straight pieces of the lines on an axes that have an agent's own colour."""
    from matplotlib.patches import PathPatch

    pieces = set()
    for patch in ax.patches:
        if isinstance(patch, PathPatch) and to_rgb(patch) == agent_colour(agent):
            corners = [tuple(np.round(corner, 6)) for corner in patch.get_path().vertices]
            pieces |= {tuple(sorted(pair)) for pair in itertools.pairwise(corners)}
    return pieces


def to_rgb(patch: Any) -> tuple[int, ...]:
    """Return the colour of a patch's edge as in the palette."""
    return tuple(round(255 * value) for value in patch.get_edgecolor()[:3])


def legend_of(ax: Any) -> list[str]:
    """Return the texts of the legend."""
    return [text.get_text() for text in ax.get_legend().get_texts()]


def test_draw_plan_draws_on_the_given_axes() -> None:
    """The given axes come back with every tour's length in the legend and the costs above."""
    from matplotlib.figure import Figure

    problem = Problem(GRID, LANDMARKS)
    plan = plan_of(problem, [(0, 42), (6, 20, 48), ()], status="optimal")
    ax = Figure().add_subplot()
    assert draw_plan(problem, plan, ax) is ax
    texts = legend_of(ax)
    assert f"agent 0: {len(plan.tours[0]) - 1} steps" in texts
    assert f"agent 1: {len(plan.tours[1]) - 1} steps" in texts
    assert "agent 2: claims nothing" in texts
    assert f"cover time {plan.cover_time} (optimal)" in ax.get_title()
    assert segments(ax, 0)
    assert segments(ax, 1)
    assert not segments(ax, 2)


def test_draw_plan_is_headless_and_unknown_to_pyplot() -> None:
    """Without axes a figure of its own is made, drawn and saved, and pyplot is never loaded."""
    run_python(
        "import io, sys; from mapp_env.rendering import draw_plan;"
        "from mapp_env.grid import Grid; from mapp_env.problem import Problem;"
        "from mapp_env.plans.plan import Plan;"
        "problem = Problem(Grid.from_text('D.\\n..'), (1,), 1);"
        "plan = Plan(((0, 1, 0),), ((1,),), 1, 2, 2);"
        "ax = draw_plan(problem, plan, title='a title'); picture = io.BytesIO();"
        "ax.figure.savefig(picture); assert picture.getvalue().startswith(b'\\x89PNG');"
        "assert ax.get_title() == 'a title';"
        "assert 'matplotlib.pyplot' not in sys.modules, 'pyplot was loaded'"
    )


@pytest.mark.parametrize("n_agents", [2, 5, 16])
@pytest.mark.parametrize("grid", [GRID, Grid(np.zeros((150, 150), dtype=bool))], ids=["7", "150"])
def test_overlapping_routes_are_apart(grid: Grid, n_agents: int) -> None:
    """Agents on the very same tour are drawn beside one another, none over another."""
    landmark = int(grid.reachable[-20])
    problem = Problem(grid, (landmark,), n_agents)
    ax = draw_plan(problem, plan_of(problem, [(landmark,)] * n_agents))
    drawn = [segments(ax, agent) for agent in range(n_agents)]
    assert all(drawn)
    assert sum(map(len, drawn)) == len(set().union(*drawn))


def test_way_home_is_dashed_from_the_last_claim() -> None:
    """The full line ends at the last claim and the dashed one ends at the depot."""
    from matplotlib.patches import PathPatch

    problem = Problem(GRID, LANDMARKS, 1)
    ax = draw_plan(problem, plan_of(problem, [(6, 20)]))
    dashed, solid = (patch for patch in ax.patches if isinstance(patch, PathPatch))
    assert solid.get_linestyle() in ("solid", "-")
    assert dashed.get_linestyle() not in ("solid", "-")
    ends = [solid.get_path().vertices[-1], dashed.get_path().vertices[-1]]
    for (across, down), cell in zip(ends, (20, GRID.depot), strict=True):
        assert round(down) * GRID.cols + round(across) == cell
    assert np.array_equal(dashed.get_path().vertices[0], ends[0])


def test_draw_plan_says_what_is_not_visited() -> None:
    """A plan that leaves landmarks is drawn as well and says so."""
    problem = Problem(GRID, LANDMARKS)
    plan = Plan(((), (24, 25, 24), ()), ((), (), ()), np.inf, np.inf, np.inf, status="infeasible")
    ax = draw_plan(problem, plan)
    assert "not visited" in legend_of(ax)
    assert "not every landmark" in ax.get_title()
    assert draw_plan(problem, plan, title="").get_title() == ""


@pytest.mark.parametrize("side", [7, 150])
def test_draw_plan_frames_the_landmarks_left_out(side: int) -> None:
    """Every flag is red as in a frame before a visit; a hatched frame, and no grey, marks a miss.

    In a frame grey-green means visited, so a figure must not give it the opposite meaning.
    """
    grid = Grid(np.zeros((side, side), dtype=bool), 0)
    visited, missed = 1, grid.n_cells - 1
    plan = Plan(((0, 1, 0), ()), ((visited,), ()), np.inf, np.inf, np.inf, status="infeasible")
    ax = draw_plan(Problem(grid, (visited, missed), 2), plan)

    def cells(patches: Any) -> list[tuple[int, int]]:
        boxes = [patch.get_window_extent().get_points().mean(axis=0) for patch in patches]
        middles = ax.transData.inverted().transform(boxes)
        return [(round(down), round(across)) for across, down in middles]

    def face(patch: Any) -> tuple[int, ...]:
        return tuple(round(255 * value) for value in patch.get_facecolor()[:3])

    assert cells(patch for patch in ax.patches if patch.get_hatch()) == [(side - 1, side - 1)]
    assert [face(patch) for patch in ax.patches].count(FLAG) == 2
    marks = [patch for patch in ax.get_legend().get_patches() if patch.get_hatch()]
    assert len(marks) == 1
    assert FLAG_VISITED not in {face(patch) for patch in [*ax.patches, *marks]}


@pytest.mark.parametrize(("rows", "cols"), [(1, 2), (2, 1), (200, 200), (1, 512)])
def test_draw_plan_on_extreme_grids(rows: int, cols: int) -> None:
    """Tiny, long and large grids are drawn with sixteen agents."""
    grid = Grid(np.zeros((rows, cols), dtype=bool), 0)
    problem = Problem(grid, (grid.n_cells - 1,), 16)
    ax = draw_plan(problem, plan_of(problem, [(grid.n_cells - 1,)] * 16))
    ax.figure.draw_without_rendering()
    assert len(legend_of(ax)) >= 16


def test_palette_is_written_as_hex() -> None:
    """Figures and frames name the same colour."""
    assert to_hex(agent_colour(0)) == "#0072b2"


@pytest.mark.parametrize("face", ["parallel", "vector"])
def test_pictures_know_this_episode_alone(face: str) -> None:
    """A frame shows the trails of its own episode, from reset to last step, and its own limit."""
    import mapp_env
    from mapp_env import mapp_v0

    problem = Problem(GRID, LANDMARKS, 3, max_cycles=7)
    episodes = []
    for mode in ("rgb_array", "ansi"):
        if face == "parallel":
            env: Any = mapp_v0.parallel_env(render_mode=mode)
        else:
            env = mapp_env.make_vec(1, render_mode=mode, autoreset_mode="Disabled")
        for _ in range(2):
            env.reset(options={"problem": problem})
            pictures = [env.render()]
            for step in range(7):
                actions = np.array([1, 2, 3]) - step % 2
                joint = (
                    dict(zip(env.agents, actions.tolist(), strict=True))
                    if (face == "parallel")
                    else actions[None]
                )
                env.step(joint)
                pictures.append(env.render())
            episodes.append([p if face == "parallel" else p[0] for p in pictures])
    first, second, *texts = episodes
    assert all(map(np.array_equal, first, second))
    assert [text.split("  ")[0] for text in texts[0]] == [f"step {step}/7" for step in range(8)]
    # The frames are those of scenes that follow the same moves.
    cells = [(24, 24, 24)]
    for step in range(7):
        cells.append(tuple(GRID.moves[list(cells[-1]), np.array([1, 2, 3]) - step % 2].tolist()))
    for step, frame in enumerate(first):
        scene = Scene(
            grid=GRID,
            landmarks=LANDMARKS,
            visited=(False,) * 5,
            cells=cells[step],
            trails=tuple(zip(*cells[: step + 1], strict=True)),
            step=step,
            max_cycles=7,
        )
        assert np.array_equal(frame, rgb_array(scene))


def test_trails_fade_with_age() -> None:
    """The last move of a trail is drawn nearest to the agent's own colour, the first faintest."""
    grid = Grid(np.zeros((1, 12), bool), 0)
    trail = tuple(range(10))
    scene = replace(start(grid, (), 1), cells=(11,), trails=(trail,))
    frame = rgb_array(scene).astype(int)
    side = 72
    row = frame.shape[0] // 2 - 16  # above the bar, in the middle of the grid
    left = (frame.shape[1] - 12 * side) // 2
    band = frame[row - side // 2 : row + side // 2]
    away = []
    for move in range(9):
        middle = left + (move + 1) * side - 8
        column = band[:, middle]
        away.append(int(np.abs(column - np.array(agent_colour(0))).sum(axis=1).min()))
    assert away == sorted(away, reverse=True)
    assert away[0] > away[-1]


def test_unvisited_flags_are_seen_above_visited_ones() -> None:
    """Where signs are larger than cells, a flag that is still to be visited is never hidden."""
    grid = Grid(np.zeros((256, 256), bool), 0)
    for visited in ((True, False), (False, True)):
        cells = (128 * 256 + 128, 128 * 256 + 129)
        scene = replace(start(grid, cells, 1), visited=visited)
        alone = replace(start(grid, (cells[visited.index(False)],), 1))
        frame, wanted = rgb_array(scene), rgb_array(alone)
        red = (wanted == np.array(FLAG)).all(axis=-1)
        assert red.any()
        assert (frame[red] == np.array(FLAG)).all()


def test_ansi_names_cells_by_row_and_column() -> None:
    """Agents on one cell are named at its row and column, on grids of any shape."""
    for rows, cols in ((2, 9), (9, 2)):
        grid = Grid(np.zeros((rows, cols), bool), 0)
        for cell in range(grid.n_cells):
            row, col = divmod(cell, cols)
            text = ansi(replace(start(grid, (), 2), cells=(cell, cell)))
            assert text.endswith(f"& at row {row}, col {col}: agents 0, 1")
            assert text.split("\n")[1 + row].split(" ")[col] == "&"


def test_window_takes_the_frames_size(human: Any) -> None:
    """A frame of another size than the one before is shown whole."""
    import pygame

    window = human.Window()
    for height, width in ((40, 60), (80, 30), (64, 64)):
        frame = np.random.default_rng(height).integers(0, 255, (height, width, 3), np.uint8)
        window.show(frame, 0)
        shown = pygame.surfarray.array3d(window._window.get_surface()).transpose(1, 0, 2)
        assert np.array_equal(shown, frame)
    window.close()


def test_only_the_proven_cost_is_marked() -> None:
    """Of a plan's three costs the title calls none optimal but the objective's."""
    problem = Problem(GRID, LANDMARKS)
    for objective in ("cover_time", "makespan", "total_distance"):
        plan = plan_of(problem, [(0, 42), (6, 20, 48), ()], status="optimal", objective=objective)
        title = draw_plan(problem, plan).get_title()
        assert title.count("(optimal)") == 1
        assert f"{objective.replace('_', ' ')} {plan.cost} (optimal)" in title


@pytest.mark.parametrize("face", ["parallel", "central"])
def test_the_window_shows_every_step(human: Any, face: str) -> None:
    """After a reset and after each step, the last one too, the window shows that very moment."""
    import gymnasium
    import pygame

    from mapp_env import mapp_v0

    if face == "parallel":
        env: Any = mapp_v0.parallel_env(render_mode="human", max_cycles=2)
    else:
        env = gymnasium.make("mapp_env/Central-v0", render_mode="human", max_cycles=2).unwrapped

    def check() -> None:
        surface = env._display._window._window.get_surface()
        shown = pygame.surfarray.array3d(surface).transpose(1, 0, 2)
        assert np.array_equal(shown, rgb_array(env._simulation.scene()))

    env.reset(seed=0)
    check()
    for _ in range(2):
        env.step(dict.fromkeys(env.agents, 1) if face == "parallel" else 21)
        check()
    env.close()
