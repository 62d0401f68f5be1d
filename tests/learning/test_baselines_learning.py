"""The parts a learner is made of: targets, memory, guidance, acting, and that they learn."""

import copy
import functools
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch

from baselines import meta_dqn
from baselines.independent_dqn import Args as IndependentArgs
from baselines.independent_dqn import IndependentLearners
from baselines.learning import q_learning as q_learner
from baselines.learning.config import parse_options, preset_options, without_effect
from baselines.learning.training import Streams, Training, training_problems
from baselines.meta_dqn import Args, MetaLearner
from baselines.networks import build_network, network_spec, torch_generator
from baselines.policies.guidance import Guidance, GuidedPolicy, LinearSchedule
from baselines.replay.stored import Batch, ReplayMemory
from mapp_env import Grid, make_grid

LEFT, RIGHT, UP, DOWN = range(4)
SQUARE = Grid.from_text("D..\n...\n...")


def paper_learner(seed: int, n_agents: int, **changes: object) -> MetaLearner:
    """Return a small learner of the paper's kind on a grid of nine cells, with one landmark."""
    options = {"n_agents": n_agents, "n_landmarks": 1, "hidden_units": 64, **changes}
    args = preset_options(Args, "paper", **options)
    return MetaLearner(args, SQUARE, Streams.spawn(seed))


def small_network(n_agents: int, seed: int, hidden_units: int = 64):
    spec = network_spec("paper", n_agents, 1, 4, 9, hidden_units)
    return build_network(spec, torch_generator(np.random.SeedSequence(seed)))


def weights(network: torch.nn.Module) -> list[torch.Tensor]:
    return [*network.parameters()]


# -- targets -----------------------------------------------------------------------------------


def test_targets_equal_hand_computed_ones():
    """Termination cuts the future off, truncation and neither do not; each agent has its own."""
    next_scores = torch.tensor(
        [[[1.0, 4.0, 2.0, 3.0], [-1.0, -4.0, -2.0, -3.0]]] * 3, dtype=torch.float32
    )
    rewards = torch.tensor([-7.0, 0.0, -2.0])
    # A time-out is stored as "not terminated", like a step in the middle of an episode.
    terminated = torch.tensor([False, True, False])
    best = q_learner.next_values(next_scores, next_scores, None)
    targets = q_learner.td_targets(rewards, terminated, best, 0.95)
    expected = [[-7 + 0.95 * 4, -7 - 0.95], [0, 0], [-2 + 0.95 * 4, -2 - 0.95]]
    np.testing.assert_allclose(targets.numpy(), expected, atol=1e-6)


def test_update_is_the_gradient_of_the_huber_loss_of_the_chosen_scores():
    """One update returns the mean Huber loss of the chosen scores, and is Adam's step down it."""
    learner = paper_learner(0, 2, discount=0.9, batch_size=8)
    learner.target.load_state_dict(small_network(2, 1).state_dict())
    rng = np.random.default_rng(0)
    for _ in range(20):
        learner.remember(
            rng.integers(0, 2, 4).astype(np.float32),
            rng.integers(0, 4, 2),
            3 * rng.normal(),
            rng.integers(0, 2, 4).astype(np.float32),
            rng.random() < 0.5,
        )
    batch = learner.replay.sample(8, copy.deepcopy(learner.rng))
    network = copy.deepcopy(learner.network)
    with torch.no_grad():
        next_scores = learner.target(torch.from_numpy(batch.next_observations[:, 0])).numpy()
    scores = network(torch.from_numpy(batch.observations))
    losses = []
    for row in range(8):
        for agent in range(2):
            goal = float(batch.rewards[row, 0])
            if not batch.terminated[row, 0]:
                goal += 0.9 * next_scores[row, agent].max()
            error = (scores[row, agent, batch.actions[row, 0, agent]] - goal).abs()
            losses.append(0.5 * error**2 if error < 1 else error - 0.5)
    assert min(losses) < 0.5 < max(losses)  # both the square and the line
    by_hand = sum(losses) / len(losses)
    optimiser = torch.optim.Adam(network.parameters(), lr=0.001)
    by_hand.backward()
    optimiser.step()
    before = {name: tensor.clone() for name, tensor in learner.target.state_dict().items()}
    assert learner.update(0.0) == pytest.approx(by_hand.item(), abs=1e-6)
    for name, expected in network.state_dict().items():
        torch.testing.assert_close(
            learner.network.state_dict()[name], expected, atol=1e-5, rtol=0.0
        )
    assert all(torch.equal(before[name], t) for name, t in learner.target.state_dict().items())


