"""Policies: what is saved is what is loaded, and nothing else gets in."""

import json
import os
import struct

import numpy as np
import pytest
import safetensors.torch
import torch

from baselines.networks import build_network, network_spec, torch_generator
from baselines.policies.guidance import Guidance, GuidedPolicy
from baselines.policies.policy import (
    WEIGHTS_KEY,
    NetworkPolicy,
    header,
    load_policy,
    save_policy,
)
from baselines.policies.rules_of_thumb import (
    EarliestArrivalPolicy,
    NearestLandmarkPolicy,
    RandomPolicy,
)
from baselines.policies.settings import read_setting
from mapp_env import Grid, make_grid

SPEC = network_spec("paper", 3, 5, 4, 49, 16)
GRID = make_grid()
ABOUT = json.dumps(header(SPEC, GRID))


@pytest.fixture
def network():
    return build_network(SPEC, torch_generator(np.random.SeedSequence(0)))


@pytest.fixture
def weights(network):
    return {name: tensor.clone() for name, tensor in network.state_dict().items()}


def observations(n: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    cells, flags = rng.integers(49, size=(n, 8)), rng.integers(2, size=(n, 5))
    return np.concatenate([cells, flags], axis=1).astype(np.float32)


def write(path, tensors, about=ABOUT):
    path.write_bytes(safetensors.torch.save(tensors, {WEIGHTS_KEY: about} if about else None))
    return path


def test_loaded_policy_acts_like_the_saved_network(tmp_path, network):
    """From a file or from a run folder, actions are each agent's argmax of the same scores."""
    save_policy(tmp_path / "policy.safetensors", network, GRID)
    seen = observations(200)
    with torch.no_grad():
        expected = network(torch.from_numpy(seen)).argmax(dim=-1).numpy()
    for path in (tmp_path, tmp_path / "policy.safetensors", str(tmp_path)):
        actions = load_policy(path).act(seen)
        assert actions.shape == (200, 3)
        np.testing.assert_array_equal(actions, expected)


def test_saving_twice_writes_the_same_bytes(tmp_path, network):
    """The file depends on nothing but the network, and no temporary file stays behind."""
    for name in ("one", "two"):
        save_policy(tmp_path / name, network, GRID)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["one", "two"]


def test_half_precision_rounds_each_weight_and_halves_the_file(tmp_path, network):
    """What is loaded are the weights rounded to 16 bits, but for tensors that do not fit there."""
    with torch.no_grad():
        network.layers[2].bias[3] = 1e6
    save_policy(tmp_path / "whole", network, GRID)
    save_policy(tmp_path / "half", network, GRID, half_precision=True)
    sizes = [(tmp_path / name).stat().st_size for name in ("whole", "half")]
    assert sizes[1] < 0.8 * sizes[0]
    whole, half = (load_policy(tmp_path / name).network.state_dict() for name in ("whole", "half"))
    for name, tensor in whole.items():
        rounded = tensor if name == "layers.2.bias" else tensor.half().float()
        assert half[name].dtype == torch.float32
        assert torch.equal(half[name], rounded)
        assert name == "layers.2.bias" or not torch.equal(tensor, rounded)


def test_start_weights_follow_the_seed():
    """One seed gives one network, another seed another one."""
    one, same, other = (
        build_network(SPEC, torch_generator(np.random.SeedSequence(seed))).state_dict()
        for seed in (1, 1, 2)
    )
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not any(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_weights_that_are_not_finite_are_refused(tmp_path, weights, value):
    """One NaN or infinite weight is enough, and the message names its tensor."""
    weights["layers.2.bias"][3] = value
    with pytest.raises(ValueError, match=r"layers\.2\.bias: holds NaN or infinite"):
        load_policy(write(tmp_path / "w", weights))


def test_weights_of_other_shapes_dtypes_or_names_are_refused(tmp_path, weights):
    """Every deviation from the network's own tensors is refused by the tensor's name."""
    shape = {**weights, "layers.0.weight": torch.zeros(16, 12)}
    with pytest.raises(ValueError, match=r"layers\.0\.weight: got .*\(16, 12\)"):
        load_policy(write(tmp_path / "shape", shape))
    dtype = {**weights, "head.advantages.bias": weights["head.advantages.bias"].double()}
    with pytest.raises(ValueError, match=r"head\.advantages\.bias: got torch\.float64"):
        load_policy(write(tmp_path / "dtype", dtype))
    extra = {**weights, "surprise": torch.zeros(1)}
    with pytest.raises(ValueError, match=r"unknown .*surprise"):
        load_policy(write(tmp_path / "extra", extra))
    del weights["layers.0.bias"]
    with pytest.raises(ValueError, match=r"missing .*layers\.0\.bias"):
        load_policy(write(tmp_path / "missing", weights))


@pytest.mark.parametrize(
    "about",
    [
        None,
        "",
        "{",
        "[1]",
        "[" * 100_000,
        '{"version": 2}',
        '{"version": 2, "grid": "any"}',
        ABOUT.replace('"grid": "', '"grid": "x'),
        ABOUT.replace('"grid": "', '"other": "'),
        ABOUT.replace('"version": 2', '"version": true'),
        ABOUT.replace('"version": 2', '"version": 2.0'),
        ABOUT.replace('"version": 2', '"version": 3'),
        ABOUT.replace("16", "1e999"),
        ABOUT.replace("16", "NaN"),
        ABOUT.replace("16", "999999999"),
        ABOUT.replace('"n_agents": 3', '"n_agents": true'),
        ABOUT.replace('"kind": "paper"', '"kind": "other"'),
        ABOUT.replace("{", '{"n_agents": 3, ', 1),
        ABOUT.replace('"network": {', '"network": {"n_agents": 3, '),
    ],
)
def test_foreign_or_damaged_descriptions_are_refused(tmp_path, weights, about):
    """Weights that do not say which network they are, or say it strangely, are refused."""
    path = write(tmp_path / "w", weights, about)
    with pytest.raises(ValueError, match=str(path)):
        load_policy(path)


def test_damaged_files_are_refused(tmp_path, network):
    """Cut at any length, or with any early byte changed to a brace, a file never loads wrong."""
    save_policy(tmp_path / "good", network, GRID)
    good = (tmp_path / "good").read_bytes()
    path = tmp_path / "bad"
    for length in (0, 1, 7, 8, 9, 100, 1000, len(good) - 1):
        path.write_bytes(good[:length])
        with pytest.raises(ValueError, match="bad"):
            load_policy(path)
    path.write_bytes(good + b"\0")
    with pytest.raises(ValueError, match="damaged"):
        load_policy(path)
    path.write_bytes(struct.pack("<Q", 1 << 62) + good[8:])
    with pytest.raises(ValueError, match="not a safetensors"):
        load_policy(path)
    path.write_bytes(b"\x80\x04\x95 a pickle is refused too" * 10)
    with pytest.raises(ValueError, match="not a safetensors"):
        load_policy(path)


def test_a_zip_is_called_a_zip(tmp_path, network):
    """What other trainers save is named for what it is, and so is what a policy must be."""
    torch.save(network.state_dict(), tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"model\.zip: .*a zip file.*must be a safetensors file"):
        load_policy(tmp_path / "model.zip")


def test_a_policy_has_the_grid_of_its_weights(tmp_path, network):
    """By name, by folder and by file, with or without a config; by default a policy names none."""
    for name in ("pretrained", "pretrained-distilled"):
        assert load_policy(name).grid == make_grid()
    grid = Grid.from_text("\n".join(["D......"] + ["......."] * 6))
    save_policy(tmp_path / "policy.safetensors", network, grid)
    for path in (tmp_path, tmp_path / "policy.safetensors"):
        assert load_policy(path).grid == grid
    assert NetworkPolicy(network).grid is None


@pytest.mark.parametrize("device", ["nowhere", "cpu:x", "cuda:77"])
def test_devices_that_are_not_there_are_refused(device):
    """Unknown to PyTorch, or not on this machine."""
    with pytest.raises(ValueError, match=f"^device must be one that PyTorch has.*{device}"):
        load_policy("pretrained", device)
    assert load_policy("pretrained", "cpu").network.device.type == "cpu"


def test_weights_and_their_grid_fit_together(tmp_path, network, weights):
    """A grid of another number of cells is neither written nor read, nor is any grid at all."""
    for grid, said in ((Grid.from_text("D.."), "one of 3"), (None, "any grid")):
        message = f"grid must have the network's 49 cells, got {said}"
        with pytest.raises(ValueError, match=message):
            save_policy(tmp_path / "w", network, grid)
        text = "any" if grid is None else grid.to_text()
        about = json.dumps({**json.loads(ABOUT), "grid": text})
        with pytest.raises(ValueError, match=message):
            load_policy(write(tmp_path / "w", weights, about))


def test_weights_of_before_say_what_they_lack(tmp_path, weights):
    """The first version knew no grid: refused by name, with what would do."""
    about = json.dumps({"version": 1, **SPEC.as_dict()})
    with pytest.raises(ValueError, match=r"w: .*do not say which grid .*'grid'.* train again"):
        load_policy(write(tmp_path / "w", weights, about))


def test_missing_and_irregular_files_are_refused(tmp_path):
    """No file, an empty folder and a pipe are refused at once."""
    os.mkfifo(tmp_path / "pipe")
    for name in ("nothing", "", "pipe"):
        with pytest.raises(ValueError, match=r"regular file|run folder or a weights file"):
            load_policy(tmp_path / name)


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros(13, np.float32),
        np.zeros((2, 12), np.float32),
        np.full((1, 13), np.nan, np.float32),
        np.full((1, 13), 49, np.float32),
        np.full((1, 13), -1, np.float32),
        np.full((1, 13), 0.5, np.float32),
        np.full((1, 13), 2, np.float32),
        np.array([["a"] * 13]),
        [[0.0] * 13, [0.0] * 12],
        [[0.0] * 12 + [[1.0]]],
        [[None] * 13],
        None,
    ],
)
def test_observations_the_env_cannot_give_are_refused(network, bad):
    """Wrong shapes, ragged rows, cells off the grid and flags that are none: refused by name."""
    grid = make_grid("paper-7x7")
    chance = RandomPolicy(3, 4, np.random.default_rng(0))
    guidance = Guidance(grid, 3, 5, 3)
    for policy in (
        NetworkPolicy(network),
        NearestLandmarkPolicy(grid, 3, 5),
        EarliestArrivalPolicy(grid, 3, 5),
        GuidedPolicy(chance, guidance, 1.0, np.random.default_rng(0)),
    ):
        with pytest.raises(ValueError, match=r"^observations must"):
            policy.act(bad)


