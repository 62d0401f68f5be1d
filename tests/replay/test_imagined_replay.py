"""Imagined transitions are the rules' own, of moves that were made, from fair states."""

from itertools import product

import numpy as np
import pytest
from model import REWARDS

from baselines.networks import network_spec, split_joint
from baselines.replay.imagined import UNKNOWN, ImaginedReplay, try_actions
from baselines.replay.own_imagined import OwnImaginedReplay
from baselines.replay.relabelled import RelabelledReward, relabelled_reward
from mapp_env import Grid, make_grid
from mapp_env.engine.rules import Reward, step_row
from mapp_env.engine.state import new_rows, split
from mapp_env.engine.world import make_world

GRIDS = {
    "paper": make_grid("paper-7x7"),
    "corridor": Grid.from_text("...D.."),
    "rooms": Grid.from_text("....#...\n..#....#\n.#..D.#.\n...##...\n.#......"),
    "hall": Grid.from_text("......\n......\n...D..\n......"),
}


def make_replay(grid: Grid, n_agents: int, n_landmarks: int, **changes: object) -> ImaginedReplay:
    """Return a replay that knows nothing yet."""
    spec = network_spec("paper", n_agents, n_landmarks, 4, grid.n_cells, 8, outputs="joint")
    options = {
        "n_rows": 32,
        "n_tried": 3,
        "temperature": 0.5,
        "exploration": 0.3,
        "from_depot": 0.5,
        "max_length": 12,
    }
    return ImaginedReplay(spec, grid, **{**options, **changes})


def tell(replay, observation, actions, next_observation) -> None:
    """Let a replay store a transition, whose reward and end it does not read."""
    replay.add(observation, actions, np.nan, next_observation, None)


def rewards_for(replay: ImaginedReplay, grid: Grid, kind: str, scale: float) -> RelabelledReward:
    """Return a reward of the replay's transitions."""
    return relabelled_reward(grid, replay.spec.n_agents, replay.spec.n_landmarks, kind, scale)


def experience(replay: ImaginedReplay, grid: Grid, rng: np.random.Generator, share: float) -> None:
    """Tell of moves, each with a probability, the depot's to the right or left surely."""
    n, k = replay.spec.n_agents, replay.spec.n_landmarks
    for cell, action in product([grid.depot, *grid.reachable.tolist()], range(4)):
        if rng.random() < share:
            here, there = np.full(n, cell), np.full(n, grid.moves[cell, action])
            rest = np.zeros(2 * k)
            tell(
                replay,
                np.concatenate((here, rest)).astype(np.float32),
                np.full(n, action),
                np.concatenate((there, rest)).astype(np.float32),
            )


def step_by_the_rules(
    grid: Grid, observation: np.ndarray, actions: np.ndarray, kind: str, n_agents: int
) -> tuple[np.ndarray, float, bool]:
    """Return the next observation, the reward and whether it ends, from the env's own kernel."""
    n_landmarks = (len(observation) - n_agents) // 2
    row = new_rows(1, n_agents, n_landmarks)[0]
    head = split(row, n_agents, n_landmarks).head
    head[:] = observation
    world = make_world(grid, n_agents, n_landmarks, Reward[kind.upper()])
    reward, terminated, _ = step_row(row, np.array(actions), 10**6, world)
    return head.astype(np.float32), reward, terminated


def round_of(replay, reward, rng):
    """Begin and draw once, with values that are chance; return the batch and the values."""
    replay.start_over(rng)
    values = rng.normal(size=(len(replay.cells), replay.spec.n_joint_actions)).astype(np.float32)
    return replay.draw(values, reward, rng)[0], values


# -- what is imagined --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "n_agents", "n_landmarks"),
    [
        ("paper", 3, 5),
        ("paper", 1, 1),
        ("paper", 4, 6),
        ("corridor", 2, 3),
        ("rooms", 2, 4),
        ("rooms", 3, 2),
        ("hall", 1, 6),
        ("hall", 4, 1),
    ],
)
@pytest.mark.parametrize("kind", REWARDS)
@pytest.mark.parametrize("scale", [1.0, 0.5, 0.1])
def test_every_imagined_transition_is_the_rules_own(name, n_agents, n_landmarks, kind, scale):
    """Next state, reward, flags and termination equal the step kernel's from the same state.

    Bit for bit where the scale is a power of 2; else the reward is the sum of rounded float32.
    """
    grid = GRIDS[name]
    rng = np.random.default_rng([n_agents, n_landmarks])
    replay = make_replay(grid, n_agents, n_landmarks, n_rows=24, from_depot=0.2)
    experience(replay, grid, rng, 1.0)
    reward = rewards_for(replay, grid, kind, scale)
    ended = 0
    for _ in range(16):
        batch, _ = round_of(replay, reward, rng)
        ended += batch.terminated.sum()
        assert batch.observations.dtype == batch.next_observations.dtype == np.float32
        assert batch.rewards.dtype == np.float32
        for row, tried in product(range(24), range(3)):
            next_obs, expected, terminated = step_by_the_rules(
                grid, batch.observations[row], batch.actions[row, tried], kind, n_agents
            )
            np.testing.assert_array_equal(batch.next_observations[row, tried], next_obs)
            assert batch.terminated[row, tried] == terminated
            if scale == 0.1:
                assert batch.rewards[row, tried] == pytest.approx(scale * expected, rel=1e-6)
            else:
                assert batch.rewards[row, tried] == scale * expected
    assert ended > 0


