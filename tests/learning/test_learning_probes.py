"""Probes: tasks so small that every value is known, each learned by the real learner."""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import pytest
import torch

from baselines.learning.config import preset_options
from baselines.learning.q_learning import chosen_values, joint_values, next_values, td_targets
from baselines.learning.training import Streams, Training
from baselines.meta_dqn import Args, MetaLearner
from baselines.networks import network_spec
from mapp_env import Grid
from mapp_env.engine.rules import step_row
from mapp_env.engine.state import new_rows, split
from mapp_env.engine.world import make_world

LEFT, RIGHT, UP, DOWN = range(4)
SQUARE = Grid.from_text("D..\n...\n...")
NETWORKS = ("paper", "pairs")
CLOSE = 0.1  # how near a learned value comes to a known one of the order of 1
every_seed = pytest.mark.parametrize("seed", range(3))
both_networks = pytest.mark.parametrize("network", NETWORKS)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Keep to one thread: the networks are tiny."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


class Transition(NamedTuple):
    """What the learner is told of one step."""

    observation: Sequence[float]
    actions: Sequence[int]
    reward: float
    next_obs: Sequence[float]
    terminated: bool


def all_actions(observation, rewards, next_obs, terminated) -> list[Transition]:
    """Return a step of one agent for each of its actions."""
    return [
        Transition(observation, [action], reward, next_obs, terminated)
        for action, reward in enumerate(rewards)
    ]


def options(**changes: object) -> Args:
    """Return options of a small and quick learner."""
    start = {
        "n_agents": 1,
        "n_landmarks": 1,
        "hidden_units": 32,
        "code_units": 8,
        "learning_rate": 0.02,
        "learning_rate_falls": True,
        "batch_size": 32,
        "target_interval": 5,
        "discount": 0.5,
    }
    return preset_options(Args, "paper", **{**start, **changes})


def learned(
    seed: int, transitions: Sequence[Transition], updates: int = 110, **changes: object
) -> MetaLearner:
    """Return a learner that was told transitions, and learned from them."""
    learner = MetaLearner(options(**changes), SQUARE, Streams.spawn(seed))
    for observation, actions, reward, next_obs, terminated in transitions:
        learner.remember(
            np.array(observation, np.float32),
            np.array(actions),
            reward,
            np.array(next_obs, np.float32),
            terminated,
        )
    for update in range(updates):
        learner.update(update / updates)
    return learner


def values_of(learner: MetaLearner, *observations: Sequence[float]) -> np.ndarray:
    """Return the learned values, without the axis of agents where there is only one."""
    with torch.no_grad():
        values = learner.network(torch.tensor(observations, dtype=torch.float32))
    return values.numpy().squeeze(1) if values.shape[1] == 1 else values.numpy()


# -- what is learned ---------------------------------------------------------------------------


@every_seed
@both_networks
def test_value(network, seed):
    """One state, reward 1, then it ends: every action is worth 1."""
    here = (0, 8, 0)
    learner = learned(seed, all_actions(here, [1.0] * 4, here, True), 60, network=network)
    np.testing.assert_allclose(values_of(learner, here), [[1.0] * 4], atol=CLOSE)


@every_seed
@both_networks
def test_value_depends_on_the_observation(network, seed):
    """States that differ in an agent's cell, a landmark's cell or a flag differ in value."""
    states = {(0, 8, 0): 1.0, (6, 8, 0): -1.0, (0, 2, 0): 0.5, (0, 8, 1): -0.5}
    transitions = [
        transition
        for state, value in states.items()
        for transition in all_actions(state, [value] * 4, state, True)
    ]
    learner = learned(seed, transitions, network=network)
    expected = [[value] * 4 for value in states.values()]
    np.testing.assert_allclose(values_of(learner, *states), expected, atol=CLOSE)