@pytest.mark.parametrize("bad", [[[1.0], [1.0, 2.0]], np.zeros(13), None, 5, [["a"]]])
def test_random_policy_wants_rows(bad):
    """Who looks at nothing still refuses what is no row for each problem."""
    with pytest.raises(ValueError, match=r"^observations must"):
        RandomPolicy(3, 4, np.random.default_rng(0)).act(bad)


def test_random_policy_takes_every_action_equally_often():
    """Over many draws each action has its quarter."""
    policy = RandomPolicy(3, 4, np.random.default_rng(0))
    actions = policy.act(observations(4000))
    assert actions.shape == (4000, 3)
    np.testing.assert_allclose(np.bincount(actions.ravel()) / actions.size, 0.25, atol=0.02)


def test_nearest_landmark_policy_comes_one_step_nearer():
    """Every agent's move takes it one step nearer to the unvisited landmark nearest to it."""
    grid = make_grid("paper-7x7")
    rng = np.random.default_rng(0)
    free = np.append(grid.reachable, grid.depot)
    cells = rng.choice(free, (500, 3))
    landmarks = np.array([rng.permutation(grid.reachable)[:5] for _ in range(500)])
    visited = rng.random((500, 5)) < 0.5
    visited[np.arange(500), rng.integers(5, size=500)] = False
    seen = np.concatenate([cells, landmarks, visited], axis=1).astype(np.float32)
    actions = NearestLandmarkPolicy(grid, 3, 5).act(seen)
    for row in range(500):
        left = landmarks[row][~visited[row]]
        for agent in range(3):
            here = cells[row, agent]
            there = grid.moves[here, actions[row, agent]]
            nearest = grid.distances[here, left].min()
            if nearest:
                assert grid.distances[there, left].min() == nearest - 1