@pytest.mark.parametrize("share", [0.15, 0.5, 0.8])
@pytest.mark.parametrize("n_agents", [1, 2, 3])
def test_no_move_that_nobody_made_is_imagined(n_agents, share):
    """With a part of the moves known, all that is imagined consists of these."""
    grid = GRIDS["paper"]
    rng = np.random.default_rng(n_agents)
    replay = make_replay(grid, n_agents, 3)
    experience(replay, grid, rng, share)
    assert replay.ready
    made = replay.moves.copy()
    known = replay._known_cells()
    for _ in range(60):
        batch, _ = round_of(replay, rewards_for(replay, grid, "step", 1.0), rng)
        cells = batch.observations[:, None, :n_agents].astype(int)
        led_to = made[cells, batch.actions]
        assert (led_to != UNKNOWN).all()
        np.testing.assert_array_equal(led_to, batch.next_observations[..., :n_agents])
        assert np.isin(batch.observations[:, n_agents : n_agents + 3], known).all()
    np.testing.assert_array_equal(made, replay.moves)


def test_known_actions_are_those_made():
    """Every action of a cell counts as known only where none has been made."""
    grid = GRIDS["hall"]
    replay = make_replay(grid, 2, 1)
    rng = np.random.default_rng(0)
    experience(replay, grid, rng, 0.5)
    cells = rng.integers(grid.n_cells, size=(200, 2))
    obs = np.concatenate((cells, np.zeros((200, 2))), axis=1).astype(np.float32)
    known = replay.known_actions(obs)
    untouched = 0
    for row, agent in product(range(200), range(2)):
        made = replay.moves[cells[row, agent]] != UNKNOWN
        untouched += not made.any()
        np.testing.assert_array_equal(known[row, agent], made if made.any() else [True] * 4)
    assert untouched
    experience(replay, grid, rng, 1.0)
    assert replay.known_actions(obs) is None


def test_moves_are_remembered_agent_by_agent():
    """Each agent's own action is kept with its own cell and where that led."""
    replay = make_replay(GRIDS["hall"], 3, 1)
    tell(
        replay,
        np.array([0, 7, 15, 9, 0], np.float32),
        np.array([1, 3, 0]),
        np.array([1, 13, 14, 9, 0], np.float32),
    )
    expected = np.full((24, 4), UNKNOWN)
    expected[0, 1], expected[7, 3], expected[15, 0] = 1, 13, 14
    np.testing.assert_array_equal(replay.moves, expected)


def test_ready_only_with_room_for_the_landmarks():
    """There must be as many cells that somebody has left, the depot aside, as landmarks."""
    grid = GRIDS["corridor"]
    replay = make_replay(grid, 1, 2)
    for cell, ready in ((3, False), (2, False), (4, True), (5, True)):
        tell(
            replay,
            np.array([cell, 0, 0, 0, 0], np.float32),
            np.array([2]),
            np.array([cell, 0, 0, 0, 0], np.float32),
        )
        assert replay.ready == ready


# -- how episodes begin and end ----------------------------------------------------------------