@every_seed
@pytest.mark.parametrize(
    "variant",
    [
        {"network": "paper"},
        {"network": "pairs"},
        {"network": "paper", "double": True},
        {"network": "pairs", "dueling": True},
        {"network": "pairs", "outputs": "joint", "double": True, "dueling": True},
    ],
    ids=lambda variant: "-".join(str(value) for value in variant.values()),
)
def test_two_steps_are_discounted(variant, seed):
    """A reward of 1 one step later is worth the discount factor, beside what comes at once."""
    first, second = (0, 8, 0), (4, 8, 0)
    transitions = all_actions(first, [0.25] * 4, second, False) + all_actions(
        second, [1.0, 0.0, -1.0, 0.0], second, True
    )
    learner = learned(seed, transitions, **variant)
    expected = [[0.25 + 0.5 * 1.0] * 4, [1.0, 0.0, -1.0, 0.0]]
    np.testing.assert_allclose(values_of(learner, first, second), expected, atol=CLOSE)


@every_seed
@both_networks
def test_action_decides(network, seed):
    """Each action gets its own value, and the best one is taken."""
    here, rewards = (0, 8, 0), [-1.0, 0.0, 1.0, 0.5]
    learner = learned(seed, all_actions(here, rewards, here, True), network=network)
    np.testing.assert_allclose(values_of(learner, here), [rewards], atol=CLOSE)
    assert learner.act(np.array(here, np.float32)).tolist() == [UP]


@every_seed
@pytest.mark.parametrize(
    "variant",
    [
        {"network": "paper"},
        {"network": "pairs"},
        {"network": "paper", "dueling": True},
        {"network": "pairs", "double": True},
    ],
    ids=lambda variant: "-".join(str(value) for value in variant.values()),
)
def test_observation_and_action_decide_together(variant, seed):
    """What is right in one state is wrong in the other: neither of the two alone says anything."""
    states = {(0, 8, 0): [1.0, -1.0, 1.0, -1.0], (6, 8, 0): [-1.0, 1.0, -1.0, 1.0]}
    transitions = [
        transition
        for state, rewards in states.items()
        for transition in all_actions(state, rewards, state, True)
    ]
    learner = learned(seed, transitions, **variant)
    np.testing.assert_allclose(values_of(learner, *states), [*states.values()], atol=CLOSE)


@every_seed
@both_networks
def test_truncation_goes_on_and_termination_does_not(network, seed):
    """Reward 1 in the same state for ever is worth 2 at discount 1/2; where it ends there, 1."""
    cut, ended = (0, 8, 0), (6, 8, 0)
    transitions = all_actions(cut, [1.0] * 4, cut, False) + all_actions(
        ended, [1.0] * 4, ended, True
    )
    learner = learned(seed, transitions, network=network)
    expected = [[2.0] * 4, [1.0] * 4]
    np.testing.assert_allclose(values_of(learner, cut, ended), expected, atol=1.5 * CLOSE)


@every_seed
def test_end_of_an_episode_leaks_nothing(seed):
    """Values learned in real episodes of two steps, most of them timed out, are the known ones.

    The landmark is two moves to the right of the depot, a step costs 1. A time-out that did not
    go on, or that went on from the state after the reset, would give other values; and so would
    the last state of an episode followed by the first one of the next.
    """
    grid = Grid.from_text("D..")
    args = options(
        network="pairs",
        max_cycles=2,
        reward="step",
        epsilon_start=1.0,
        epsilon_end=1.0,
        guidance_start=0.0,
        guidance_end=0.0,
        n_problems=1,
        episodes_per_problem=450,
        learning_starts=200,
        update_interval=3,
    )
    learner = MetaLearner(args, grid, Streams.spawn(seed))
    training = Training(args, grid, np.array([[2]]), learner)
    while not training.finished:
        training.advance()
    at_depot, beside = -1.0, 0.0  # the best of each
    bump_at_depot, bump_beside = -1.0 + 0.5 * at_depot, -1.0 + 0.5 * beside
    expected = [
        [bump_at_depot, -1.0 + 0.5 * beside, bump_at_depot, bump_at_depot],
        [-1.0 + 0.5 * at_depot, 0.0, bump_beside, bump_beside],
    ]
    learned_values = values_of(learner, (0, 2, 0), (1, 2, 0))
    np.testing.assert_allclose(learned_values, expected, atol=1.5 * CLOSE)