@pytest.mark.parametrize("path", [None, 5, b"x", [], "a" * 5000, "a\0b", object()])
def test_what_is_no_path_is_refused_by_name(path):
    """Anything that is not the path of a file or folder is a ValueError that stays short."""
    with pytest.raises(ValueError, match=r"^path must be a run folder or a weights file") as error:
        load_policy(path)
    assert len(str(error.value)) < 200


def test_largest_network_can_be_loaded_again(tmp_path):
    """The most units, agents, landmarks and actions that a spec allows fit under the cap."""
    spec = network_spec("paper", 16, 256, 5, 512 * 512, 4096)
    network = build_network(spec, torch_generator(np.random.SeedSequence(0)))
    save_policy(tmp_path / "w", network, Grid(np.zeros((512, 512), np.bool_)))
    assert load_policy(tmp_path / "w").spec == spec


def test_of_equally_near_landmarks_the_first_given_is_taken():
    """An agent between two landmarks walks to the one that comes first, visited ones left out."""
    policy = NearestLandmarkPolicy(Grid.from_text("..D.."), 1, 3)
    for landmarks, visited, action in (
        ([0, 4, 3], [0, 0, 1], 0),
        ([4, 0, 3], [0, 0, 1], 1),
        ([3, 1, 4], [0, 0, 0], 1),
        ([4, 1, 3], [0, 0, 0], 0),
        ([3, 1, 4], [1, 0, 0], 0),
    ):
        seen = np.array([[2, *landmarks, *visited]], np.float32)
        assert policy.act(seen).tolist() == [[action]]


