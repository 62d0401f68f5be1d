"""Independent learners: what each is told, what it learns, and how a team is saved."""

import json

import numpy as np
import pytest
import safetensors.torch
import torch

from baselines.independent_dqn import Args, IndependentLearners
from baselines.learning.config import preset_options
from baselines.learning.training import Streams
from baselines.networks import Team, build_network, network_spec, torch_generator, view
from baselines.policies.policy import (
    WEIGHTS_KEY,
    NetworkPolicy,
    header,
    load_policy,
    save_policy,
)
from baselines.policies.settings import Setting, check_fits
from baselines.replay.relabelled import RelabelledReplay, relabelled_reward
from mapp_env import Grid, make_grid, mapp_v0

LEFT, RIGHT, UP, DOWN = range(4)
GRID = make_grid("paper-7x7")
ROWS, COLS = np.divmod(np.arange(49), 7)
MANHATTAN = abs(ROWS[:, None] - ROWS) + abs(COLS[:, None] - COLS)
IMAGINED, GEODESIC = {"replay": "imagined"}, {"network": "geodesic"}
SMALL = {"hidden_units": 16, "code_units": 8, "batch_size": 16}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Keep to one thread, also for what comes after."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def make(preset: str, seed: int = 0, **changes: object) -> IndependentLearners:
    args = preset_options(Args, preset, seed=seed, **{**SMALL, **changes})
    return IndependentLearners(args, GRID, Streams.spawn(seed))


def walk(rng: np.random.Generator, n_steps: int):
    """Play at random by the rules; yield (observation, actions, reward, next, terminated)."""
    moves = np.asarray(GRID.moves)
    cells = np.full(3, GRID.depot)
    landmarks, visited = rng.choice(GRID.reachable, 5, replace=False), np.zeros(5, bool)
    for _ in range(n_steps):
        before = np.concatenate([cells, landmarks, visited]).astype(np.float32)
        actions = rng.integers(4, size=3)
        cells = moves[cells, actions]
        visited = visited | np.isin(landmarks, cells)
        reward = -sum(MANHATTAN[cells, mark].min() for mark in landmarks[~visited])
        after = np.concatenate([cells, landmarks, visited]).astype(np.float32)
        yield before, actions, float(reward), after, bool(visited.all())
        if visited.all():
            cells = np.full(3, GRID.depot)
            landmarks, visited = rng.choice(GRID.reachable, 5, replace=False), np.zeros(5, bool)


def weights_of(learners: IndependentLearners, index: int) -> list[np.ndarray]:
    return [t.numpy().copy() for t in learners.network.members[index].state_dict().values()]


# -- what a learner is told --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("preset", "changes"),
    [("default", {}), ("paper", {}), ("default", IMAGINED), ("default", GEODESIC)],
)
def test_a_learner_never_gets_anothers_action(preset, changes):
    """Whatever the others are said to have done, a learner's replay and weights are the same."""
    one, other = make(preset, **changes), make(preset, **changes)
    rng = np.random.default_rng(1)
    for before, actions, reward, after, over in walk(np.random.default_rng(0), 200):
        changed = np.append(actions[:1], rng.integers(4, size=2))
        one.remember(before, actions, reward, after, over)
        other.remember(before, changed, reward, after, over)
    for _ in range(5):
        one.update(0.1)
        other.update(0.1)
    first, second = one.learners[0].arrays(), other.learners[0].arrays()
    assert first.keys() == second.keys()
    for name, array in first.items():
        np.testing.assert_array_equal(array, second[name], err_msg=name)
    # The others did learn from what they are said to have done themselves.
    for index in (1, 2):
        pairs = zip(weights_of(one, index), weights_of(other, index), strict=True)
        assert any((a != b).any() for a, b in pairs)


