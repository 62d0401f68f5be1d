"""The ceiling of a reward: its optimal policy, found without learning, is what it says."""

import itertools

import numpy as np
import pytest
from model import REWARDS

from baselines import reward_ceiling
from baselines.policies.evaluation import find_optima, unseen_problems
from baselines.policies.settings import Setting
from baselines.reward_ceiling import (
    CoverTimes,
    RewardModel,
    Solved,
    all_cover_times,
    cover_times,
    iterate_values,
    optimal_moves,
)
from mapp_env import Grid, make_grid, mapp_v0

WALLED = Grid.from_text(".#..\nD..#\n.#..")


def play(setting: Setting, landmarks, actions, reward: str):
    """Return the rewards of joint actions in the environment, and whether they solve it."""
    env = mapp_v0.parallel_env(
        setting.grid, setting.n_agents, setting.n_landmarks, setting.max_cycles, reward
    )
    env.reset(options={"landmarks": list(landmarks)})
    rewards, terminated = [], False
    for joint_action in actions:
        if not env.agents:
            break
        _, gained, terminations, _, _ = env.step(dict(zip(env.agents, joint_action, strict=True)))
        rewards.append(gained["agent_0"])
        terminated = terminations["agent_0"]
    return rewards, terminated


def left_after(model, places, unvisited):
    """Return the set of landmarks left after a move to places, and its reward."""
    left, rewards = model.arrive(np.array([places]), unvisited)
    return int(left[0]), float(rewards[0])


def value_at_depot(solved) -> float:
    """Return the value of the start, over all joint actions."""
    model = solved.model
    block = solved.arrival[-1][np.ix_(*[model.moves[model.depot]] * model.n_agents)]
    return float(block.max())


@pytest.mark.parametrize("reward", REWARDS)
@pytest.mark.parametrize(("n_agents", "depth"), [(1, 6), (2, 3)])
def test_no_sequence_of_actions_is_worth_more(reward, n_agents, depth):
    """Of all joint action sequences, played in the environment, the best is worth the value."""
    setting = Setting(WALLED, n_agents, 2, 50)
    discount = 0.9
    joint_actions = list(itertools.product(range(4), repeat=n_agents))
    for landmarks in ((0, 8), (5, 8), (2, 6)):
        model = RewardModel(setting, landmarks, reward)
        solved = iterate_values(model, discount)
        best = -np.inf
        for sequence in itertools.product(joint_actions, repeat=depth):
            rewards, terminated = play(setting, landmarks, sequence, reward)
            if terminated:
                best = max(best, sum(r * discount**t for t, r in enumerate(rewards)))
        if best > -np.inf:
            assert value_at_depot(solved) == pytest.approx(best, abs=1e-8)
        else:
            assert landmarks == (2, 6)  # out of reach of so few steps


@pytest.mark.parametrize("reward", REWARDS)
def test_optimal_policy_earns_its_value(reward):
    """Played in the environment, any optimal policy earns the discounted value and its time."""
    setting = Setting(make_grid("random", rows=5, cols=5, seed=3, density=0.2), 2, 3, 50)
    rng = np.random.default_rng(0)
    discount = 0.95
    for landmarks in unseen_problems(setting, 5).tolist():
        model = RewardModel(setting, landmarks, reward)
        solved = iterate_values(model, discount)
        times = cover_times(solved, setting.max_cycles)
        places, unvisited, actions = (model.depot,) * 2, 7, []
        while unvisited:
            options = optimal_moves(solved, places, unvisited)
            target = options[rng.integers(len(options))]
            moves = zip(places, target, strict=True)
            actions.append([model.moves[a].tolist().index(b) for a, b in moves])
            places, unvisited = target, left_after(model, target, unvisited)[0]
        rewards, terminated = play(setting, landmarks, actions, reward)
        assert terminated
        assert times.best <= len(actions) <= times.worst
        earned = sum(r * discount**t for t, r in enumerate(rewards))
        assert earned == pytest.approx(value_at_depot(solved), abs=1e-7)


def test_counting_steps_has_no_ceiling():
    """The policy that is optimal for -1 a step has the optimal cover time, however ties break."""
    setting = Setting(WALLED, 2, 3, 50)
    landmarks = unseen_problems(setting, 20)
    optimum = find_optima(setting, landmarks).cover_time
    for discount in (1.0, 0.95):
        found = all_cover_times(setting, landmarks.tolist(), "step", discount)
        for name in ("at_random", "best", "worst"):
            times = np.array([getattr(times, name) for times in found])
            np.testing.assert_allclose(times, optimum)