def test_one_large_weight_keeps_its_tensors_precision(tmp_path, network):
    """In half precision a tensor with a value that 16 bits have no room for is kept as it is."""
    with torch.no_grad():
        network.layers[0].weight[0, 0] = 1e6
    save_policy(tmp_path / "policy.safetensors", network, GRID, half_precision=True)
    loaded = load_policy(tmp_path).network.state_dict()
    for name, tensor in network.state_dict().items():
        expected = tensor if name == "layers.0.weight" else tensor.half().float()
        assert torch.equal(loaded[name], expected), name


def test_flags_are_0_or_1(network):
    """A landmark that is visited by half is refused, though it lies between what is allowed."""
    seen = observations(1)
    assert NetworkPolicy(network).act(seen).shape == (1, 3)
    for place in range(8, 13):
        seen = observations(1)
        seen[0, place] = 0.5
        with pytest.raises(ValueError, match="visited flags 0 or 1"):
            NetworkPolicy(network).act(seen)


def test_training_problems_have_the_runs_landmarks(tmp_path):
    """A config whose problems have more or fewer landmarks than its options say is refused."""
    options = {"n_agents": 3, "n_landmarks": 3, "max_cycles": 50}
    grid = make_grid("paper-7x7").to_text()
    for problem in ([0, 6], [0, 6, 20], [0, 6, 20, 42]):
        config = {"grid": grid, "options": options, "training_problems": [problem]}
        (tmp_path / "config.json").write_text(json.dumps(config))
        if len(problem) == 3:
            assert read_setting(tmp_path)[1] == [(0, 6, 20)]
        else:
            with pytest.raises(ValueError, match=r"training_problems\[0\]: must have 3 landmarks"):
                read_setting(tmp_path)