@pytest.mark.parametrize("from_depot", [0.0, 0.6, 1.0])
@pytest.mark.parametrize(
    ("name", "n_agents", "n_landmarks"), [("paper", 3, 5), ("corridor", 4, 4), ("rooms", 1, 6)]
)
def test_new_episodes_are_fair(name, n_agents, n_landmarks, from_depot):
    """Landmarks are distinct, never the depot, never unvisited under an agent, not all visited."""
    grid = GRIDS[name]
    rng = np.random.default_rng(0)
    options = {"n_rows": 2000, "from_depot": from_depot}
    replay = make_replay(grid, n_agents, n_landmarks, **options)
    experience(replay, grid, rng, 1.0)
    replay.start_over(rng)
    sorted_landmarks = np.sort(replay.landmarks, axis=1)
    assert (np.diff(sorted_landmarks, axis=1) > 0).all()
    assert (replay.landmarks != grid.depot).all()
    assert np.isin(replay.landmarks, grid.reachable).all()
    under = (replay.landmarks[:, :, None] == replay.cells[:, None, :]).any(axis=2)
    assert replay.visited[under].all()
    assert not replay.visited.all(axis=1).any()
    assert (replay.ages == 0).all()
    fresh = (replay.cells == grid.depot).all(axis=1) & ~replay.visited.any(axis=1)
    assert fresh.mean() >= from_depot - 0.04
    if from_depot == 1.0:
        assert fresh.all()
    elif name != "corridor":
        # On five cells many others have nothing left to visit, and start at the depot too.
        assert fresh.mean() == pytest.approx(from_depot, abs=0.2)
    # Each landmark comes as often as another.
    counts = np.bincount(replay.landmarks.ravel(), minlength=grid.n_cells)[grid.reachable]
    expected = 2000 * n_landmarks / grid.reachable.size
    assert abs(counts - expected).max() < 6 * np.sqrt(expected)


def test_any_number_of_landmarks_is_left_elsewhere():
    """Away from the depot episodes start with 1 to K landmarks left, each number often."""
    grid = GRIDS["hall"]
    rng = np.random.default_rng(0)
    replay = make_replay(grid, 1, 4, n_rows=4000, from_depot=0.0)
    experience(replay, grid, rng, 1.0)
    replay.start_over(rng)
    elsewhere = replay.cells[:, 0] != grid.depot
    left = (~replay.visited[elsewhere]).sum(axis=1)
    shares = np.bincount(left, minlength=5) / len(left)
    assert shares[0] == 0.0
    np.testing.assert_allclose(shares[1:], 0.25, atol=0.08)


def test_elsewhere_includes_the_depot():
    """Where episodes do not start at the depot, each agent stands there as often as anywhere."""
    grid = GRIDS["hall"]
    rng = np.random.default_rng(0)
    replay = make_replay(grid, 2, 1, n_rows=4000, from_depot=0.0)
    experience(replay, grid, rng, 1.0)
    replay.start_over(rng)
    at_depot = replay.cells == grid.depot
    alone = at_depot.sum(axis=1) == 1  # both there: may be an episode from the depot
    share = 1 / (grid.reachable.size + 1)
    assert alone.mean() == pytest.approx(2 * share * (1 - share), rel=0.3)


def test_followed_episodes_forget_no_visit():
    """Landmarks visited before, and those under the agents now, are visited after a step."""
    grid = GRIDS["hall"]
    rng = np.random.default_rng(0)
    replay = make_replay(grid, 2, 4, n_rows=200, from_depot=0.5)
    experience(replay, grid, rng, 1.0)
    replay.start_over(rng)
    left = 0
    for _ in range(6):
        before = replay.visited.copy()
        replay.follow(rng.integers(4, size=(200, 2)))
        on = (replay.landmarks[:, :, None] == replay.cells[:, None, :]).any(axis=2)
        np.testing.assert_array_equal(replay.visited, before | on)
        left += int((before & ~on).sum())
    assert left > 100


def test_only_ended_episodes_begin_anew():
    """Rows that are neither solved nor too old keep their state to the bit."""
    grid = GRIDS["paper"]
    rng = np.random.default_rng(0)
    replay = make_replay(grid, 2, 2, n_rows=64, max_length=6)
    experience(replay, grid, rng, 1.0)
    reward = rewards_for(replay, grid, "step", 1.0)
    solved = timed_out = went_on = 0
    for _ in range(40):
        ended = replay.visited.all(axis=1) | (replay.ages >= 6)
        solved += replay.visited.all(axis=1).sum()
        timed_out += (replay.ages >= 6).sum()
        before = {name: array.copy() for name, array in replay.arrays_by_name().items()}
        replay.start_over(rng)
        for name in ("cells", "landmarks", "visited", "ages"):
            np.testing.assert_array_equal(getattr(replay, name)[~ended], before[name][~ended])
        assert (replay.ages[ended] == 0).all()
        ages = replay.ages.copy()
        replay.draw(rng.normal(size=(64, 16)).astype(np.float32), reward, rng)
        np.testing.assert_array_equal(replay.ages, ages + 1)
        went_on += (~ended).sum()
    assert solved
    assert timed_out
    assert went_on