def test_learners_are_independent():
    """Each has its own start weights, memory, optimiser and draws; no global generator moves."""
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    team = make("default")
    assert len(team.learners) == len(team.network.members) == 3
    for transition in walk(np.random.default_rng(0), 100):
        team.remember(*transition)
    team.update(0.1)
    drawn = [learner.prepared[0].observations for learner in team.learners]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        pairs = zip(weights_of(team, a), weights_of(team, b), strict=True)
        assert all((x != y).any() for x, y in pairs)
        assert (drawn[a] != drawn[b]).any()
        assert team.learners[a].replay is not team.learners[b].replay
        assert team.learners[a].optimiser is not team.learners[b].optimiser
    assert torch.equal(before[0], torch.get_rng_state())
    np.testing.assert_array_equal(before[1], np.random.get_state()[1])  # noqa: NPY002


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_shared_parameters(preset):
    """One network learns from all agents, each by its own cell first and its own place."""
    team = make(preset, share_parameters=True)
    assert len(team.learners) == len(team.network.members) == 1
    obs = np.array([1, 2, 3, 10, 11, 12, 13, 14, 0, 1, 0, 1, 0], np.float32)
    assert view(obs, 0, team.spec).tolist() == [*obs.tolist(), 1, 0, 0]
    assert view(obs, 2, team.spec)[:3].tolist() == [3, 1, 2]
    assert view(obs, 2, team.spec)[3:].tolist() == [*obs[3:].tolist(), 0, 0, 1]
    transition = next(walk(np.random.default_rng(0), 1))
    team.remember(*transition)
    replay = team.learners[0].replay
    assert len(replay) == 3
    assert replay.arrays.actions[:3, 0, 0].tolist() == transition[1].tolist()
    for agent in range(3):
        stored = replay.arrays.observations[agent]
        np.testing.assert_array_equal(stored, view(transition[0], agent, team.spec))
        next_obs = replay.arrays.next_observations[agent, 0]
        np.testing.assert_array_equal(next_obs, view(transition[3], agent, team.spec))


@pytest.mark.parametrize("kind", ["paper", "pairs"])
@pytest.mark.parametrize("team", ["independent", "shared"])
def test_agents_on_one_cell_can_part(kind, team):
    """Where all stand on the depot each agent has values of its own."""
    spec = network_spec(kind, 3, 5, 4, 49, 16, team=team)
    network = build_network(spec, torch_generator(np.random.SeedSequence(0)))
    obs = torch.tensor([[24.0, 24, 24, 0, 6, 20, 42, 48, 0, 0, 0, 0, 0]])
    with torch.no_grad():
        values = network(obs)
    assert values.shape == (1, 3, 4)
    assert not torch.allclose(values[0, 0], values[0, 1])
    assert not torch.allclose(values[0, 1], values[0, 2])


# -- what a learner learns ---------------------------------------------------------------------


PROBE = {
    "n_agents": 2,
    "n_landmarks": 1,
    "hidden_units": 64,
    "batch_size": 64,
    "learning_rate": 0.003,
    "discount": 0.9,
    "target_interval": 20,
    "memory_size": 2000,
}


