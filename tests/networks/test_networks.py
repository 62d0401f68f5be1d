"""What networks promise: symmetries, conventions, start values, and which are refused."""

import dataclasses
from itertools import permutations, product
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch

from baselines.networks import (
    ANY,
    NETWORKS,
    Network,
    NetworkSpec,
    build_network,
    greedy_actions,
    network_spec,
    spec_from_options,
    split_joint,
    torch_generator,
)
from baselines.networks.layers import EmbeddingBag, Head, linear
from baselines.networks.pairs import arrange, between_landmarks, routes
from baselines.policies import load_policy, play
from baselines.policies.policy import save_policy
from mapp_env import Grid, Problem, make_grid

GRID = make_grid("paper-7x7")
KINDS = ("paper", "pairs")
ROUTES = {"landmark_units": 6, "route_units": 5}


def network_of(kind: str, n_agents: int, n_landmarks: int, outputs: str, **changes: object):
    """Return a small network with start values that are chance."""
    if kind == "pairs":
        changes = {"code_units": 8, **changes}
    spec = network_spec(kind, n_agents, n_landmarks, 4, 49, 16, outputs, **changes)
    return build_network(spec, torch_generator(np.random.SeedSequence(n_agents)))


def observations(n: int, n_agents: int, n_landmarks: int) -> np.ndarray:
    """Return global observations in which all cells differ."""
    rng = np.random.default_rng(n_agents)
    cells = rng.random((n, 49)).argsort(axis=1)[:, : n_agents + n_landmarks]
    flags = rng.integers(2, size=(n, n_landmarks))
    return np.concatenate((cells, flags), axis=1).astype(np.float32)


def values_of(network, seen: np.ndarray) -> np.ndarray:
    """Return the values of observations."""
    with torch.no_grad():
        return network(torch.from_numpy(seen)).numpy()


def test_cells_arrive_between_0_and_1():
    """The first cell is 0 to the paper's layers and the last one 1; flags are what they are."""
    network = network_of("paper", 2, 2, "joint")
    seen = []
    network.layers.register_forward_pre_hook(lambda layers, given: seen.append(given[0]))
    values_of(network, np.array([[0, 48, 24, 12, 1, 0]], np.float32))
    np.testing.assert_array_equal(seen[0].numpy(), [[0, 1, 0.5, 0.25, 1, 0]])


# -- symmetries --------------------------------------------------------------------------------


@pytest.mark.parametrize("changes", [{}, {"dueling": True}, ROUTES])
@pytest.mark.parametrize("n_agents", [1, 2, 3, 4])
def test_renaming_agents_renames_joint_values(n_agents, changes):
    """Agents on distinct cells in another order: the same numbers, at the renamed joint actions."""
    network = network_of("pairs", n_agents, 3, "joint", **changes)
    seen = observations(30, n_agents, 3)
    own = values_of(network, seen).reshape(30, *[4] * n_agents)
    for order in permutations(range(n_agents)):
        renamed = seen.copy()
        renamed[:, :n_agents] = seen[:, list(order)]
        others = values_of(network, renamed).reshape(30, *[4] * n_agents)
        # Agent i of the renamed is agent order[i] of the own.
        np.testing.assert_array_equal(others, own.transpose(0, *[1 + agent for agent in order]))
    if n_agents > 1:
        assert not np.array_equal(own, own.swapaxes(1, 2))


@pytest.mark.parametrize("n_agents", [2, 3])
def test_renaming_agents_renames_their_own_values(n_agents):
    """With values for each agent's actions, these follow the agents."""
    network = network_of("pairs", n_agents, 3, "agents")
    seen = observations(30, n_agents, 3)
    own = values_of(network, seen)
    for order in permutations(range(n_agents)):
        renamed = seen.copy()
        renamed[:, :n_agents] = seen[:, list(order)]
        np.testing.assert_array_equal(values_of(network, renamed), own[:, list(order)])
    assert not np.array_equal(own[:, 0], own[:, 1])