@every_seed
@both_networks
@pytest.mark.parametrize("outputs", ["joint", "agents"])
def test_joint_action_is_credited(outputs, network, seed):
    """A reward for one joint action only is the value of that one, with an output for each.

    With outputs for each agent's actions, an agent learns what its action is worth on average
    over the other's: here, a quarter for its part of the right one, as the other one does its
    own a quarter of the time.
    """
    here, right = (8, 3, 4, 0), (DOWN, LEFT)
    transitions = [
        Transition(here, actions, float(actions == right), here, True)
        for actions in product(range(4), repeat=2)
    ]
    learner = learned(
        seed,
        # Each of the 16 often enough in a batch, so that averages are what they should be.
        transitions,
        updates=80,
        network=network,
        outputs=outputs,
        n_agents=2,
        batch_size=256,
    )
    (values,) = values_of(learner, here)
    if outputs == "joint":
        expected = np.zeros(16)
        expected[4 * DOWN + LEFT] = 1.0
    else:
        expected = np.zeros((2, 4))
        expected[0, DOWN] = expected[1, LEFT] = 0.25
    np.testing.assert_allclose(values, expected, atol=CLOSE)
    assert learner.act(np.array(here, np.float32)).tolist() == list(right)


@every_seed
def test_only_joint_values_see_that_agents_must_agree(seed):
    """Reward for equal actions: joint values are exact, those of agents all the same quarter."""
    here = (8, 3, 4, 0)
    transitions = [
        Transition(here, actions, float(actions[0] == actions[1]), here, True)
        for actions in product(range(4), repeat=2)
    ]
    common = {"updates": 80, "network": "pairs", "n_agents": 2, "batch_size": 256}
    joint = learned(seed, transitions, outputs="joint", **common)
    np.testing.assert_allclose(values_of(joint, here), [np.eye(4).ravel()], atol=CLOSE)
    agents = learned(seed, transitions, outputs="agents", **common)
    np.testing.assert_allclose(values_of(agents, here), [[[0.25] * 4] * 2], atol=CLOSE)


# -- values of the rules themselves ------------------------------------------------------------


def optimal_values(
    grid: Grid, n_agents: int, landmarks: Sequence[int], discount: float
) -> dict[tuple[int, ...], np.ndarray]:
    """Return the values of all joint actions in all states of -1 a step, by the step kernel."""
    n_landmarks = len(landmarks)
    world = make_world(grid, n_agents, n_landmarks)
    outcomes = {}
    for cells in product([grid.depot, *grid.reachable.tolist()], repeat=n_agents):
        for flags in product((0, 1), repeat=n_landmarks):
            on = [landmark in cells for landmark in landmarks]
            if all(flags) or any(there and not flag for there, flag in zip(on, flags, strict=True)):
                continue
            for actions in product(range(4), repeat=n_agents):
                row = new_rows(1, n_agents, n_landmarks)[0]
                head = split(row, n_agents, n_landmarks).head
                head[:] = [*cells, *landmarks, *flags]
                reward, terminated, _ = step_row(row, np.array(actions), 10**6, world)
                next_obs = tuple(head.tolist())
                outcomes.setdefault((*cells, *landmarks, *flags), []).append(
                    (reward, None if terminated else next_obs)
                )
    values = {state: np.zeros(len(outcomes[state])) for state in outcomes}
    for _ in range(40):
        values = {
            state: np.array(
                [
                    reward + (0.0 if after is None else discount * values[after].max())
                    for reward, after in steps
                ]
            )
            for state, steps in outcomes.items()
        }
    return values