@pytest.mark.parametrize("share", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_known_values_of_two_steps(seed, share):
    """The first step leads to the second for nothing; there an agent's own UP brings a half."""
    team = make("paper", seed, share_parameters=share, **PROBE)
    rng = np.random.default_rng(seed)
    states = np.array([[0, 0, 24, 0], [48, 48, 24, 0]], np.float32)
    for _ in range(1000):
        where, actions = rng.integers(2), rng.integers(4, size=2)
        reward = 0.5 * float((actions == UP).sum()) if where else 0.0
        team.remember(states[where], actions, reward, states[1], bool(where))
    for _ in range(500):
        team.update(0.0)
    with torch.no_grad():
        values = team.network(torch.from_numpy(states)).numpy()
    # What the other does is chance: a half, one time out of four.
    last = np.array([0.0, 0.0, 0.5, 0.0]) + 0.125
    for agent in range(2):
        np.testing.assert_allclose(values[1, agent], last, atol=0.12)
        np.testing.assert_allclose(values[0, agent], [0.9 * 0.625] * 4, atol=0.12)


@pytest.mark.parametrize("seed", range(3))
def test_team_reward_teaches_each_agent_its_own_action(seed):
    """Learners that get one reward, by what they see, each find their own best action."""
    team = make("paper", seed, **PROBE)
    rng = np.random.default_rng(seed)
    for _ in range(1500):
        flag = rng.integers(2)
        obs = np.array([0, 0, 24, flag], np.float32)
        actions = rng.integers(4, size=2)
        good = [RIGHT, UP] if flag else [LEFT, DOWN]
        team.remember(obs, actions, float((actions == good).sum()), obs, True)
    for _ in range(500):
        team.update(0.0)
    greedy = [team.act(np.array([0, 0, 24, flag], np.float32)).tolist() for flag in (0, 1)]
    assert greedy == [[LEFT, DOWN], [RIGHT, UP]]


@pytest.mark.parametrize("gap", [0.0, 0.5])
@pytest.mark.parametrize("share", [False, True])
def test_no_target_is_above_what_the_rules_can_bring(share, gap):
    """However high a network's values have become, targets of relabelled transitions are 0 at most.

    Below that they are the reward and the discounted best next value of the target network, less
    a share of what the action falls short of the best one.
    """
    team = make("default", share_parameters=share, action_gap=gap)
    for transition in walk(np.random.default_rng(0), 200):
        team.remember(*transition)
    for learner in team.learners:
        for height in (100.0, -100.0):
            with torch.no_grad():
                learner.target.head.advantages.bias.fill_(height)
            batch, targets = learner.sample(0.0)
            assert (targets <= 0).all()
            targets = targets[..., 0]
            with torch.no_grad():
                best = learner.target(torch.from_numpy(batch.next_observations[:, 0]))[:, 0]
                here = learner.target(torch.from_numpy(batch.observations))[:, 0].numpy()
            best = best.max(dim=1).values.clamp(max=0).numpy()
            going_on = 0.95 * best * ~batch.terminated[:, 0]
            taken = here[np.arange(len(here)), batch.actions[:, 0, 0]]
            expected = batch.rewards[:, 0] + going_on - gap * (here.max(axis=1) - taken)
            np.testing.assert_allclose(targets[:, 0], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize(("progress", "discount"), [(0.0, 0.95), (0.5, 0.98)])
def test_targets_look_ahead_as_far_as_is_said(double, progress, discount):
    """By the final discount in the end; with double DQN along the trained network's choice."""
    team = make("default", double=double, action_gap=0.0)
    other = make("default", seed=1)
    for transition in walk(np.random.default_rng(0), 200):
        team.remember(*transition)
    for learner, slow in zip(team.learners, other.learners, strict=True):
        learner.target.load_state_dict(slow.network.state_dict())
        with torch.no_grad():
            learner.target.head.value.bias.fill_(-5.0)  # below what the rules can bring
        batch, targets = learner.sample(progress)
        next_obs = torch.from_numpy(batch.next_observations[:, 0])
        with torch.no_grad():
            own, values = learner.network(next_obs)[:, 0], learner.target(next_obs)[:, 0]
        assert (own.argmax(1) != values.argmax(1)).any()
        chosen = (own if double else values).argmax(1, keepdim=True)
        follows = discount * values.gather(1, chosen).numpy() * ~batch.terminated
        np.testing.assert_allclose(targets[..., 0], batch.rewards + follows, rtol=1e-5)


@pytest.mark.parametrize("network", ["pairs", "geodesic"])
@pytest.mark.parametrize("gap", [0.0, 0.5])
def test_targets_of_own_imagined_moves(network, gap):
    """Each own action tried gets its reward and the best that follows of those the agent made.

    At most 0, as the rules bring no more; less a share of what the action falls short of the best
    one there, again of those that the agent made.
    """
    team = make("default", network=network, action_gap=gap, **IMAGINED)
    made = [np.zeros((49, 4), bool) for _ in range(3)]
    for before, actions, reward, after, over in walk(np.random.default_rng(0), 60):
        team.remember(before, actions, reward, after, over)
        for agent, table in enumerate(made):
            table[int(before[agent]), actions[agent]] = True
    n_unknown = 0
    for agent, learner in enumerate(team.learners):
        made[agent][~made[agent].any(axis=1)] = True  # nothing else to go by
        for _ in range(3):
            batch, targets = learner.sample(0.0)
            assert targets.shape == batch.actions.shape == (16, 2, 1)
            with torch.no_grad():
                here = learner.target(torch.from_numpy(batch.observations))[:, 0].numpy()
                flat = torch.from_numpy(batch.next_observations.reshape(32, -1))
                there = learner.target(flat)[:, 0].numpy().reshape(16, 2, 4)
            known = made[agent][batch.observations[:, agent].astype(int)]
            next_known = made[agent][batch.next_observations[:, :, agent].astype(int)]
            n_unknown += (~next_known).sum()
            best = np.where(next_known, there, -np.inf).max(axis=2)
            going_on = 0.95 * np.minimum(best, 0) * ~batch.terminated
            taken = np.take_along_axis(here, batch.actions[:, :, 0], axis=1)
            short = np.where(known, here, -np.inf).max(axis=1, keepdims=True) - taken
            expected = batch.rewards + going_on - gap * short
            np.testing.assert_allclose(targets[..., 0], expected, rtol=1e-5, atol=1e-5)
    assert n_unknown > 0


# -- relabelled replay -------------------------------------------------------------------------


@pytest.mark.parametrize("reward", ["manhattan", "geodesic", "step"])
def test_relabelled_transitions_obey_the_rules(reward):
    """Moves are those that were made; flags, reward and end are those of the landmarks given."""
    spec = network_spec("pairs", 3, 5, 4, 49, 16, team="independent")
    replay = RelabelledReplay(spec, GRID.depot, 1000, fresh=0.8, as_far=0.5)
    stored, own = set(), set()
    for before, actions, _, after, _ in walk(np.random.default_rng(0), 1200):
        replay.add(before, actions[:1], np.nan, after, None)
    kept = replay.arrays
    for before, action, after in zip(
        kept.observations, kept.actions[:, 0, 0], kept.next_observations[:, 0], strict=True
    ):
        stored.add((*before[:3], action, *after[:3]))
        own.add(tuple(before[3:8]))
    assert replay.ready
    batch = replay.relabel(
        2000, relabelled_reward(GRID, 3, 5, reward, 0.5), np.random.default_rng(1)
    )
    distances = MANHATTAN if reward == "manhattan" else np.asarray(GRID.distances)
    kept_own = 0
    for row in range(2000):
        before, after = batch.observations[row], batch.next_observations[row, 0]
        assert (*before[:3], batch.actions[row, 0, 0], *after[:3]) in stored
        landmarks = before[3:8].astype(int)
        kept_own += tuple(before[3:8]) in own
        assert len(set(landmarks.tolist())) == 5
        assert GRID.depot not in landmarks
        assert (after[3:8] == landmarks).all()
        here, there = before[:3].astype(int), after[:3].astype(int)
        # Nobody stands on an unvisited landmark, and an episode that is over has no next step.
        assert (before[8:] >= np.isin(landmarks, here)).all()
        assert not before[8:].all()
        visited = (before[8:] > 0) | np.isin(landmarks, there)
        np.testing.assert_array_equal(after[8:], visited)
        assert batch.terminated[row, 0] == visited.all()
        left = landmarks[~visited]
        expected = (
            -float(len(left) > 0)
            if reward == "step"
            else -float(sum(distances[there, mark].min() for mark in left))
        )
        assert batch.rewards[row, 0] == pytest.approx(0.5 * expected)
    assert 0.1 < kept_own / 2000 < 0.4
    assert len({tuple(row[3:8]) for row in batch.observations}) > 1000


def test_drawing_leaves_what_was_experienced_alone():
    """Relabelling changes copies; equal generators draw equal batches."""
    spec = network_spec("pairs", 3, 5, 4, 49, 16, team="independent")
    replay = RelabelledReplay(spec, GRID.depot, 300, fresh=1.0, as_far=0.5)
    for before, actions, _, after, _ in walk(np.random.default_rng(0), 200):
        replay.add(before, actions[:1], np.nan, after, None)
    kept = {name: array.copy() for name, array in replay.arrays_by_name().items()}
    reward = relabelled_reward(GRID, 3, 5, "step")
    first, second = (replay.relabel(50, reward, np.random.default_rng(3)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    for name, array in replay.arrays_by_name().items():
        np.testing.assert_array_equal(array, kept[name])


# -- options -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("outputs", "joint"),
        ("replay", "owned"),
        ("network", "planes"),
        ("share_parameters", 1),
        ("fresh_landmarks", 1.5),
        ("fresh_as_far", float("nan")),
        ("seed", -1),
    ],
)
def test_bad_options_are_refused_by_name(name, value):
    """What one agent by itself cannot have, and what is out of range, is refused by name."""
    with pytest.raises(ValueError, match=f"^{name} must be .*got"):
        Args(**{name: value})


def test_shared_parameters_do_not_imagine():
    """What is imagined is one agent's."""
    with pytest.raises(ValueError, match=r"^share_parameters must be False .*'imagined', got True"):
        Args(share_parameters=True, replay="imagined")


# -- the observation "geodesic" ----------------------------------------------------------------


@pytest.mark.parametrize("team", ["independent", "shared"])
@pytest.mark.parametrize("size", [(2, 3), (3, 5)])
def test_a_network_sees_the_geodesic_observation(team, size):
    """Each agent's network makes of the global observation what the env shows that agent."""
    grid = make_grid("random", rows=6, cols=9, density=0.2, seed=3)
    n_agents, n_landmarks = size
    spec = network_spec(
        "geodesic", n_agents, n_landmarks, 4, 54, 16, team=team, grid=grid.to_text()
    )
    members = build_network(spec).members
    env = mapp_v0.parallel_env(
        grid=grid, n_agents=n_agents, n_landmarks=n_landmarks, observation="geodesic"
    )
    rng = np.random.default_rng(0)
    for seed in range(3):
        obs, _ = env.reset(seed=seed)
        while env.agents:
            for agent, name in enumerate(env.agents):
                given = view(env.state()[None], agent, spec)
                (found,) = members[agent % len(members)].paths(given)
                np.testing.assert_array_equal(found.ravel(), obs[name])
            actions = rng.integers(4, size=n_agents).tolist()
            obs, *_ = env.step(dict(zip(env.agents, actions, strict=True)))


def test_landmarks_are_a_set_to_the_geodesic_network():
    """To rename landmarks changes nothing, nor does it matter where the visited ones stand."""
    spec = network_spec("geodesic", 3, 5, 4, 49, 16, team="independent", grid=GRID.to_text())
    network = build_network(spec, torch_generator(np.random.SeedSequence(0)))
    obs, rng = observations(40), np.random.default_rng(1)
    obs[:, :8] = rng.choice(GRID.reachable, (40, 8))
    renamed, moved = obs.copy(), obs.copy()
    for row in range(40):
        order = rng.permutation(5)
        renamed[row, 3:8], renamed[row, 8:] = obs[row, 3:8][order], obs[row, 8:][order]
        visited = obs[row, 8:] > 0
        moved[row, 3:8][visited] = rng.choice(GRID.reachable, visited.sum())
    with torch.no_grad():
        values, *others = (network(torch.from_numpy(x)) for x in (obs, renamed, moved))
    for other in others:
        torch.testing.assert_close(values, other)
    assert len({tuple(row) for row in values[:, 0].tolist()}) > 30


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"grid": ""}, "grid must be a map, got ''"),
        ({"grid": "D..\n..."}, "grid must have the network's 49 cells, got one of 6"),
        ({"n_cells": 5000}, "n_cells must be an integer in 2..4096, got 5000"),
        ({"team": "one"}, "team must be one of 'independent', 'shared'; got 'one'"),
    ],
)
def test_a_network_on_paths_carries_its_grid(changes, message):
    """It has the network's number of cells, and paths for each agent by itself."""
    right = {"kind": "geodesic", "team": "independent", "grid": GRID.to_text()}
    with pytest.raises(ValueError, match=message):
        network_spec(**{**right, "n_agents": 3, "n_landmarks": 5, "n_actions": 4, "n_cells": 49,
                       "hidden_units": 8, **changes})  # fmt: skip