@pytest.mark.parametrize("seed", range(3))
def test_two_step_chain_learns_its_known_scores(seed):
    """State 0 leads to state 1 for nothing, which ends with 1 for one action and 0 for others."""
    learner = paper_learner(seed, 1, learning_rate=0.003, discount=0.9, target_interval=20)
    states = np.array([[0, 0, 0], [8, 0, 0]], np.float32)
    for where in range(2):
        for action in range(4):
            reward = float(where == 1 and action == UP)
            learner.remember(states[where], np.array([action]), reward, states[1], where == 1)
    for _ in range(400):
        learner.update(0.0)
    with torch.no_grad():
        scores = learner.network(torch.from_numpy(states))[:, 0].numpy()
    np.testing.assert_allclose(scores, [[0.9] * 4, [0, 0, 1, 0]], atol=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_team_reward_teaches_each_agent_its_own_action(seed):
    """Agents that share one reward, which depends on what they see, find their own best action."""
    learner = paper_learner(seed, 2, learning_rate=0.003, batch_size=64)
    rng = np.random.default_rng(seed)
    for _ in range(3000):
        flag = rng.integers(2)
        observation = np.array([0, 0, 0, flag], np.float32)
        actions = rng.integers(4, size=2)
        # The best actions are (LEFT, DOWN) without the flag, (RIGHT, UP) with it.
        good = [RIGHT, UP] if flag else [LEFT, DOWN]
        learner.remember(observation, actions, float((actions == good).sum()), observation, True)
    for _ in range(500):
        learner.update(0.0)
    greedy = [learner.act(np.array([0, 0, 0, flag], np.float32)).tolist() for flag in (0, 1)]
    assert greedy == [[LEFT, DOWN], [RIGHT, UP]]


def fill(learner: MetaLearner) -> None:
    """Tell a learner of some moves that are chance."""
    rng = np.random.default_rng(0)
    size = learner.spec.observation_size
    for _ in range(40):
        observation, next_obs = rng.integers(0, 2, (2, size)).astype(np.float32)
        actions = rng.integers(4, size=learner.spec.n_agents)
        learner.remember(observation, actions, -1.0, next_obs, False)


def test_step_size_rises_and_falls():
    """It rises over the warm-up in equal parts, and falls in a straight line to nothing."""

    def rates(**changes):
        learner = paper_learner(0, 1, batch_size=4, learning_rate=0.01, **changes)
        fill(learner)
        seen = []
        for update in range(5):
            learner.update(update / 5)
            seen += [group["lr"] for group in learner.optimiser.param_groups]
        return pytest.approx(seen)

    assert rates() == [0.01] * 5
    assert rates(learning_rate_falls=True) == [0.01, 0.008, 0.006, 0.004, 0.002]
    assert rates(learning_rate_warmup=4) == [0.0025, 0.005, 0.0075, 0.01, 0.01]
    both = {"learning_rate_warmup": 4, "learning_rate_falls": True}
    assert rates(**both) == [0.0025, 0.004, 0.0045, 0.004, 0.002]


@pytest.mark.parametrize("decay", [0.0, 0.3])
def test_weights_decay_with_the_step_size(decay):
    """What no gradient reaches shrinks by the step size times the decay, and only so."""
    learner = paper_learner(0, 1, batch_size=4, learning_rate=0.1, weight_decay=decay)
    fill(learner)
    scores = learner.network.layers[0]
    with torch.no_grad():
        scores.weight[0], scores.bias[0] = 0.0, -100.0  # a unit that is never on
    last = learner.network.layers[2].weight
    start = last[:, 0].detach().clone()
    for _ in range(3):
        learner.update(0.0)
    torch.testing.assert_close(last[:, 0].detach(), start * (1 - 0.1 * decay) ** 3)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_target_network_starts_as_a_copy(preset):
    """Of the meta-agent and of each learner of its own."""
    meta = MetaLearner(preset_options(Args, preset), SQUARE, Streams.spawn(0))
    team = IndependentLearners(preset_options(IndependentArgs, preset), SQUARE, Streams.spawn(0))
    for learner in (meta, *team.learners):
        assert all(map(torch.equal, weights(learner.target), weights(learner.network)))


def test_target_network_is_copied_or_follows():
    """It is a copy every so many updates, or moves by its rate towards the network at each."""
    learner = paper_learner(0, 1, batch_size=4, target_interval=3)
    fill(learner)
    for update in range(1, 8):
        before = [tensor.clone() for tensor in weights(learner.target)]
        learner.update(0.0)
        expected = weights(learner.network) if update % 3 == 0 else before
        assert all(map(torch.equal, weights(learner.target), expected))
        assert not torch.equal(before[0], weights(learner.network)[0])
    learner = paper_learner(0, 1, batch_size=4, target_interval=0, target_rate=0.2)
    fill(learner)
    for _ in range(3):
        before = [tensor.clone() for tensor in weights(learner.target)]
        learner.update(0.0)
        for old, new, own in zip(
            before, weights(learner.target), weights(learner.network), strict=True
        ):
            torch.testing.assert_close(new, 0.8 * old + 0.2 * own.detach())


@pytest.mark.parametrize("gap", [0.0, 0.5])
def test_imagined_goal_changes_when_it_is_said_to(gap):
    """Up to a part of the training it is the env's reward, from then on the final one.

    From the targets a share is taken of what the action falls short of the best one there.
    """
    args = Args(
        action_gap=gap,
        n_agents=1,
        n_landmarks=1,
        hidden_units=8,
        code_units=4,
        batch_size=64,
        tried_actions=4,
        imagined_length=2,
        discount=0.5,
        final_discount=0.75,
        final_from=0.4,
    )
    grid = Grid.from_text("D....")
    learner = MetaLearner(args, grid, Streams.spawn(0))
    for cell in range(5):
        for action in range(4):
            here, there = ([at, 0, 0] for at in (cell, grid.moves[cell, action]))
            learner.remember(
                np.array(here, np.float32), np.array([action]), 0.0, np.array(there), False
            )
    for progress, scale, discount in ((0.0, 0.1, 0.5), (0.39, 0.1, 0.5), (0.4, 0.333, 0.75)):
        batch, targets = learner.sample(progress)
        cells, landmarks = batch.next_observations[..., 0], batch.next_observations[..., 1]
        distances = abs(cells - landmarks)
        missing = distances if progress < 0.4 else (distances > 0).astype(np.float32)
        # The landmark under an agent may have been visited before it came: no rewards then.
        missing = np.where(batch.terminated, 0.0, missing)
        np.testing.assert_allclose(batch.rewards, -scale * missing, rtol=1e-6)
        assert len(np.unique(batch.rewards)) > 1
        with torch.no_grad():
            next_obs = torch.from_numpy(batch.next_observations.reshape(-1, 3))
            best = learner.target(next_obs).max(dim=1).values.numpy().reshape(64, 4)
            here = learner.target(torch.from_numpy(batch.observations)).numpy()
        expected = batch.rewards + np.where(batch.terminated, 0.0, discount * best)
        taken = np.take_along_axis(here, batch.actions[:, :, 0], axis=1)
        expected -= gap * (here.max(axis=1, keepdims=True) - taken)
        np.testing.assert_allclose(targets.numpy(), expected, atol=1e-6)


class Praising(torch.nn.Module):
    """A network that thinks nothing better than moves that nobody has made."""

    def __init__(self, network, learner):
        super().__init__()
        self.network, self.moves, self.spec = network, learner.replay.moves, learner.spec

    def forward(self, observations):
        """Return the network's values, those of joint actions with such a move raised."""
        n = self.spec.n_agents
        unmade = self.moves[observations[:, :n].numpy().astype(int)] < 0  # (B, N, A)
        unmade[unmade.all(axis=2)] = False  # where none has been made, any may be
        if self.spec.outputs == "joint":
            digits = np.array(list(np.ndindex(*[4] * n)))
            unmade = unmade[:, np.arange(n), digits].any(axis=2)
        return self.network(observations) + 100.0 * torch.from_numpy(unmade)


def imagining(outputs, double, **others):
    """Return a learner that knows some of the moves."""
    changes = {"n_agents": 2, "n_landmarks": 2, "hidden_units": 8, "code_units": 4}
    changes |= {"batch_size": 64, "imagined_length": 6, **others}
    args = Args(outputs=outputs, double=double, **changes)
    learner = MetaLearner(args, SQUARE, Streams.spawn(0))
    rng = np.random.default_rng(1)
    for cell, action in np.argwhere(rng.random((9, 4)) < 0.6):
        here, there = (np.array([at, at, 0, 0, 0, 0]) for at in (cell, SQUARE.moves[cell, action]))
        learner.remember(here, np.array([action] * 2), 0.0, there, False)
    return learner


@pytest.mark.parametrize("outputs", ["joint", "agents"])
@pytest.mark.parametrize("double", [False, True])
def test_moves_that_nobody_has_made_are_worth_nothing(outputs, double, same):
    """Whatever a network thinks of them, they change no imagined transition and no target."""
    plain, praising = imagining(outputs, double), imagining(outputs, double)
    assert (plain.replay.moves < 0).any()
    praising.target = Praising(praising.target, praising)
    praising.network = Praising(praising.network, praising)
    for _ in range(12):
        expected, found = plain.sample(0.0), praising.sample(0.0)
        same(tuple(found[0]), tuple(expected[0]))
        torch.testing.assert_close(found[1], expected[1])


@pytest.mark.parametrize("outputs", ["joint", "agents"])
@pytest.mark.parametrize("replay", ["imagined", "stored"])
def test_targets_are_the_target_networks_alone(outputs, replay, same):
    """But for double DQN what is prepared does not depend on the network that is trained."""
    batches = []
    for start in (0, 1):
        learner = imagining(outputs, False, replay=replay)
        other = MetaLearner(learner.args, SQUARE, Streams.spawn(start))
        learner.network.load_state_dict(other.network.state_dict())
        prepared = [learner.sample(0.0) for _ in range(4)]
        batches.append([(*batch, targets.numpy()) for batch, targets in prepared])
    same(*batches)


@pytest.mark.parametrize("outputs", ["joint", "agents"])
def test_double_dqn_in_imagination(outputs):
    """The next action is the trained network's choice, and its value the target network's."""
    learner = imagining(outputs, True, action_gap=0.0)
    learner.replay.moves[:] = SQUARE.moves
    other = MetaLearner(learner.args, SQUARE, Streams.spawn(1))
    learner.target.load_state_dict(other.network.state_dict())
    batch, targets = learner.sample(0.0)
    next_obs = torch.from_numpy(batch.next_observations)
    with torch.no_grad():
        own, slow = (
            network(next_obs.flatten(0, 1)).unflatten(0, next_obs.shape[:2])
            for network in (learner.network, learner.target)
        )
    assert (own.argmax(-1) != slow.argmax(-1)).any()  # so that it matters
    best = slow.gather(-1, own.argmax(-1, keepdim=True))[..., 0]  # (B, T), of agents (B, T, N)
    shape = (*batch.rewards.shape, *[1] * (best.dim() - 2))
    ended = torch.from_numpy(batch.terminated).view(shape)
    expected = torch.where(ended, 0.0, learner.goal(0.0).discount * best)
    torch.testing.assert_close(targets, expected + torch.from_numpy(batch.rewards).view(shape))


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_learner_acts_like_the_policy_that_is_kept(preset):
    """Greedy actions are those of the trained network, whatever the target network thinks."""
    args = preset_options(Args, preset, n_agents=2, n_landmarks=2, hidden_units=8)
    learner = MetaLearner(args, SQUARE, Streams.spawn(0))
    other = MetaLearner(args, SQUARE, Streams.spawn(1))
    learner.target.load_state_dict(other.network.state_dict())
    seen = np.random.default_rng(0).integers(0, 2, (40, 6)).astype(np.float32)
    acted = np.array([learner.act(row) for row in seen])
    np.testing.assert_array_equal(acted, learner.policy().act(seen))
    assert (acted != other.policy().act(seen)).any()


# -- memory ------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_added", [1, 4, 5, 6, 23])
def test_memory_keeps_the_newest_and_forgets_the_oldest(n_added):
    """After any number of additions the memory holds the last ones, whole rows, in ring order."""
    memory = ReplayMemory(5, 3, 2)
    for i in range(n_added):
        memory.add(np.full(3, i), np.array([i, i + 1]), -i, np.full(3, i + 0.5), i % 3 == 0)
    kept = list(range(max(0, n_added - 5), n_added))
    assert len(memory) == len(kept)
    for i in kept:
        row = Batch(*(array[i % 5] for array in memory.arrays))
        assert row.observations.tolist() == [i] * 3
        assert row.actions.tolist() == [[i, i + 1]]
        assert row.rewards.tolist() == [-i]
        assert row.next_observations.tolist() == [[i + 0.5] * 3]
        assert row.terminated.tolist() == [i % 3 == 0]
    drawn = memory.sample(1000, np.random.default_rng(0))
    assert set(-drawn.rewards[:, 0].astype(int)) == set(kept)
    assert (drawn.observations[:, :1] == -drawn.rewards).all()


def test_memory_sample_is_a_copy_and_follows_its_generator():
    """Two equal generators draw the same rows; writing into a batch leaves the memory alone."""
    memory = ReplayMemory(50, 2, 1)
    for i in range(50):
        memory.add(np.full(2, i), np.array([0]), 0.0, np.full(2, i), False)
    one = memory.sample(20, np.random.default_rng(3))
    two = memory.sample(20, np.random.default_rng(3))
    np.testing.assert_array_equal(one.observations, two.observations)
    one.observations[:] = -1
    assert (memory.arrays.observations >= 0).all()


def test_empty_memory_and_bad_capacity_are_refused():
    """There is nothing to draw from an empty memory, and none without room."""
    with pytest.raises(ValueError, match="empty"):
        ReplayMemory(3, 2, 1).sample(1, np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"capacity must be .* got 0"):
        ReplayMemory(0, 2, 1)


# -- guidance ----------------------------------------------------------------------------------


def pointed(text: str, cell: int, landmarks: list[int], visited: list[int], reach: int) -> int:
    guidance = Guidance(Grid.from_text(text), 1, len(landmarks), reach)
    observation = np.array([[cell, *landmarks, *visited]], np.float32)
    return int(guidance.directions(observation)[0, 0])


@pytest.mark.parametrize(
    ("landmark", "action"), [(10, LEFT), (14, RIGHT), (2, UP), (22, DOWN), (16, -1), (12, -1)]
)
def test_guidance_points_where_the_paper_says(landmark, action):
    """An agent is directed left if there is an unvisited, close landmark at the left; and so on."""
    text = "\n".join(["....."] * 2 + ["..D.."] + ["....."] * 2)
    assert pointed(text, 12, [landmark], [0], reach=3) == action
    assert pointed(text, 12, [landmark], [1], reach=3) == -1  # visited: nobody is directed


def test_guidance_sees_neither_far_nor_through_walls_nor_around_the_border():
    """Close means within reach, in a straight line, with no wall between, in the same row."""
    assert pointed("D....", 0, [3], [0], reach=3) == RIGHT
    assert pointed("D....", 0, [4], [0], reach=3) == -1
    assert pointed("D.#.\n....", 0, [3], [0], reach=3) == -1
    assert pointed("..D\n...", 2, [3], [0], reach=3) == -1  # cell 3 begins the next row


def test_guidance_prefers_the_nearest_landmark():
    """The nearest landmark wins, equally near ones in the order of the actions."""
    assert pointed("...D...", 3, [0, 5], [0, 0], reach=3) == RIGHT
    assert pointed("...D...", 3, [0, 5], [0, 1], reach=3) == LEFT
    assert pointed("...D...", 3, [5, 1], [0, 0], reach=3) == LEFT


def test_guidance_obeys_its_influence():
    """Influence 0 changes nothing, 1 all pointed agents and only them, 0.3 about three in ten."""
    grid = make_grid("paper-7x7")
    guidance = Guidance(grid, 3, 5, 3)
    rng = np.random.default_rng(0)
    observations = np.concatenate(
        [rng.choice(grid.reachable, (4000, 8)), rng.integers(0, 2, (4000, 5))], axis=1
    ).astype(np.float32)
    directions = guidance.directions(observations)
    actions = rng.integers(4, size=(4000, 3))

    class Fixed:
        def act(self, observations):
            return actions

    assert (GuidedPolicy(Fixed(), guidance, 0.0, rng).act(observations) == actions).all()
    guided = GuidedPolicy(Fixed(), guidance, 1.0, rng).act(observations)
    assert (guided == np.where(directions >= 0, directions, actions)).all()
    guided = guidance.apply(np.full_like(actions, -5), observations, 0.3, rng)
    assert np.mean(guided[directions >= 0] != -5) == pytest.approx(0.3, abs=0.03)


def test_schedule_goes_straight_to_its_end_and_stays():
    """A schedule starts at its start, falls in equal parts, and never leaves its end value."""
    schedule = LinearSchedule(1.0, 0.1, 90)
    values = [schedule(time) for time in range(200)]
    assert values[0] == 1.0
    np.testing.assert_allclose(np.diff(values[:91]), -0.01)
    assert set(values[90:]) == {0.1}
    assert LinearSchedule(1.0, 0.5, 0)(0) == 0.5


# -- acting and the loop -----------------------------------------------------------------------


class Recorder(MetaLearner):
    """Learns nothing, and keeps what it was told and what it would have done."""

    ready = False

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.told = []

    def remember(self, observation, actions, reward, next_observation, terminated):
        """Keep the actions beside the greedy ones."""
        self.told.append((np.array(actions), self.act(observation)))


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("epsilon", [0.0, 0.4])
def test_epsilon_is_tossed_for_each_agent(preset, epsilon):
    """Without exploration every agent takes its greedy action; with it, each explores alone."""
    args = preset_options(
        Args,
        preset,
        n_agents=2,
        n_landmarks=1,
        hidden_units=16,
        epsilon_start=epsilon,
        epsilon_end=epsilon,
        guidance_start=0.0,
        guidance_end=0.0,
        n_problems=1,
        episodes_per_problem=1000,
    )
    learner = Recorder(args, SQUARE, Streams.spawn(0))
    training = Training(args, SQUARE, np.array([[8]]), learner)
    while len(learner.told) < 3000:
        training.advance()
    taken, greedy = (np.array(side) for side in zip(*learner.told, strict=True))
    other = taken != greedy
    assert other.mean(axis=0) == pytest.approx(epsilon * 3 / 4, abs=0.04)
    assert other.all(axis=1).mean() == pytest.approx((epsilon * 3 / 4) ** 2, abs=0.03)


def test_loop_stores_what_happened():
    """Stored transitions chain, and are terminated only where every landmark is visited."""
    args = preset_options(
        Args,
        "paper",
        max_cycles=12,
        n_landmarks=2,
        hidden_units=8,
        memory_size=1000,
        n_problems=3,
        episodes_per_problem=8,
    )
    grid = make_grid("paper-7x7")
    problems = np.array([[17, 30], [0, 48], [25, 31]])
    learner = MetaLearner(args, grid, Streams.spawn(0))
    training = Training(args, grid, problems, learner)
    rows = []
    while not training.finished:
        row = training.advance()
        rows += [row] if row else []
    memory = learner.replay
    stored = Batch(*(array[: len(memory)] for array in memory.arrays))
    next_obs, terminated = stored.next_observations[:, 0], stored.terminated[:, 0]
    assert [row["episode"] for row in rows] == list(range(1, 25))
    assert training.now.steps == sum(row["steps"] for row in rows) == len(memory)
    all_visited = next_obs[:, -2:].all(axis=1)
    np.testing.assert_array_equal(terminated, all_visited)
    assert ((stored.rewards[:, 0] == 0) == all_visited).all()
    # Nothing is stored of the way from an episode's last state to the next one's first.
    begins = np.cumsum([0, *(row["steps"] for row in rows)])
    assert (stored.observations[begins[:-1], :3] == grid.depot).all()
    inside = np.setdiff1d(np.arange(1, len(memory)), begins)
    np.testing.assert_array_equal(stored.observations[inside], next_obs[inside - 1])
    starts = np.repeat(problems, 8, axis=0)
    np.testing.assert_array_equal(stored.observations[begins[:-1], 3:5], starts)
    ends = terminated[begins[1:] - 1]
    assert [row["solved"] for row in rows] == ends.astype(int).tolist()
    assert 0 < all_visited.sum() == ends.sum() < 24  # both ends occur: visited, and out of time
    moves = np.asarray(grid.moves)
    np.testing.assert_array_equal(
        moves[stored.observations[:, :3].astype(int), stored.actions[:, 0]], next_obs[:, :3]
    )


@pytest.mark.parametrize(
    ("preset", "due", "starts"),
    [
        ("paper", {"update_interval": 4}, 50),
        ("paper", {"update_interval": 4}, 48),
        ("default", {"updates_per_episode": 5}, 50),
        ("default", {"updates_per_episode": 5}, 54),  # with the last step of an episode
    ],
)
def test_updates_come_when_they_are_due(preset, due, starts):
    """One every so many steps or so many after each episode, none before learning starts.

    It starts with the step of that number, not with the next one.
    """
    args = preset_options(
        Args,
        preset,
        n_problems=1,
        episodes_per_problem=6,
        hidden_units=8,
        code_units=4,
        batch_size=4,
        learning_starts=starts,
        max_cycles=18,  # no multiple of 4: an episode's steps are not all steps
        **due,
    )
    problems = np.array([[0, 6, 20, 42, 48]])
    grid = make_grid("paper-7x7")
    training = Training(args, grid, problems, MetaLearner(args, grid, Streams.spawn(0)))
    steps = 0
    while not training.finished:
        row = training.advance()
        if row is None:
            continue
        before, steps = steps, steps + row["steps"]
        if preset == "paper":
            due_steps = range(-(-starts // 4) * 4, steps + 1, 4)
            expected = sum(step > before for step in due_steps)
        else:
            expected = 5 * (steps >= starts)
        assert row["updates"] == expected
        assert (row["loss"] == "") == (expected == 0)
    assert training.learner.updates > 0


class Noting(MetaLearner):
    """Learns nothing, and keeps how much of the training was said to be over at each update."""

    ready = True

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.progress = []

    def update(self, progress):
        """Keep it, and return how many there were."""
        self.progress.append(progress)
        return float(len(self.progress))


def rows_and_progress(preset, **changes):
    """Return the options and rows of a training in which nothing is learned, and its progress."""
    options = {"n_problems": 2, "episodes_per_problem": 3, "max_cycles": 10, "learning_starts": 1}
    args = preset_options(Args, preset, hidden_units=8, **{**options, **changes})
    problems = np.array([[0, 6, 20, 42, 48], [0, 6, 20, 42, 47]])
    learner = Noting(args, make_grid(), Streams.spawn(0))
    training = Training(args, make_grid(), problems, learner)
    rows = []
    while not training.finished:
        row = training.advance()
        rows += [row] if row else []
    return args, rows, learner.progress


def test_progress_rises_evenly():
    """An episode's updates are spread evenly over it: step sizes fall in a straight line."""
    _, _, progress = rows_and_progress("default", updates_per_episode=5)
    assert progress == pytest.approx([update / 30 for update in range(30)])


def test_a_row_has_the_mean_loss_of_its_updates():
    """With losses 1, 2, 3 ... and five updates an episode: 3, 8, 13 ..."""
    _, rows, _ = rows_and_progress("default", updates_per_episode=5)
    assert [row["loss"] for row in rows] == [3.0, 8.0, 13.0, 18.0, 23.0, 28.0]


def test_no_two_draw_from_one_stream():
    """Start weights, training problems, exploration and replay each have random numbers apart."""
    args = Args(hidden_units=8)
    streams = Streams.spawn(args.seed)
    learner = MetaLearner(args, make_grid(), streams)
    problems = training_problems(args, make_grid())
    training = Training(args, make_grid(), problems, learner)
    own = [np.random.default_rng(stream).random() for stream in streams]
    assert len(set(own)) == len(streams)
    drawn = {generator.random() for generator in (training.rng, learner.rng)}
    assert len(drawn & set(own)) == 2


def test_a_row_has_the_influences_of_its_episode():
    """Epsilon as at the episode's last step, guidance as in the whole of it."""
    changes = {"epsilon_start": 1.0, "epsilon_end": 0.0, "epsilon_steps": 60}
    guided = {"guidance_start": 0.6, "guidance_end": 0.0, "guidance_fraction": 1.0}
    _, rows, _ = rows_and_progress("paper", **changes, **guided)
    last = np.cumsum([row["steps"] for row in rows]) - 1
    assert [row["epsilon"] for row in rows] == pytest.approx(1.0 - last / 60)
    assert [row["guidance"] for row in rows] == pytest.approx([0.6, 0.5, 0.4, 0.3, 0.2, 0.1])


def test_guidance_is_that_of_the_episode():
    """Where all obey in the first episode and nobody in the second, just that is played."""
    args = preset_options(
        Args,
        "paper",
        guidance_start=1.0,
        guidance_end=0.0,
        guidance_fraction=0.5,
        n_problems=1,
        episodes_per_problem=2,
        max_cycles=40,
    )
    learner = Recorder(args, make_grid(), Streams.spawn(0))
    training = Training(args, make_grid(), np.array([[17, 22, 25, 31, 48]]), learner)
    obeyed = []
    while not training.finished:
        first, seen = not training.now.episodes, training.observation[None]
        training.advance()
        directions = training.guidance.directions(seen)[0]
        taken = learner.told[-1][0]
        obeyed += [(first, same) for same in (taken == directions)[directions >= 0].tolist()]
    assert all(same for first, same in obeyed if first)
    assert not all(same for first, same in obeyed if not first)
    assert len({first for first, _ in obeyed}) == 2


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_training_leaves_the_global_generators_alone(preset):
    """Neither NumPy's nor PyTorch's global generator moves, whatever is trained."""
    args = preset_options(
        Args,
        preset,
        n_problems=1,
        episodes_per_problem=2,
        hidden_units=8,
        learning_starts=8,
        max_cycles=20,
    )
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    grid = make_grid("paper-7x7")
    learner = MetaLearner(args, grid, Streams.spawn(0))
    training = Training(args, grid, np.array([[0, 6, 20, 42, 48]]), learner)
    while not training.finished:
        training.advance()
    assert learner.updates > 0
    assert torch.equal(before[0], torch.get_rng_state())
    np.testing.assert_array_equal(before[1], np.random.get_state()[1])  # noqa: NPY002


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seed", -1),
        ("n_agents", 0),
        ("n_agents", 2.0),
        ("n_landmarks", True),
        ("max_cycles", 0),
        ("n_problems", 10**9),
        ("episodes_per_problem", -3),
        ("learning_rate", float("nan")),
        ("learning_rate", 0.0),
        ("discount", 1.5),
        ("batch_size", 0),
        ("epsilon_end", -0.1),
        ("guidance_start", float("inf")),
        ("guidance_reach", 0),
        ("threads", 0),
        ("preset", "nonsense"),
        ("reward", "money"),
        ("network", "deep"),
        ("outputs", "both"),
        ("replay", "none"),
        ("final_reward", "more"),
        ("double", 1),
        ("dueling", "no"),
        ("half_precision", "no"),
        ("weight_decay", -0.1),
        ("code_units", 0),
        ("learning_rate_warmup", -1),
        ("reward_scale", 0.0),
        ("huber_delta", 0.0),
        ("target_rate", 1.5),
        ("final_from", float("nan")),
        ("tried_actions", 0),
        ("temperature", 0.0),
        ("imagined_exploration", 1.1),
        ("imagined_from_depot", -0.1),
        ("imagined_length", 0),
        ("checkpoint_seconds", -1.0),
    ],
)
def test_bad_options_are_refused_by_name(name, value):
    """A bad option raises ValueError with its name and its value."""
    with pytest.raises(
        ValueError, match=f"^{name} must be .*got {str(value)!r}".replace("'", ".?")
    ):
        meta_dqn.Args(**{name: value})


# -- options -----------------------------------------------------------------------------------

TINY = {
    "n_agents": 2,
    "n_landmarks": 2,
    "max_cycles": 8,
    "n_problems": 2,
    "episodes_per_problem": 4,
    "hidden_units": 8,
    "code_units": 4,
    "batch_size": 16,
    "learning_starts": 8,
    "updates_per_episode": 3,
    "epsilon_end": 0.5,
}
OTHERS = {
    "code_units": 5,
    "landmark_units": 3,
    "route_units": 3,
    "action_gap": 0.1,
    "tried_actions": 3,
    "temperature": 3.0,
    "imagined_exploration": 0.6,
    "imagined_from_depot": 0.1,
    "imagined_length": 2,
    "imagined_retries": 0.1,
    "memory_size": 6,
    "fresh_landmarks": 0.1,
    "fresh_as_far": 0.1,
    "final_reward": "geodesic",
    "final_from": 0.7,
    "final_discount": 0.5,
    "final_reward_scale": 1.0,
    "discount": 0.5,
    "reward_scale": 0.4,
    "target_rate": 0.5,
    "epsilon_steps": 9,
    "guidance_fraction": 0.2,
    "guidance_reach": 1,
}
META, INDEPENDENT = (meta_dqn.Args, MetaLearner), (IndependentArgs, IndependentLearners)


def outcome(kind, choice, **changes):
    """Return what a tiny training logs, and the weights it ends with."""
    return trained(kind, tuple({**choice, **changes}.items()))


@functools.cache
def trained(kind, changes):
    """Train with one thread."""
    options, learner = kind
    args = options(**{**TINY, **dict(changes)})
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    grid = Grid.from_text("..#\n.D.\n...\n#..")
    training = Training(
        args, grid, np.array([[0, 5], [3, 11]]), learner(args, grid, Streams.spawn(0))
    )
    rows = []
    while not training.finished:
        row = training.advance()
        rows += [row] if row else []
    torch.set_num_threads(threads)
    weights = training.learner.policy().network.state_dict()
    return rows, {name: tensor.tolist() for name, tensor in weights.items()}


@pytest.mark.parametrize(
    ("kind", "choice"),
    [
        (META, {}),
        (META, {"network": "paper"}),
        (META, {"replay": "stored"}),
        (META, {"tried_actions": 1}),
        (META, {"final_reward": "same"}),
        (META, {"final_from": 0.0}),
        (META, {"final_from": 1.0}),
        (META, {"target_interval": 3}),
        (META, {"epsilon_start": 0.5}),
        (META, {"guidance_start": 0.5, "guidance_end": 0.5}),
        (INDEPENDENT, {}),
        (INDEPENDENT, {"replay": "stored"}),
        (INDEPENDENT, {"replay": "imagined"}),
        (INDEPENDENT, {"network": "geodesic"}),
    ],
)
def test_what_is_refused_as_without_effect_has_none(kind, choice):
    """All options that a choice leaves without effect, changed at once, change no row, no weight.

    Together these choices refuse every option of the list above at some time.
    """
    options, _ = kind
    own = {field.name for field in fields(options)}
    idle = [name for name in without_effect(options(**{**TINY, **choice})) if name in own]
    assert idle
    assert set(idle) <= set(OTHERS)
    changes = {name: OTHERS[name] for name in idle}
    assert outcome(kind, choice, **changes) == outcome(kind, choice)
    for name in idle:
        chosen = {**choice, "epsilon_end": 0.5, name: OTHERS[name]}
        words = [f"--{key}={value}" for key, value in chosen.items()]
        with pytest.raises(ValueError, match=f"^{name} has no effect with"):
            parse_options(options, "", words)


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_not_refused_has_an_effect(name):
    """Each of these options, where nothing leaves it without effect, changes the training."""
    changes = {
        "fresh_landmarks": (INDEPENDENT, {}),
        "fresh_as_far": (INDEPENDENT, {}),
        "memory_size": (META, {"replay": "stored"}),
        "guidance_reach": (META, {"guidance_start": 1.0}),
        "guidance_fraction": (META, {"guidance_start": 1.0}),
    }
    kind, choice = changes.get(name, (META, {}))
    assert name not in without_effect(kind[0](**{**TINY, **choice}))
    assert outcome(kind, choice, **{name: OTHERS[name]}) != outcome(kind, choice)


def small_training(preset, learner=MetaLearner, **changes):
    """Return a training on the paper's grid that takes a moment."""
    options = {
        "n_problems": 2,
        "episodes_per_problem": 3,
        "max_cycles": 18,
        "hidden_units": 8,
        "code_units": 4,
        "batch_size": 4,
        "learning_starts": 10,
    }
    args = preset_options(Args, preset, **{**options, **changes})
    grid = make_grid("paper-7x7")
    problems = np.array([[0, 6, 20, 42, 48], [1, 2, 3, 4, 5]])
    return Training(args, grid, problems, learner(args, grid, Streams.spawn(args.seed)))


def play_out(training):
    """Return the rows of metrics.csv of a whole training."""
    rows = []
    while not training.finished:
        row = training.advance()
        rows += [] if row is None else [row]
    return rows


class Watched(MetaLearner):
    """A learner that notes what it was told, and the losses that it returned."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.told, self.losses = [], []

    def remember(self, observation, actions, *others):
        """Keep what was seen and done."""
        self.told.append((observation, np.array(actions)))
        super().remember(observation, actions, *others)

    def update(self, progress):
        """Keep the loss."""
        self.losses.append(super().update(progress))
        return self.losses[-1]


def test_guidance_falls_from_episode_to_episode():
    """Within an episode the influence stays what its row says: 1 obeys always, 0 never."""
    start = {"guidance_start": 1.0, "guidance_end": 0.0, "guidance_fraction": 0.1}
    training = small_training("paper", Watched, epsilon_start=1.0, epsilon_end=1.0, **start)
    rows, first = [], 0
    pointed = obeyed = 0
    while not training.finished:
        row = training.advance()
        if row is None:
            continue
        rows.append(row)
        told = training.learner.told[first : first + row["steps"]]
        first += row["steps"]
        for seen, actions in told:
            directions = training.guidance.directions(seen[None])[0]
            close = directions != -1
            if row["guidance"] == 1.0:
                assert (actions[close] == directions[close]).all()
            else:
                pointed += int(close.sum())
                obeyed += int((actions[close] == directions[close]).sum())
    assert [row["guidance"] for row in rows] == [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert 0 < obeyed < pointed / 2  # by chance


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_rows_tell_problem_and_mean_loss(preset):
    """Problems count from 1, and a row's loss is the mean of the losses of its updates."""
    few = {"updates_per_episode": 2} if preset == "default" else {}
    training = small_training(preset, Watched, **few)
    first = 0
    rows = []
    while not training.finished:
        row = training.advance()
        if row is not None:
            losses = training.learner.losses[first : first + row["updates"]]
            first += row["updates"]
            assert row["loss"] == (pytest.approx(np.mean(losses)) if losses else "")
            rows.append(row)
    assert first == len(training.learner.losses) > 0
    assert [row["problem"] for row in rows] == [1, 1, 1, 2, 2, 2]


def test_every_source_of_chance_has_a_stream_of_its_own():
    """Problems, exploration, batches and start weights draw different numbers, for each seed."""
    firsts = set()
    for seed in range(3):
        training = small_training("default", seed=seed)
        streams = Streams.spawn(seed)
        generators = (training.rng, training.learner.rng, np.random.default_rng(streams.problems))
        firsts |= {str(generator.bit_generator.state["state"]) for generator in generators}
        firsts.add(str(np.random.default_rng(streams.network).bit_generator.state["state"]))
    assert len(firsts) == 12


@pytest.mark.parametrize("n_added", [1, 3, 5, 8])
def test_every_kept_transition_is_drawn(n_added):
    """Batches hold all that is kept, the newest and the oldest too, and a copy goes on alike."""
    memory = ReplayMemory(5, 1, 1)
    for index in range(n_added):
        memory.add(np.array([index]), np.array([0]), 0.0, np.array([index + 1]), False)
    drawn = memory.sample(400, np.random.default_rng(0)).observations[:, 0]
    kept = set(range(max(n_added - 5, 0), n_added))
    assert set(drawn.tolist()) == kept
    copied = ReplayMemory(5, 1, 1)
    copied.restore({name: array.copy() for name, array in memory.arrays_by_name().items()})
    for each in (memory, copied):
        each.add(np.array([99]), np.array([0]), 0.0, np.array([100]), False)
    for name, array in memory.arrays_by_name().items():
        np.testing.assert_array_equal(copied.arrays_by_name()[name], array)


def test_the_first_update_moves_the_weights():
    """With a warm-up the step size rises from a first step that is not 0."""
    learner = small_training("default", learning_rate_warmup=10).learner
    rates = []
    grid = make_grid("paper-7x7")
    rng, cells = np.random.default_rng(0), np.full(3, grid.depot)
    for _ in range(200):
        actions = rng.integers(4, size=3)
        there = np.asarray(grid.moves)[cells, actions]
        before, after = (
            np.array([*c, 0, 1, 2, 3, 4, *[0] * 5], np.float32) for c in (cells, there)
        )
        learner.remember(before, actions, -1.0, after, False)
        cells = there
    before = [tensor.detach().clone() for tensor in weights(learner.network)]
    for _ in range(12):
        learner.update(0.0)
        rates.append(learner.optimiser.param_groups[0]["lr"])
        if len(rates) == 1:
            assert any(
                not torch.equal(a, b) for a, b in zip(before, weights(learner.network), strict=True)
            )
    rate = learner.args.learning_rate
    np.testing.assert_allclose(rates, [rate * min(1, (i + 1) / 10) for i in range(12)])


@pytest.mark.parametrize("double", [False, True])
def test_double_dqn_asks_the_network_as_it_is(double):
    """Batches are prepared ahead where only the target network is asked, and not with double."""
    training = small_training("default", double=double, updates_per_episode=1)
    play_out(training)
    assert training.learner.updates > 0
    assert (training.learner.prepared is None) == double


@pytest.mark.parametrize("final_from", [0.0, 0.5, 1.0])
def test_the_goal_changes_at_the_very_part(final_from):
    """From `final_from` on, itself included, transitions are rewarded with the final reward."""
    learner = small_training("default", final_from=final_from).learner
    first, last = learner.goals
    assert first is not last
    for progress in (0.0, 0.25, 0.499, 0.5, 0.75, 1.0):
        assert learner.goal(progress) is (last if progress >= final_from else first)


def test_learners_of_one_checkpoint_share_nothing():
    """Two learners that take over the same arrays go on alike, each by itself."""
    start = small_training("default", updates_per_episode=1)
    play_out(start)
    arrays = {name: array.copy() for name, array in start.learner.arrays().items()}
    state = copy.deepcopy(start.learner.state())
    kept = {name: array.copy() for name, array in arrays.items()}
    one, other = (small_training("default").learner for _ in range(2))
    for learner in (one, other):
        learner.restore(arrays, copy.deepcopy(state))
    losses = [one.update(0.9) for _ in range(3)]
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, kept[name], err_msg=name)
    assert [other.update(0.9) for _ in range(3)] == losses


def test_the_papers_page_states_the_preset():
    """The choices that docs/paper.md lists are the options of the preset "paper"."""
    page = (Path(__file__).parents[2] / "docs" / "paper.md").read_text(encoding="utf-8")
    options = preset_options(meta_dqn.Args, "paper")
    for words in (
        f"copied every {options.target_interval} updates",
        f"{options.epsilon_start} to {options.epsilon_end} in a straight line over the first "
        f"{options.epsilon_steps:,} steps",
        f"| {options.memory_size:,} and {options.learning_starts} |",
        f"team reward + {options.discount} x the largest",
    ):
        assert words in page, words