@every_seed
def test_imagined_replay_learns_the_values_of_the_rules(seed):
    """What is learned from imagined transitions is what dynamic programming over the rules gives.

    The only moves told are each cell's four, once; the values are of states never seen.
    """
    grid = Grid.from_text("D..\n.#.")
    args = options(
        network="pairs",
        outputs="joint",
        replay="imagined",
        reward="step",
        # All actions from all states, to know the values of the bad ones as well.
        tried_actions=4,
        imagined_from_depot=0.2,
        imagined_exploration=1.0,
        imagined_retries=0.0,
        temperature=100.0,
        hidden_units=64,
        code_units=32,
        batch_size=64,
    )
    learner = MetaLearner(args, grid, Streams.spawn(seed))
    tell_every_move(learner, grid)
    updates = 300
    for update in range(updates):
        learner.update(update / updates)
    for landmark in grid.reachable.tolist():
        known = optimal_values(grid, 1, (landmark,), 0.5)
        values = values_of(learner, *known)
        np.testing.assert_allclose(values, [*known.values()], atol=0.15)


def tell_every_move(learner: MetaLearner, grid: Grid) -> None:
    """Let the learner experience each move from each cell, all agents making the same."""
    n, rest = learner.spec.n_agents, [0] * (2 * learner.spec.n_landmarks)
    for cell in [grid.depot, *grid.reachable.tolist()]:
        for action in range(4):
            learner.remember(
                np.array([*[cell] * n, *rest], np.float32),
                np.array([action] * n),
                0.0,
                np.array([*[grid.moves[cell, action]] * n, *rest], np.float32),
                False,
            )


# -- the parts, by hand ------------------------------------------------------------------------


def test_targets_of_joint_values_by_hand():
    """Reward plus discounted value, and the reward alone after a termination, to 1e-6."""
    rewards = torch.tensor([-0.7, 0.0, -0.2, 0.3])
    # Terminated; timed out, which is stored as neither; neither; terminated with a reward.
    terminated = torch.tensor([True, False, False, True])
    values = torch.tensor([5.0, -2.0, 0.6, -8.0])
    targets = td_targets(rewards, terminated, values, 0.9)
    np.testing.assert_allclose(targets.numpy(), [-0.7, -1.8, 0.34, 0.3], atol=1e-6)
    targets = td_targets(rewards, terminated, torch.stack([values, -values], dim=1), 0.9)
    expected = [[-0.7, -0.7], [-1.8, 1.8], [0.34, -0.74], [0.3, 0.3]]
    np.testing.assert_allclose(targets.numpy(), expected, atol=1e-6)


def test_next_values_of_joint_actions_by_hand():
    """The best of all, of those known, or of what another network picks; two agents, 16 values."""
    values = torch.arange(16.0)[None] / 10
    chooser = -values
    everything = np.ones((1, 2, 4), np.bool_)
    assert next_values(values, values, None).tolist() == pytest.approx([1.5], abs=1e-6)
    assert next_values(values, values, everything).tolist() == pytest.approx([1.5], abs=1e-6)
    assert next_values(values, chooser, None).tolist() == pytest.approx([0.0], abs=1e-6)
    # The first agent may go left or up, the second right or up: joint actions 1, 2, 9 and 10.
    known = np.array([[[1, 0, 1, 0], [0, 1, 1, 0]]], np.bool_)
    assert next_values(values, values, known).tolist() == pytest.approx([1.0], abs=1e-6)
    assert next_values(values, chooser, known).tolist() == pytest.approx([0.1], abs=1e-6)