def test_only_a_network_on_paths_says_its_grid():
    """Any other network has no such field."""
    assert "grid" not in make("default").spec.as_dict()
    with pytest.raises(TypeError, match="grid"):
        network_spec("pairs", 3, 5, 4, 49, 8, grid=GRID.to_text())
    spec = make("default", **GEODESIC).spec
    assert network_spec(**spec.as_dict()) == spec


def test_a_run_on_another_grid_than_its_weights_is_refused(tmp_path):
    """Walls elsewhere, with as many cells: the paths would be wrong."""
    policy = NetworkPolicy(make("default", **GEODESIC).network, GRID)
    check_fits(policy, Setting(GRID), tmp_path)
    text = GRID.to_text().replace("#", ".", 1)
    with pytest.raises(ValueError, match="the grid is another one"):
        check_fits(policy, Setting(Grid.from_text(text)), tmp_path)


# -- saved teams -------------------------------------------------------------------------------


def observations(n: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    cells, flags = rng.integers(49, size=(n, 8)), rng.integers(2, size=(n, 5))
    return np.concatenate([cells, flags], axis=1).astype(np.float32)


@pytest.mark.parametrize(
    ("preset", "changes"), [("default", {}), ("paper", {}), ("default", GEODESIC)]
)
@pytest.mark.parametrize("share", [False, True])
def test_loaded_team_acts_as_the_learners_do(tmp_path, preset, changes, share):
    """One file holds the networks of all agents, and gives the same actions."""
    team = make(preset, share_parameters=share, **changes)
    save_policy(tmp_path / "policy.safetensors", team.policy().network, GRID)
    loaded = load_policy(tmp_path)
    assert loaded.spec == team.spec
    assert isinstance(loaded.network, Team)
    obs = observations(50)
    actions = loaded.act(obs)
    assert actions.shape == (50, 3)
    np.testing.assert_array_equal(actions, [team.act(row) for row in obs])
    with torch.no_grad():
        for agent, member in enumerate(team.network.members):
            if not share and not changes:
                own = member(torch.from_numpy(obs))[:, 0].argmax(dim=1).numpy()
                np.testing.assert_array_equal(actions[:, agent], own)


def test_damaged_teams_are_refused_by_name(tmp_path):
    """A member that is missing, too many, of another shape or not finite is named."""
    team = make("paper").policy().network
    good = {name: tensor.clone() for name, tensor in team.state_dict().items()}
    about = header(team.spec, GRID)
    path = tmp_path / "w"

    def write(tensors, **changes):
        text = json.dumps({**about, "network": {**about["network"], **changes}})
        path.write_bytes(safetensors.torch.save(tensors, {WEIGHTS_KEY: text}))

    write({**good, "members.1.layers.0.bias": torch.full((16,), float("nan"))})
    with pytest.raises(ValueError, match=r"members\.1\.layers\.0\.bias: holds NaN"):
        load_policy(path)
    write({**good, "members.2.layers.0.weight": torch.zeros(16, 12)})
    with pytest.raises(ValueError, match=r"members\.2\.layers\.0\.weight: got .*\(16, 12\)"):
        load_policy(path)
    write({name: t for name, t in good.items() if not name.startswith("members.2.")})
    with pytest.raises(ValueError, match=r"missing .*members\.2\.head"):
        load_policy(path)
    write({**good, "members.3.layers.0.bias": torch.zeros(16)})
    with pytest.raises(ValueError, match=r"unknown .*members\.3\.layers\.0\.bias"):
        load_policy(path)
    for changes in ({"team": "shared"}, {"team": "one"}, {"n_agents": 2}):
        write(good, **changes)
        with pytest.raises(ValueError, match=r"missing|got torch"):
            load_policy(path)
    for changes in ({"team": "crowd"}, {"team": None}, {"outputs": "joint"}):
        write(good, **changes)
        with pytest.raises(ValueError, match=f"{next(iter(changes))} must be one of"):
            load_policy(path)
    write(good, hidden_units=4096, n_agents=16, n_landmarks=200)
    with pytest.raises(ValueError, match=r"would have .* weights .* allowed"):
        load_policy(path)


@pytest.mark.parametrize("as_far", [0.0, 0.2, 1.0])
def test_share_of_fresh_landmarks_visited_as_far(as_far):
    """As many are visited as were in just that share of what is drawn; else any number may be."""
    spec = network_spec("pairs", 3, 5, 4, 49, 16, team="independent")
    replay = RelabelledReplay(spec, GRID.depot, 400, fresh=1.0, as_far=as_far)
    moves = np.asarray(GRID.moves)
    rng, cells = np.random.default_rng(0), np.full(3, GRID.depot)
    marks = [0, 1, 2, 3, 4, 0, 0, 0, 0, 0]  # nothing was ever visited
    for _ in range(400):
        actions = rng.integers(4, size=3)
        there = moves[cells, actions]
        before, after = (np.array([*c, *marks], np.float32) for c in (cells, there))
        replay.add(before, actions[:1], np.nan, after, None)
        cells = there
    batch = replay.relabel(4000, relabelled_reward(GRID, 3, 5, "step"), rng)
    obs = batch.observations
    on = (obs[:, None, :3] == obs[:, 3:8, None]).any(axis=2)
    more = (obs[:, 8:] > on).any(axis=1)  # visited, though nobody stands on it
    assert more.mean() == pytest.approx((1 - as_far) * 0.8, abs=0.05)


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("share", [False, True])
def test_as_much_is_kept_of_each_agent(preset, share):
    """However parameters are shared, so many transitions of every agent are kept."""
    team = make(preset, share_parameters=share, memory_size=50)
    for transition in walk(np.random.default_rng(0), 80):
        team.remember(*transition)
    capacities = [len(learner.replay) for learner in team.learners]
    assert sum(capacities) == 150
    assert len(set(capacities)) == 1


def test_shared_transitions_lead_to_the_same_agents_view():
    """What an agent sees after its move is told from its own place, too."""
    team = make("default", share_parameters=True)
    transition = next(walk(np.random.default_rng(3), 1))
    team.remember(*transition)
    memory = team.learners[0].replay
    for agent in range(3):
        expected = view(transition[3], agent, team.spec)
        np.testing.assert_array_equal(memory.arrays.next_observations[agent, 0], expected)