@pytest.mark.parametrize("reward", REWARDS)
def test_rewards_are_those_of_the_environment(reward):
    """Among walls that no distance may ignore, every step of a walk earns what the model says."""
    setting = Setting(make_grid(), 3, 5, 50)
    landmarks = (0, 6, 20, 42, 48)
    model = RewardModel(setting, landmarks, reward)
    actions = np.random.default_rng(1).integers(0, 4, (50, 3)).tolist()
    rewards, _ = play(setting, landmarks, actions, reward)
    places, unvisited = (model.depot,) * 3, 31
    for joint_action, earned in zip(actions, rewards, strict=True):
        moves = zip(places, joint_action, strict=True)
        places = tuple(int(model.moves[place, action]) for place, action in moves)
        unvisited, reward_of_model = left_after(model, places, unvisited)
        assert reward_of_model == earned
    assert unvisited < 31


def test_ties_of_different_ends_are_averaged():
    """To the near landmark first 4 steps, to the far one first 5: each with an even chance."""
    model = RewardModel(Setting(Grid.from_text(".D.."), 1, 2, 50), (0, 3), "step")
    nowhere, near, far, both = [0, 0, 0, 0], [3, 2, 1, 0], [0, 1, 2, 3], [1, 0, 1, 2]
    solved = Solved(model, [np.array(line, float) for line in (nowhere, near, far, both)])
    assert cover_times(solved, 5) == CoverTimes(4.5, 4, 5)
    assert cover_times(solved, 4) == CoverTimes(np.inf, 4, np.inf)


def test_row_of_the_table_says_how_ties_break():
    """Solved, optimal and largest are for the worst ties; gaps are means of the solved problems."""
    found = [CoverTimes(4.5, 4, 5), CoverTimes(4, 4, 4), CoverTimes(np.inf, 9, np.inf)]
    row = reward_ceiling.format_row("any", found, np.array([4, 4, 8]))
    cells = [cell.strip() for cell in row.split("|")[1:-1]]
    assert cells == ["any", "66.67", "6.25", "0.00 - 12.50", "33.3", "25.0"]


def test_ties_are_followed_to_their_end():
    """Without foresight every move is a tie: at best 7 steps, at worst the limit is not enough."""
    setting = Setting(Grid.from_text("...D.."), 1, 2, 50)
    model = RewardModel(setting, (0, 5), "step")
    solved = iterate_values(model, 0.0)  # sees one step: no move is better than another
    times = cover_times(solved, 9)
    assert np.isinf([times.at_random, times.worst]).all()
    assert times.best == 7  # twice 2 to the right, then 5 to the left


def test_too_many_states_are_refused():
    """The number of states is checked before anything is allocated."""
    with pytest.raises(ValueError, match=r"make 152,003,335,712 states, allowed are 67,108,864"):
        reward_ceiling.main(reward_ceiling.Args(n_agents=6, n_landmarks=5))
    with pytest.raises(ValueError, match="rewards must be"):
        reward_ceiling.Args(rewards=("distance",))


def test_discounts_that_lose_late_steps_are_refused():
    """Where a step more or less vanishes in the values, ties would be false: nobody is told so."""
    setting = Setting(Grid(np.zeros((1, 15), np.bool_), depot=0), 1, 1, 50)
    (times,) = all_cover_times(setting, [(14,)], "step", 0.1)
    assert times.worst > 14  # a gap, though there is none
    for discount, limit in ((0.1, 50), (0.0, 1), (0.95, 500)):
        with pytest.raises(ValueError, match=r"discount \*\* max_cycles must be at least 1e-08"):
            reward_ceiling.Args(discount=discount, max_cycles=limit)
    reward_ceiling.Args(discount=0.95, max_cycles=300)
    reward_ceiling.Args(discount=1.0, max_cycles=1_000_000)


def test_table_has_a_row_for_each_reward(capsys):
    """From the command line: a Markdown table, and gaps in the order best, random, worst."""
    args = reward_ceiling.Args(problems=3, n_agents=2, n_landmarks=3)
    reward_ceiling.main(args)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "3 problems, discount 0.95"
    assert [line.split("|")[1].strip() for line in lines[4:]] == list(REWARDS)
    for line in lines[4:]:
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        low, high = map(float, cells[3].split(" - "))
        assert low <= float(cells[2]) <= high


def test_the_mean_lies_between_the_extremes():
    """Ties at random are no better than at their best, no worse than at their worst.

    However many ways lead to one state, no probability is lost on the way.
    """
    setting = Setting(Grid.from_text("...\n.D.\n..."), 2, 2, 30)
    for landmarks in unseen_problems(setting, 12).tolist():
        for reward in REWARDS:
            (times,) = all_cover_times(setting, [landmarks], reward, 0.9)
            assert times.best <= times.at_random + 1e-9
            assert times.at_random <= times.worst + 1e-9