@pytest.mark.parametrize("retries", [0.0, 0.6, 1.0])
def test_given_up_episodes_are_tried_again(retries):
    """Of the unsolved that ended, that share begins again with its landmarks; of the solved none.

    Those that begin again stand at the depot with nothing visited.
    """
    grid = GRIDS["paper"]
    rng = np.random.default_rng(0)
    replay = make_replay(grid, 3, 5, n_rows=4000, from_depot=0.5, max_length=6, retries=retries)
    experience(replay, grid, rng, 1.0)
    replay.start_over(rng)
    replay.visited[:1000] = True
    replay.ages[1000:3000] = 6
    before = replay.landmarks.copy()
    np.testing.assert_array_equal(replay.start_over(rng), np.arange(3000))
    same = (replay.landmarks == before).all(axis=1)
    assert not same[:1000].any()
    assert same[1000:3000].mean() == pytest.approx(retries, abs=0.05)
    assert same[3000:].all()
    again = np.flatnonzero(same[:3000])
    assert (replay.cells[again] == grid.depot).all()
    assert not replay.visited[again].any()


def test_episodes_stop_in_cells_without_recorded_moves():
    """Where an agent has come to a cell that nobody has left, the next draw begins anew."""
    replay = make_replay(GRIDS["corridor"], 1, 1, n_rows=200, from_depot=1.0, max_length=50)
    # Right from the depot leads to a cell that nobody has moved from; left to one that is known.
    for cell, action, there in ((3, 1, 4), (3, 0, 2), (2, 1, 3), (2, 0, 1), (1, 0, 0), (1, 1, 2)):
        tell(
            replay, np.array([cell, 0, 0], np.float32), np.array([action]), np.array([there, 0, 0])
        )
    rng = np.random.default_rng(0)
    reward = rewards_for(replay, GRIDS["corridor"], "step", 1.0)
    met = 0
    for _ in range(30):
        replay.start_over(rng)
        assert not np.isin(replay.cells, (0, 4)).any()
        replay.draw(rng.normal(size=(200, 4)).astype(np.float32), reward, rng)
        stuck = np.isin(replay.cells[:, 0], (0, 4))
        met += stuck.sum()
        assert (replay.ages[stuck] >= 50).all()
        assert (replay.ages[~stuck] < 50).all()
    assert met


# -- which actions are tried -------------------------------------------------------------------


def imagine(values, chances, temperature, moves, cells):
    """Return the joint actions tried in one state."""
    n_agents = len(cells)
    digits = split_joint(np.arange(4**n_agents), n_agents, 4)
    cells, values, chances = np.array([cells]), values[None], chances[None]
    return try_actions(cells, values, chances, temperature, moves, digits)[0]


@pytest.mark.parametrize("temperature", [0.3, 1.0])
@pytest.mark.parametrize("all_known", [True, False])
def test_tried_actions_are_the_best_and_then_boltzmann(temperature, all_known):
    """First the best of those known; the others in the proportions of exp(value / temperature)."""
    rng = np.random.default_rng(3)
    moves = np.array(GRIDS["hall"].moves[:, :4], np.int64)
    if not all_known:
        moves[8, 2] = moves[15, 0] = UNKNOWN
    values = rng.normal(size=16).astype(np.float32)
    values[8] = 9.0  # up and left: the best, where it is known
    n = 40_000
    tried = imagine(values, rng.random(n), temperature, moves, [8, 15])
    first, second = split_joint(np.arange(16), 2, 4).T
    known = (moves[8, first] != UNKNOWN) & (moves[15, second] != UNKNOWN)
    best = np.where(known, values, -np.inf).argmax()
    assert (best == 8) == all_known
    assert tried[0] == best
    weights = np.where(known, np.exp(values.astype(float) / temperature), 0.0)
    weights[best] = 0.0
    expected = (n - 1) * weights / weights.sum()
    counts = np.bincount(tried[1:], minlength=16)
    assert (counts[expected == 0] == 0).all()
    there = expected > 0
    chi_square = ((counts - expected)[there] ** 2 / expected[there]).sum()
    assert chi_square < 45  # 14 degrees of freedom: less than one in ten thousand by chance


def test_equal_values_take_the_first_and_extreme_chances_stay_inside():
    """Ties go to the first action; chances of 0 and just below 1 name known actions too."""
    moves = np.array(GRIDS["hall"].moves[:, :4], np.int64)
    moves[8, 0] = moves[8, 3] = UNKNOWN
    chances = np.array([0.5, 0.0, np.nextafter(1.0, 0.0)])
    values = np.zeros(4, np.float32)
    assert imagine(values, chances, 1.0, moves, [8]).tolist() == [1, 2, 2]
    # Values so far apart that no other action has a weight: the best one again.
    values[1] = 1e6
    assert imagine(values, chances, 0.001, moves, [8]).tolist() == [1, 1, 1]


