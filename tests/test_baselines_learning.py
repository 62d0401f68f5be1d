"""The parts a learner is made of: targets, memory, guidance, acting, and that they learn."""

import numpy as np
import pytest
import torch

from baselines import meta_dqn
from baselines.guidance import Guidance, GuidedPolicy, LinearSchedule
from baselines.networks import NetworkSpec, build_network, torch_generator
from baselines.replay_memory import Batch, ReplayMemory
from baselines.runs import RunFolder, StopSignals
from mapp_env import Grid, make_grid

LEFT, RIGHT, UP, DOWN = range(4)


def small_network(n_agents: int, seed: int, hidden_units: int = 64):
    spec = NetworkSpec("paper", n_agents, 1, 4, 9, hidden_units)
    return build_network(spec, torch_generator(np.random.SeedSequence(seed)))


# -- targets -----------------------------------------------------------------------------------


def test_targets_equal_hand_computed_ones():
    """Termination cuts the future off, truncation and neither do not; each agent has its own."""
    next_scores = torch.tensor(
        [[[1.0, 4.0, 2.0, 3.0], [-1.0, -4.0, -2.0, -3.0]]] * 3, dtype=torch.float32
    )
    rewards = torch.tensor([-7.0, 0.0, -2.0])
    # A time-out is stored as "not terminated", like a step in the middle of an episode.
    terminated = torch.tensor([False, True, False])
    targets = meta_dqn.td_targets(rewards, terminated, next_scores, 0.95)
    expected = [[-7 + 0.95 * 4, -7 - 0.95], [0, 0], [-2 + 0.95 * 4, -2 - 0.95]]
    np.testing.assert_allclose(targets.numpy(), expected, atol=1e-6)


def test_update_is_the_gradient_of_the_huber_loss_of_the_chosen_scores():
    """One update returns the mean Huber loss of the chosen scores, computed by hand."""
    network, target = small_network(2, 0), small_network(2, 1)
    rng = np.random.default_rng(0)
    batch = Batch(
        observations=rng.integers(0, 2, (8, 4)).astype(np.float32),
        actions=rng.integers(0, 4, (8, 2)),
        rewards=rng.normal(size=8).astype(np.float32) * 3,
        next_observations=rng.integers(0, 2, (8, 4)).astype(np.float32),
        terminated=rng.random(8) < 0.5,
    )
    with torch.no_grad():
        scores = network(torch.from_numpy(batch.observations)).numpy()
        next_scores = target(torch.from_numpy(batch.next_observations)).numpy()
    losses = []
    for row in range(8):
        for agent in range(2):
            goal = float(batch.rewards[row])
            if not batch.terminated[row]:
                goal += 0.9 * next_scores[row, agent].max()
            error = abs(scores[row, agent, batch.actions[row, agent]] - goal)
            losses.append(0.5 * error**2 if error < 1 else error - 0.5)
    before = {name: tensor.clone() for name, tensor in target.state_dict().items()}
    optimiser = torch.optim.Adam(network.parameters(), lr=0.001)
    loss = meta_dqn.update(network, target, optimiser, batch, 0.9)
    assert loss == pytest.approx(np.mean(losses), abs=1e-6)
    assert all(torch.equal(before[name], t) for name, t in target.state_dict().items())