@pytest.mark.parametrize("changes", [{}, ROUTES, {"route_units": 5}])
@pytest.mark.parametrize("outputs", ["joint", "agents"])
def test_renaming_landmarks_changes_nothing(outputs, changes):
    """Landmarks in any order, each with its flag, give the same values but for rounding."""
    network = network_of("pairs", 3, 4, outputs, **changes)
    seen = observations(30, 3, 4)
    own = values_of(network, seen)
    for order in permutations(range(4)):
        renamed = seen.copy()
        renamed[:, 3:7], renamed[:, 7:] = seen[:, 3:7][:, order], seen[:, 7:][:, order]
        np.testing.assert_allclose(values_of(network, renamed), own, atol=1e-6)


@pytest.mark.parametrize("changes", [{}, ROUTES, {"route_units": 5}])
@pytest.mark.parametrize("outputs", ["joint", "agents"])
def test_where_visited_landmarks_stand_does_not_matter(outputs, changes):
    """Visited ones may be moved anywhere without a bit of difference; unvisited ones may not."""
    network = network_of("pairs", 3, 4, outputs, **changes)
    seen = observations(60, 3, 4)
    own = values_of(network, seen)
    flags = seen[:, 7:] == 1
    chance = np.random.default_rng(0).integers(49, size=(60, 4))
    moved = seen.copy()
    moved[:, 3:7] = np.where(flags, chance, seen[:, 3:7])
    np.testing.assert_array_equal(values_of(network, moved), own)
    some_left = ~flags.all(axis=1)
    moved[:, 3:7] = np.where(flags, seen[:, 3:7], (seen[:, 3:7] + 1) % 49)
    differs = (values_of(network, moved) != own).reshape(60, -1).any(axis=1)
    np.testing.assert_array_equal(differs, some_left)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("outputs", ["joint", "agents"])
def test_every_number_of_the_observation_counts(kind, outputs):
    """To move an agent or an unvisited landmark, or to visit one, changes the values."""
    network = network_of(kind, 2, 2, outputs)
    start = np.array([[3, 40, 10, 20, 0, 0]], np.float32)
    own = values_of(network, start)
    for place in range(6):
        changed = start.copy()
        changed[0, place] += 1
        assert not np.array_equal(values_of(network, changed), own)


@pytest.mark.parametrize("kind", KINDS)
def test_rows_of_a_batch_do_not_mix(kind):
    """The values of an observation do not depend on its neighbours in the batch."""
    network = network_of(kind, 3, 5, "joint")
    seen = observations(20, 3, 5)
    whole = values_of(network, seen)
    alone = np.concatenate([values_of(network, seen[row : row + 1]) for row in range(20)])
    np.testing.assert_allclose(whole, alone, atol=1e-6)


# -- conventions -------------------------------------------------------------------------------


@pytest.mark.parametrize("n_agents", [1, 2, 3])
def test_joint_actions_are_numbered_as_in_the_central_env(n_agents):
    """The same index makes the same moves in the environment: first agent most significant."""
    env = gymnasium.make("mapp_env/Central-v0", n_agents=n_agents, n_landmarks=1)
    assert env.action_space.n == 4**n_agents
    for index in range(4**n_agents):
        actions = split_joint(np.array([index]), n_agents, 4)[0]
        seen, _ = env.reset(options={"landmarks": [0]})
        # Two rounds: around the depot some of the moves are bumps.
        for _ in range(2):
            expected = GRID.moves[seen[:n_agents].astype(int), actions]
            seen, *_ = env.step(index)
            np.testing.assert_array_equal(seen[:n_agents], expected)
        assert index == int("".join(map(str, actions)), 4)
    env.close()


@pytest.mark.parametrize("n_agents", [1, 2, 3])
def test_greedy_actions_are_those_of_the_highest_values(n_agents):
    """Of joint values the one joint action, of agents' values each agent's own; ties the first."""
    joint = network_spec("paper", n_agents, 1, 4, 9, 8, outputs="joint")
    values = torch.eye(4**n_agents)
    expected = list(product(range(4), repeat=n_agents))
    assert [tuple(row) for row in greedy_actions(values, joint)] == expected
    assert greedy_actions(torch.zeros(1, 4**n_agents), joint).tolist() == [[0] * n_agents]
    agents = network_spec("paper", n_agents, 1, 4, 9, 8)
    values = torch.from_numpy(np.random.default_rng(0).normal(size=(50, n_agents, 4)))
    np.testing.assert_array_equal(greedy_actions(values, agents), values.numpy().argmax(axis=2))