def test_exploration_is_the_share_of_other_actions_followed():
    """Episodes go on with the best action, or with any of those tried as often as is said."""
    grid = GRIDS["hall"]
    for exploration in (0.0, 0.4, 1.0):
        rng = np.random.default_rng(1)
        options = {"n_rows": 4000, "n_tried": 4, "exploration": exploration, "from_depot": 1.0}
        replay = make_replay(grid, 1, 1, **options, temperature=100.0)
        experience(replay, grid, rng, 1.0)
        replay.start_over(rng)
        values = np.tile(np.array([0.0, 0.1, 0.0, 0.0], np.float32), (4000, 1))
        batch, _ = replay.draw(values, rewards_for(replay, grid, "step", 1.0), rng)
        rows = np.arange(4000)
        # From the depot in the open every action leads elsewhere.
        followed = (batch.next_observations[:, :, 0] == replay.cells).argmax(axis=1)
        np.testing.assert_array_equal(
            replay.cells[:, 0], batch.next_observations[rows, followed, 0]
        )
        flags = batch.next_observations[rows, followed, 2].astype(bool)
        np.testing.assert_array_equal(replay.visited[:, 0], flags)
        assert (followed > 0).mean() == pytest.approx(exploration * 3 / 4, abs=0.03)


def test_no_more_actions_are_tried_than_there_are():
    """One agent has four actions, so four are tried where more are asked for."""
    assert make_replay(GRIDS["hall"], 1, 1, n_tried=64).n_tried == 4
    assert make_replay(GRIDS["hall"], 2, 1, n_tried=7).n_tried == 7


# -- chance and checkpoints --------------------------------------------------------------------


def play(replay: ImaginedReplay, grid: Grid, rng: np.random.Generator, rounds: int) -> list:
    """Return all arrays of some draws."""
    reward = rewards_for(replay, grid, "manhattan", 0.1)
    return [array for _ in range(rounds) for array in round_of(replay, reward, rng)[0]]


def test_draws_depend_on_the_generator_alone():
    """The same generator gives the same draws, whatever NumPy's global state; another, others."""
    grid = GRIDS["paper"]
    draws = []
    for seed in (5, 5, 6):
        np.random.seed(len(draws))  # noqa: NPY002
        replay = make_replay(grid, 3, 5)
        experience(replay, grid, np.random.default_rng(0), 0.9)
        before = np.random.get_state()[1].copy()  # noqa: NPY002
        draws.append(play(replay, grid, np.random.default_rng(seed), 20))
        np.testing.assert_array_equal(before, np.random.get_state()[1])  # noqa: NPY002
    one, same, other = (b"".join(array.tobytes() for array in draw) for draw in draws)
    assert one == same != other


def test_restored_replay_goes_on_bit_for_bit():
    """A replay that takes over another's arrays draws what the other does, and shares none."""
    grid = GRIDS["rooms"]
    first, rng = make_replay(grid, 2, 3), np.random.default_rng(0)
    experience(first, grid, rng, 0.7)
    play(first, grid, rng, 17)
    second = make_replay(grid, 2, 3)
    arrays = {name: array.copy() for name, array in first.arrays_by_name().items()}
    second.restore(arrays)
    state = rng.bit_generator.state
    expected = play(first, grid, rng, 20)
    rng.bit_generator.state = state
    for one, other in zip(expected, play(second, grid, rng, 20), strict=True):
        assert one.tobytes() == other.tobytes()
    kept = arrays["moves"].copy()
    second.moves[:] = 0
    np.testing.assert_array_equal(arrays["moves"], kept)


@pytest.mark.parametrize("name", ["moves", "cells", "landmarks", "visited", "ages"])
def test_arrays_of_another_replay_are_refused_by_name(name):
    """An array of another shape or type is refused by its name."""
    replay = make_replay(GRIDS["rooms"], 2, 3)
    arrays = replay.arrays_by_name()
    for bad in (arrays[name][1:], arrays[name].astype(np.float64)):
        with pytest.raises(ValueError, match=f"^{name} must be "):
            replay.restore({**arrays, name: bad})


# -- one agent's own moves ---------------------------------------------------------------------