@pytest.mark.parametrize("seed", range(3))
def test_two_step_chain_learns_its_known_scores(seed):
    """State 0 leads to state 1 for nothing, which ends with 1 for one action and 0 for others."""
    network, target = small_network(1, seed), small_network(1, seed)
    optimiser = torch.optim.Adam(network.parameters(), lr=0.003)
    rng = np.random.default_rng(seed)
    states = np.array([[0, 0, 0], [8, 0, 0]], np.float32)
    for step in range(400):
        where = rng.integers(2, size=32)
        actions = rng.integers(4, size=(32, 1))
        batch = Batch(
            observations=states[where],
            actions=actions,
            rewards=((where == 1) & (actions[:, 0] == UP)).astype(np.float32),
            next_observations=states[np.ones(32, int)],
            terminated=where == 1,
        )
        meta_dqn.update(network, target, optimiser, batch, 0.9)
        if step % 20 == 0:
            target.load_state_dict(network.state_dict())
    with torch.no_grad():
        scores = network(torch.from_numpy(states))[:, 0].numpy()
    np.testing.assert_allclose(scores, [[0.9] * 4, [0, 0, 1, 0]], atol=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_team_reward_teaches_each_agent_its_own_action(seed):
    """Agents that share one reward, which depends on what they see, find their own best action."""
    network = small_network(2, seed)
    optimiser = torch.optim.Adam(network.parameters(), lr=0.003)
    rng = np.random.default_rng(seed)
    for _ in range(500):
        flags = rng.integers(2, size=64)
        observations = np.zeros((64, 4), np.float32)
        observations[:, 3] = flags
        actions = rng.integers(4, size=(64, 2))
        # The best actions are (LEFT, DOWN) without the flag, (RIGHT, UP) with it.
        good = np.where(flags[:, None], [RIGHT, UP], [LEFT, DOWN])
        rewards = (actions == good).sum(axis=1).astype(np.float32)
        batch = Batch(observations, actions, rewards, observations, np.ones(64, np.bool_))
        meta_dqn.update(network, network, optimiser, batch, 0.95)
    with torch.no_grad():
        seen = torch.tensor([[0.0, 0, 0, 0], [0, 0, 0, 1]])
        greedy = network(seen).argmax(dim=-1).tolist()
    assert greedy == [[LEFT, DOWN], [RIGHT, UP]]


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
        assert row.actions.tolist() == [i, i + 1]
        assert row.rewards == -i
        assert row.next_observations.tolist() == [i + 0.5] * 3
        assert row.terminated == (i % 3 == 0)
    drawn = memory.sample(1000, np.random.default_rng(0))
    assert set(-drawn.rewards.astype(int)) == set(kept)
    assert (drawn.observations[:, 0] == -drawn.rewards).all()


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


def test_epsilon_is_tossed_for_each_agent():
    """Without exploration every agent takes its own argmax; with it, each explores on its own."""
    network = small_network(2, 0)
    observation = np.array([4, 4, 8, 0], np.float32)
    with torch.no_grad():
        greedy = network(torch.from_numpy(observation[None]))[0].argmax(dim=-1).numpy()
    rng = np.random.default_rng(0)
    assert (meta_dqn.choose_actions(network, observation, 0.0, rng) == greedy).all()
    many = np.array([meta_dqn.choose_actions(network, observation, 0.4, rng) for _ in range(3000)])
    other = many != greedy
    assert other.mean(axis=0) == pytest.approx(0.4 * 3 / 4, abs=0.04)
    assert other.all(axis=1).mean() == pytest.approx((0.4 * 3 / 4) ** 2, abs=0.03)


def test_loop_stores_what_happened(tmp_path, monkeypatch):
    """Stored transitions chain, and are terminated only where every landmark is visited."""
    memories = []

    class Kept(ReplayMemory):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            memories.append(self)

    monkeypatch.setattr(meta_dqn, "ReplayMemory", Kept)
    args = meta_dqn.Args(max_cycles=12, n_landmarks=2, hidden_units=8, memory_size=1000)
    grid = make_grid("paper-7x7")
    problems = np.array([[17, 30], [0, 48], [25, 31]])
    args = meta_dqn.Args(**{**vars(args), "n_problems": 3, "episodes_per_problem": 8})
    run = RunFolder(tmp_path / "run", meta_dqn.METRICS)
    training = meta_dqn.train(args, grid, problems, run, StopSignals())
    run.close()
    (memory,) = memories
    stored = Batch(*(array[: len(memory)] for array in memory.arrays))
    assert training.episodes == 24
    assert training.steps == len(memory)
    all_visited = stored.next_observations[:, -2:].all(axis=1)
    np.testing.assert_array_equal(stored.terminated, all_visited)
    assert ((stored.rewards == 0) == all_visited).all()
    begins = (stored.observations[:, :3] == grid.depot).all(axis=1)
    chained = (stored.observations[1:] == stored.next_observations[:-1]).all(axis=1)
    assert (chained | begins[1:]).all()
    assert 0 < all_visited.sum() < 24  # both ends occur: visited, and out of time
    moves = np.asarray(grid.moves)
    np.testing.assert_array_equal(
        moves[stored.observations[:, :3].astype(int), stored.actions],
        stored.next_observations[:, :3],
    )


def test_training_leaves_the_global_generators_alone(tmp_path):
    """Neither NumPy's nor PyTorch's global generator moves, whatever is trained."""
    args = meta_dqn.Args(
        n_problems=1, episodes_per_problem=2, hidden_units=8, learning_starts=8, max_cycles=20
    )
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    run = RunFolder(tmp_path / "run", meta_dqn.METRICS)
    meta_dqn.train(args, make_grid("paper-7x7"), np.array([[0, 6, 20, 42, 48]]), run, StopSignals())
    run.close()
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
    ],
)
def test_bad_options_are_refused_by_name(name, value):
    """A bad option raises ValueError with its name and its value."""
    with pytest.raises(
        ValueError, match=f"^{name} must be .*got {str(value)!r}".replace("'", ".?")
    ):
        meta_dqn.Args(**{name: value})