@pytest.mark.parametrize("outputs", ["joint", "agents"])
def test_dueling_values_are_base_plus_advantages_less_their_mean(outputs):
    """The mean over actions is the base alone; differences are those of the advantages."""
    spec = network_spec("paper", 3, 2, 4, 9, 16, outputs, dueling=True)
    head = Head(spec, torch.Generator().manual_seed(0))
    hidden = torch.randn(7, 16, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        values, base = head(hidden), head.value(hidden)
        advantages = head.advantages(hidden).view(values.shape)
    assert values.shape == ((7, 64) if outputs == "joint" else (7, 3, 4))
    assert base.shape == ((7, 1) if outputs == "joint" else (7, 3))
    means = values.mean(dim=-1)
    torch.testing.assert_close(means, base.view(means.shape), atol=1e-6, rtol=0.0)
    expected = advantages - advantages[..., :1]
    torch.testing.assert_close(values - values[..., :1], expected, atol=1e-6, rtol=0.0)
    assert Head(network_spec("paper", 3, 2, 4, 9, 16, outputs), None).value is None


# -- start values ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dueling", [False, True])
def test_start_values_follow_the_seed_and_nothing_else(kind, dueling):
    """One seed one network, another seed another; PyTorch's global generator is not touched."""
    spec = network_spec(kind, 3, 5, 4, 49, 16, "joint", dueling)
    weights = []
    for turn, seed in enumerate((1, 1, 2)):
        torch.manual_seed(turn)
        before = torch.get_rng_state()
        network = build_network(spec, torch_generator(np.random.SeedSequence(seed)))
        assert torch.equal(before, torch.get_rng_state())
        weights.append(network.state_dict())
    one, same, other = weights
    for name, tensor in one.items():
        assert torch.equal(tensor, same[name])
        assert not torch.equal(tensor, other[name])
        assert tensor.isfinite().all()
        assert len(tensor.unique()) > 1 or tensor.numel() == 1


@pytest.mark.parametrize(("n_in", "n_out"), [(13, 512), (40, 3)])
def test_start_values_are_pytorchs(n_in, n_out):
    """A layer starts as torch.nn.Linear does, drawn from a generator of its own."""
    own = linear(n_in, n_out, torch.Generator().manual_seed(7))
    with torch.random.fork_rng():
        torch.manual_seed(7)
        usual = torch.nn.Linear(n_in, n_out)
    torch.testing.assert_close(own.weight, usual.weight)
    torch.testing.assert_close(own.bias, usual.bias)


# -- limits ------------------------------------------------------------------------------------

SMALL = {
    "kind": "paper",
    "n_agents": 3,
    "n_landmarks": 5,
    "n_actions": 4,
    "n_cells": 49,
    "hidden_units": 16,
}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "deep"}, r"^kind must be one of 'paper', 'pairs', 'geodesic'; got 'deep'"),
        ({"n_agents": 0}, r"^n_agents must be .* in 1..16, got 0"),
        ({"n_agents": 17}, r"^n_agents must be .* in 1..16, got 17"),
        ({"n_landmarks": 257}, r"^n_landmarks must be .* got 257"),
        ({"n_actions": 3}, r"^n_actions must be .* got 3"),
        ({"n_actions": 6}, r"^n_actions must be .* got 6"),
        ({"n_cells": 1}, r"^n_cells must be .* got 1"),
        ({"n_cells": 2048 * 2048 + 1}, r"^n_cells must be .* got 4194305"),
        ({"hidden_units": 4097}, r"^hidden_units must be .* got 4097"),
        ({"kind": "pairs", "code_units": 0}, r"^code_units must be .* got 0"),
        ({"kind": "pairs", "code_units": 2.0}, r"^code_units must be .* got 2\.0"),
        ({"kind": "pairs", "route_units": -1}, r"^route_units must be .* got -1"),
        (
            {"kind": "pairs", "n_cells": 400, "route_units": 1},
            r"^kind 'pairs' would have 42,\d{3},\d{3} weights on 400",
        ),
        ({"outputs": "both"}, r"^outputs must be one of 'agents', 'joint'; got 'both'"),
        ({"dueling": 1}, r"^dueling must be True or False, got 1"),
        ({"outputs": "joint", "n_agents": 6}, r"^outputs must be 'agents' for 6 .* 4,096 .* 1,024"),
        ({"outputs": "joint", "n_agents": 5, "n_actions": 5}, r"^outputs must be .* 3,125"),
        ({"kind": "pairs", "n_agents": 6}, r"^n_agents must be .* in 1..5, got 6"),
        (
            {"kind": "pairs", "n_cells": 600},
            r"^kind 'pairs' would have 23,1\d\d,\d{3} weights on 600",
        ),
    ],
)
def test_impossible_networks_are_refused_by_name(changes, message):
    """What no network can be, or would be too large, is refused before anything is allocated."""
    with pytest.raises(ValueError, match=message):
        build_network(network_spec(**{**SMALL, **changes}))