def make_own(grid: Grid, n_agents: int, n_landmarks: int, agent: int, **changes: object):
    """Return a replay of one agent that knows nothing yet."""
    spec = network_spec("paper", n_agents, n_landmarks, 4, grid.n_cells, 8, team="independent")
    options = {
        "capacity": 10_000,
        "fresh": 0.7,
        "n_rows": 24,
        "n_tried": 2,
        "temperature": 0.5,
        "exploration": 0.3,
        "from_depot": 0.5,
        "max_length": 12,
        "retries": 0.5,
    }
    return OwnImaginedReplay(spec, grid, agent, **{**options, **changes})


def walk(grid: Grid, n_agents: int, n_landmarks: int, rng: np.random.Generator, n_steps: int):
    """Play random episodes of at most 15 steps; yield (observation, actions, next observation)."""
    step = 0
    for _ in range(n_steps):
        if step == 0:
            landmarks = rng.choice(grid.reachable, n_landmarks, replace=False)
            obs = np.zeros(n_agents + 2 * n_landmarks, np.float32)
            obs[:n_agents], obs[n_agents : n_agents + n_landmarks] = grid.depot, landmarks
        actions = rng.integers(4, size=n_agents)
        next_obs, _, over = step_by_the_rules(grid, obs, actions, "step", n_agents)
        yield obs, actions, next_obs
        step, obs = (0 if over or step == 14 else step + 1), next_obs


def own_round(replay: OwnImaginedReplay, reward, rng):
    """Begin and draw once, with values that are chance."""
    replay.start_over(rng)
    return replay.draw(rng.normal(size=(len(replay.cells), 4)).astype(np.float32), reward, rng)[0]


@pytest.mark.parametrize(
    ("name", "n_agents", "n_landmarks", "agent", "capacity"),
    [
        ("paper", 3, 5, 1, 10_000),
        ("paper", 3, 5, 2, 70),
        ("paper", 1, 1, 0, 10_000),
        ("corridor", 2, 3, 1, 10_000),
        ("rooms", 4, 2, 0, 40),
        ("hall", 3, 6, 0, 100),
    ],
)
@pytest.mark.parametrize("kind", REWARDS)
def test_an_agent_imagines_its_own_moves_by_the_rules(
    name, n_agents, n_landmarks, agent, capacity, kind
):
    """Its own move is one it made, the others' are seen ones; all else is the step kernel's.

    Whatever the memory has forgotten meanwhile, or the episode that was being played.
    """
    grid = GRIDS[name]
    rng = np.random.default_rng([n_agents, n_landmarks])
    replay = make_own(grid, n_agents, n_landmarks, agent, capacity=capacity)
    reward = rewards_for(replay, grid, kind, 0.5)
    own, seen = set(), [set() for _ in range(n_agents)]
    ended = rounds = 0
    for step, (before, actions, after) in enumerate(walk(grid, n_agents, n_landmarks, rng, 400)):
        tell(replay, before, actions[[agent]], after)
        own.add((before[agent], actions[agent], after[agent]))
        for other in range(n_agents):
            seen[other].add((before[other], after[other]))
        if step < 60 or step % 17 or not replay.ready:
            continue
        rounds += 1
        batch = own_round(replay, reward, rng)
        ended += batch.terminated.sum()
        for row, tried in product(range(24), range(2)):
            here, there = batch.observations[row], batch.next_observations[row, tried]
            assert not here[n_agents + n_landmarks :].all()
            assert (here[agent], batch.actions[row, tried, 0], there[agent]) in own
            for other in set(range(n_agents)) - {agent}:
                assert (here[other], there[other]) in seen[other]
            cells = here[:n_agents].astype(int)
            moves = grid.moves[cells] == there[:n_agents, None]  # some action of the others
            moves[agent] = np.arange(4) == batch.actions[row, tried, 0]
            next_obs, expected, terminated = step_by_the_rules(
                grid, here, moves.argmax(axis=1), kind, n_agents
            )
            np.testing.assert_array_equal(there, next_obs)
            assert batch.rewards[row, tried] == 0.5 * expected
            assert batch.terminated[row, tried] == terminated
            # Where landmarks can be, all different, and none that is unvisited under an agent.
            landmarks = here[n_agents : n_agents + n_landmarks].astype(int)
            assert len(set(landmarks.tolist()) - {grid.depot}) == n_landmarks
            assert (here[n_agents + n_landmarks :] >= np.isin(landmarks, cells)).all()
        # The episodes go on from one of the actions tried.
        state = replay.observations()
        assert (state[:, None] == batch.next_observations).all(axis=2).any(axis=1).all()
    assert rounds > 10
    assert ended > 0