def test_next_values_of_agents_by_hand():
    """Each agent has its own best, of those it may take, and as the other network picks."""
    values = torch.tensor([[[1.0, 4.0, 2.0, 3.0], [-1.0, -4.0, -2.0, -3.0]]])
    known = np.array([[[1, 0, 1, 0], [0, 1, 1, 1]]], np.bool_)
    for chooser, allowed, expected in (
        (values, None, [[4.0, -1.0]]),
        (-values, None, [[1.0, -4.0]]),
        (values, known, [[2.0, -2.0]]),
        (-values, known, [[1.0, -4.0]]),
    ):
        best = next_values(values, chooser, allowed)
        np.testing.assert_allclose(best.numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("n_agents", [1, 2, 3])
def test_chosen_values_by_hand(n_agents):
    """The value of joint action (a, b, c) stands at 16 a + 4 b + c; agents have theirs apart."""
    rng = np.random.default_rng(n_agents)
    actions = rng.integers(4, size=(6, 5, n_agents))
    spec = network_spec("paper", n_agents, 1, 4, 9, 8, outputs="joint")
    values = rng.normal(size=(6, 4**n_agents)).astype(np.float32)
    chosen = chosen_values(torch.from_numpy(values), torch.from_numpy(actions), spec)
    for state, tried in product(range(6), range(5)):
        place = int("".join(map(str, actions[state, tried])), 4)
        assert chosen[state, tried].item() == values[state, place]
    spec = network_spec("paper", n_agents, 1, 4, 9, 8, outputs="agents")
    values = rng.normal(size=(6, n_agents, 4)).astype(np.float32)
    chosen = chosen_values(torch.from_numpy(values), torch.from_numpy(actions), spec)
    for state, tried, agent in product(range(6), range(5), range(n_agents)):
        assert (
            chosen[state, tried, agent].item() == values[state, agent, actions[state, tried, agent]]
        )


def test_joint_values_of_agents_are_their_sums():
    """What a joint action is worth to agents with values of their own is the sum of them."""
    values = torch.tensor([[[1.0, 2.0, 3.0, 4.0], [10.0, 20.0, 30.0, 40.0], [0.1, 0.2, 0.3, 0.4]]])
    whole = joint_values(values, network_spec("paper", 3, 1, 4, 9, 8))[0]
    for a, b, c in product(range(4), repeat=3):
        expected = (a + 1) + 10 * (b + 1) + 0.1 * (c + 1)
        assert whole[16 * a + 4 * b + c].item() == pytest.approx(expected, abs=1e-5)
    spec = network_spec("paper", 3, 1, 4, 9, 8, outputs="joint")
    assert joint_values(whole, spec) is whole


@pytest.mark.parametrize("double", [False, True])
def test_prepared_targets_by_hand(double):
    """A learner's targets: scaled rewards, the target network's values, double its own choice."""
    states = np.array([(cell, 8, flag) for cell in range(9) for flag in (0, 1)], np.float32)
    transitions = [
        Transition(
            here, [action], -float(action), states[(5 * index + action) % 18], index % 3 == 0
        )
        for index, here in enumerate(states)
        for action in range(4)
    ]
    learner = learned(0, transitions, 0, double=double, reward_scale=0.3, discount=0.9)
    other = MetaLearner(learner.args, SQUARE, Streams.spawn(1))
    learner.target.load_state_dict(other.network.state_dict())
    batch, targets = learner.sample(0.0)
    next_obs = torch.from_numpy(batch.next_observations[:, 0])
    with torch.no_grad():
        own, slow = (
            network(next_obs)[:, 0].numpy() for network in (learner.network, other.network)
        )
    best = (own if double else slow).argmax(axis=1)
    assert (own.argmax(axis=1) != slow.argmax(axis=1)).any()  # so that it matters
    follows = np.where(batch.terminated[:, 0], 0.0, 0.9 * slow[np.arange(len(best)), best])
    np.testing.assert_allclose(batch.rewards[:, 0], -0.3 * batch.actions[:, 0, 0], rtol=1e-6)
    expected = batch.rewards[:, 0] + follows
    np.testing.assert_allclose(targets[:, 0, 0].numpy(), expected, atol=1e-6)