def test_hopeless_sizes_are_refused_at_once():
    """Weights that no machine has room for: counted without any memory for them."""
    spec = network_spec("pairs", 5, 256, 5, 512 * 512, 4096, "agents", True, 4096, 4096, 4096)
    for team in ("one", "independent", "shared"):
        with pytest.raises(ValueError, match=r"would have [\d,]{25} weights"):
            build_network(dataclasses.replace(spec, team=team))


@pytest.mark.parametrize(
    "changes",
    [
        {"outputs": "joint", "n_agents": 5},
        {"kind": "pairs", "outputs": "joint", "n_agents": 5},
        {"kind": "pairs", "n_cells": 556, "code_units": 64},
        {"n_agents": 16, "n_actions": 5},
    ],
)
def test_networks_at_the_limit_can_be_built(changes):
    """The largest that is allowed has the values it should have."""
    spec = network_spec(**{**SMALL, **changes})
    seen = np.zeros((2, spec.observation_size), np.float32)
    assert values_of(build_network(spec), seen).shape == (2, *spec.values_shape)


class CompassSpec(NetworkSpec):
    """Of a network that is a new one, and for grids of any size."""

    kind = "compass"
    any_size = ("n_cells",)


class CompassNetwork(Network):
    """Has one layer, from numbers of cells as they are."""

    spec_type = CompassSpec

    def __init__(self, spec, generator=None):
        super().__init__(spec)
        self.layer = linear(spec.n_inputs, spec.hidden_units, generator)
        self.head = Head(spec, generator)

    def forward(self, observations):
        """Return action values."""
        return self.head(self.layer(observations))


@pytest.mark.parametrize("team", ["one", "independent", "shared"])
def test_a_new_network_is_a_line_in_the_table(monkeypatch, tmp_path, team):
    """With its spec and its place in NETWORKS it is built, saved, loaded and plays on any grid."""
    monkeypatch.setitem(NETWORKS, "compass", CompassNetwork)
    spec = network_spec("compass", 2, 3, 4, ANY, 16, team=team)
    options = SimpleNamespace(n_agents=2, n_landmarks=3, hidden_units=16, dueling=False, more=1)
    assert spec_from_options(options, "compass", GRID, team=team, n_cells=ANY) == spec
    assert dataclasses.replace(spec, n_cells=49) == spec_from_options(
        options, "compass", GRID, team=team
    )
    network = build_network(spec, torch_generator(np.random.SeedSequence(0)))
    save_policy(tmp_path / "weights", network, None)
    policy = load_policy(tmp_path / "weights")
    assert (policy.spec, policy.grid) == (spec, None)
    for name, tensor in network.state_dict().items():
        assert torch.equal(policy.network.state_dict()[name], tensor)
    for rows, cols in ((3, 4), (40, 50)):
        grid = Grid(np.zeros((rows, cols), np.bool_))
        assert len(play(policy, [Problem(grid, (0, 1, 2), 2)], max_cycles=5)) == 1
    with pytest.raises(ValueError, match=r"n_cells must be .* got 0"):
        network_spec("paper", 2, 3, 4, ANY, 16, team=team)