@pytest.mark.parametrize("capacity", [10_000, 250])
def test_the_others_go_along_what_was_seen(capacity):
    """From the depot together as in one episode; each on along its stretch, and then another."""
    grid = GRIDS["paper"]
    rng = np.random.default_rng(0)
    replay = make_own(grid, 3, 5, 1, capacity=capacity, from_depot=1.0, max_length=40, retries=0.0)
    first, on, last = set(), [set(), set(), set()], [set(), set(), set()]
    previous = None
    for before, actions, after in walk(grid, 3, 5, rng, 600):
        tell(replay, before, actions[[1]], after)
        begins = previous is None or (previous[1] != before).any()
        if begins:
            first.add((*after[[0, 2]],))
        for other in (0, 2):
            if begins and previous is not None:
                last[other].add((previous[0][other], previous[1][other]))
            elif not begins:
                on[other].add((previous[0][other], before[other], after[other]))
        previous = before, after
    for other in (0, 2):
        last[other].add((previous[0][other], previous[1][other]))
    reward = rewards_for(replay, grid, "step", 1.0)
    came_from = None
    changed = 0
    for _ in range(60):
        ages = replay.ages.copy()
        batch = own_round(replay, reward, rng)
        here, there = batch.observations[:, :3], batch.next_observations[:, 0, :3]
        for row in range(24):
            if (here[row] == grid.depot).all() and replay.ages[row] == 1:
                assert (*there[row, [0, 2]],) in first
            elif came_from is not None and replay.ages[row] == ages[row] + 1:
                for other in (0, 2):
                    if (came_from[row, other], here[row, other], there[row, other]) in on[other]:
                        continue
                    assert (came_from[row, other], here[row, other]) in last[other]
                    changed += 1
        came_from = here
    assert changed > 0


def test_where_a_stretch_ends_any_other_goes_on():
    """What was seen most often from a cell is what an agent there does most often."""
    grid = GRIDS["paper"]
    rng = np.random.default_rng(0)
    replay = make_own(grid, 3, 5, 1, n_rows=4000, from_depot=1.0, max_length=2, retries=0.0)
    seen = np.zeros((3, 49))
    for before, actions, after in walk(grid, 3, 5, rng, 600):
        tell(replay, before, actions[[1]], after)
        for other in (0, 2):
            seen[other, int(after[other])] += before[other] == grid.depot
    replay.start_over(rng)
    replay.moments[:] = UNKNOWN  # as if all had come to the depot at the end of theirs
    batch = own_round(replay, rewards_for(replay, grid, "step", 1.0), rng)
    for other in (0, 2):
        found = np.bincount(batch.next_observations[:, 0, other].astype(int), minlength=49)
        np.testing.assert_allclose(found / 4000, seen[other] / seen[other].sum(), atol=0.04)


def test_nothing_is_imagined_before_a_beginning_is_known():
    """A memory too short for the episode that is played is not ready until the next begins."""
    grid = GRIDS["paper"]
    replay = make_own(grid, 3, 5, 1, capacity=10)
    ready = []
    for before, actions, after in walk(grid, 3, 5, np.random.default_rng(0), 300):
        tell(replay, before, actions[[1]], after)
        begins = (before[:3] == grid.depot).all()
        ready = [replay.ready] if begins else [*ready, replay.ready]
        if len(ready) > 10:
            assert not replay.ready
    assert ready[0]


@pytest.mark.parametrize("fresh", [0.0, 0.6, 1.0])
def test_the_share_of_fresh_landmarks(fresh):
    """Episodes are among the landmarks that the others met there, but for the fresh share."""
    grid = GRIDS["paper"]
    rng = np.random.default_rng(0)
    replay = make_own(
        grid, 3, 5, 1, n_rows=1000, fresh=fresh, from_depot=1.0, max_length=1, retries=0.0
    )
    played = {}
    for before, actions, after in walk(grid, 3, 5, rng, 600):
        tell(replay, before, actions[[1]], after)
        if (before[[0, 1, 2]] == grid.depot).all():
            played.setdefault((*after[[0, 2]],), set()).add(tuple(before[3:8]))
    batch = own_round(replay, rewards_for(replay, grid, "step", 1.0), rng)
    kept = [
        tuple(here[3:8]) in played[(*there[[0, 2]],)]
        for here, there in zip(batch.observations, batch.next_observations[:, 0], strict=True)
    ]
    assert np.mean(kept) == pytest.approx(1.0 - fresh, abs=0.05)