@pytest.mark.parametrize(("n_bags", "n_each"), [(1, 1), (7, 3), (200, 6)])
def test_bags_sum_and_pass_gradients_on_like_pytorchs(n_bags, n_each):
    """Sums and gradients are those of nn.EmbeddingBag, however often a vector is looked up."""
    rng = np.random.default_rng(n_bags)
    own = EmbeddingBag(11, 5, 0.3, torch.Generator().manual_seed(0))
    other = torch.nn.EmbeddingBag.from_pretrained(own.weight.detach().clone(), mode="sum")
    other.weight.requires_grad_()
    indices = torch.from_numpy(rng.integers(11, size=(n_bags, n_each)))
    torch.testing.assert_close(own(indices), other(indices))
    weights = torch.from_numpy(rng.normal(size=(n_bags, 5)).astype(np.float32))
    for bag in (own, other):
        (bag(indices) ** 2 * weights).sum().backward()
    torch.testing.assert_close(own.weight.grad, other.weight.grad)


@pytest.mark.parametrize("sort", [True, False])
def test_what_is_looked_up(sort):
    """By hand: agents in the order of their cells, visited landmarks in the place behind the grid.

    A pair is numbered by the agent's cell and the landmark's; the last pair of each agent is its
    own cell's.
    """
    # Cells 5, 2, 5 of 9; landmarks 3 and 8, the second visited.
    seen = np.array([[5, 2, 5, 3, 8, 0, 1]], np.float32)
    pairs, landmarks, order = arrange(seen, 3, 2, 9, sort)
    assert landmarks.tolist() == [[3, 9]]
    assert order.tolist() == ([[1, 0, 2]] if sort else [[0, 1, 2]])
    five, two = [5 * 11 + 3, 5 * 11 + 9, 5 * 11 + 10], [2 * 11 + 3, 2 * 11 + 9, 2 * 11 + 10]
    assert pairs.tolist() == [[two, five, five] if sort else [five, two, five]]


def test_routes_are_numbered_by_cell_and_pair_of_landmarks():
    """One row for each cell and two landmarks in either order; the last where one is visited."""
    numbers = {}
    for cell, one, other in product(range(4), repeat=3):
        if one == other:
            continue
        seen = np.array([[cell, 3, one, other, 2, 0, 0, 1]], np.float32)
        pairs, landmarks, order = arrange(seen, 2, 3, 4, True)
        rows = routes(pairs, landmarks, 4)  # of the two, of the first and third, of the others
        own = rows[order[0].tolist().index(0)]
        assert own.tolist() == [own[0], 4 * 6, 4 * 6]
        numbers.setdefault((cell, min(one, other), max(one, other)), set()).add(own[0])
    assert all(len(rows) == 1 for rows in numbers.values())
    assert sorted(*zip(*numbers.values(), strict=True)) == list(range(4 * 6))


def test_a_single_landmark_makes_no_pair():
    """It has the row of pairs with a visited landmark, and a network can be built."""
    seen = np.array([[1, 3, 2, 0]], np.float32)
    pairs, landmarks, _ = arrange(seen, 2, 1, 4, True)
    assert routes(pairs, landmarks, 4).tolist() == [[24], [24]]
    network = network_of("pairs", 2, 1, "joint", **ROUTES)
    assert np.isfinite(values_of(network, seen)).all()


def test_landmarks_among_one_another():
    """Row j of each landmark: itself and each landmark, visited ones in the place behind."""
    assert between_landmarks(np.array([[2, 4]]), 4).tolist() == [
        [2 * 5 + 2, 2 * 5 + 4],
        [4 * 5 + 2, 4 * 5 + 4],
    ]


def test_start_values_are_scaled_by_the_inputs():
    """A layer's start values spread evenly up to 1 / sqrt(inputs), as PyTorch's own do."""
    generator = torch.Generator().manual_seed(0)
    for n_in, n_out in ((400, 25), (25, 400)):
        layer = linear(n_in, n_out, generator)
        bound = n_in**-0.5
        for weights in (layer.weight, layer.bias):
            assert weights.abs().max() <= bound
        assert layer.weight.abs().max() > 0.99 * bound
        assert float(layer.weight.detach().std()) == pytest.approx(bound / 3**0.5, rel=0.05)