def test_own_episodes_begin_and_begin_again():
    """Those given up begin again from the depot with their landmarks, for a share of them.

    The others begin from the depot with all landmarks unvisited, for a share of these, or anywhere.
    """
    grid = GRIDS["paper"]
    rng = np.random.default_rng(0)
    replay = make_own(
        grid, 3, 5, 1, n_rows=2000, fresh=1.0, from_depot=0.6, max_length=3, retries=0.7
    )
    for before, actions, after in walk(grid, 3, 5, rng, 1000):
        tell(replay, before, actions[[1]], after)
    reward = rewards_for(replay, grid, "step", 1.0)

    def begin():
        rows = replay.start_over(rng)
        at_depot = (replay.cells[rows] == grid.depot).all(axis=1)
        return rows, at_depot & ~replay.visited[rows].any(axis=1)

    rows, from_depot = begin()
    assert len(rows) == 2000
    assert from_depot.mean() == pytest.approx(0.6, abs=0.05)
    assert len(set(replay.cells[~from_depot, 1].tolist())) > 30
    assert set(replay.visited[~from_depot].sum(axis=1).tolist()) >= {0, 1, 2, 3, 4}
    for _ in range(3):
        replay.draw(rng.normal(size=(2000, 4)).astype(np.float32), reward, rng)
    landmarks, solved = replay.landmarks.copy(), replay.visited.all(axis=1)
    assert 0 < solved.sum() < 2000
    rows, from_depot = begin()
    assert len(rows) == 2000
    same = (replay.landmarks == landmarks).all(axis=1)
    assert not same[solved].any()
    assert same[~solved].mean() == pytest.approx(0.7, abs=0.05)
    assert from_depot[same].all()
    assert from_depot[~same].mean() == pytest.approx(0.6, abs=0.07)


@pytest.mark.parametrize("exploration", [0.0, 0.5])
def test_own_best_action_is_tried_first_and_followed(exploration):
    """The best of those the agent made there; a share of the episodes follows any that is tried."""
    grid = GRIDS["paper"]
    rng = np.random.default_rng(0)
    replay = make_own(grid, 3, 5, 1, n_rows=2000, exploration=exploration)
    made = np.zeros((49, 4), bool)
    for before, actions, after in walk(grid, 3, 5, rng, 90):
        tell(replay, before, actions[[1]], after)
        made[int(before[1]), actions[1]] = True
    assert not made[made.any(axis=1)].all()
    reward = rewards_for(replay, grid, "step", 1.0)
    for _ in range(4):
        replay.start_over(rng)
        values = rng.normal(size=(2000, 4)).astype(np.float32)
        batch, _ = replay.draw(values, reward, rng)
        known = made[batch.observations[:, 1].astype(int)]
        best = np.where(known, values, -np.inf).argmax(axis=1)
        np.testing.assert_array_equal(batch.actions[:, 0, 0], best)
        several = known.sum(axis=1) > 1
        np.testing.assert_array_equal(several, batch.actions[:, 1, 0] != best)
        first, second = np.swapaxes(batch.next_observations, 0, 1)
        state, apart = replay.observations(), (first != second).any(axis=1)
        follows = (state == first).all(axis=1)
        assert (follows | (state == second).all(axis=1)).all()
        assert follows[apart].mean() == pytest.approx(1.0 - exploration / 2, abs=0.05)


def test_own_restored_replay_goes_on_bit_for_bit():
    """A replay that takes over another's arrays draws what the other does, and shares none."""
    grid = GRIDS["rooms"]
    reward = relabelled_reward(grid, 3, 2, "manhattan")
    first, rng = make_own(grid, 3, 2, 1, capacity=200), np.random.default_rng(0)
    steps = list(walk(grid, 3, 2, rng, 330))
    for before, actions, after in steps[:300]:
        tell(first, before, actions[[1]], after)
    for _ in range(9):
        own_round(first, reward, rng)
    second = make_own(grid, 3, 2, 1, capacity=200)
    arrays = {name: array.copy() for name, array in first.arrays_by_name().items()}
    second.restore(arrays)
    drawn = []
    for replay in (first, second):
        own = np.random.default_rng(1)
        drawn.append([])
        for before, actions, after in steps[300:]:
            tell(replay, before, actions[[1]], after)
            drawn[-1].extend(array.tobytes() for array in own_round(replay, reward, own))
    assert drawn[0] == drawn[1]
    second.moves[:] = 0
    assert (arrays["moves"] != 0).any()
    for name in ("moments", "begins", "cells"):
        with pytest.raises(ValueError, match=f"^{name} must be "):
            second.restore({**arrays, name: arrays[name][1:]})
