"""Every face of the package plays pools, starts, landmark actions and ways home as the model."""

from __future__ import annotations

import functools
import random
from collections import Counter
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from model import OBSERVATIONS, Model, joint_number, lively_action
from model_pools import (
    Batch,
    Game,
    draw_grid,
    draw_landmarks,
    random_game,
    random_landmarks,
    random_starts,
)

import mapp_env
from mapp_env import mapp_v0

GAMES = range(60)
COSTS = ("cover_time", "makespan", "total_distance")


@functools.cache
def the_grid(rows: tuple[str, ...]) -> mapp_env.Grid:
    """Return the package's grid of these rows, made once per process."""
    return mapp_env.Grid.from_text("\n".join(rows) + "\n")


def arguments(game: Game, **changes: Any) -> dict[str, Any]:
    """Return what an environment of a game is made with."""
    return {"grid": [the_grid(rows) for rows in game.pool], **game.settings(**changes)}


def kind_of(seed: int) -> str:
    """Return the observation that a game is played with; all meet all rewards and actions."""
    return OBSERVATIONS[seed // 3 % len(OBSERVATIONS)]


def words_of(seed: int) -> Any:
    """Return what gives the words of an environment that is reset with this seed."""
    generator = np.random.default_rng(seed)
    return lambda: int(generator.integers(2**64, dtype=np.uint64))


def the_problem(game: Game, grid: int, model: Model) -> mapp_env.Problem:
    """Return an episode of the model as the package's problem."""
    rows, limit = game.pool[grid], model.max_cycles
    return mapp_env.Problem(
        the_grid(rows), model.landmarks, game.n_agents, limit, starts=model.starts
    )


def given_problem(game: Game, rng: random.Random) -> tuple[int, Model]:
    """Return an episode with starts, and a limit of its own, on a grid of the pool."""
    grid = game.pool.index(rng.choice(game.pool))  # of equal grids the first
    cells = random_landmarks(rng, game.pool[grid], game.n_landmarks)
    starts = random_starts(rng, game.episode(grid, cells))
    return grid, game.episode(grid, cells, starts, rng.randint(1, 40))


Opening = tuple[dict[str, Any], int, Model]


def openings(game: Game, seed: int) -> Iterator[Opening]:
    """Yield what a face is reset with, and the grid and the episode that begin with it.

    Every form of options, and between them draws: what is given draws nothing, a grid alone leaves
    the landmarks to the reset's word.
    """
    rng = random.Random(seed)
    for _ in range(2):  # the second time the seed begins its words anew
        word = words_of(seed)
        yield {"seed": seed}, *game.drawn(word())
        yield {}, *game.drawn(word())
        grid = rng.randrange(len(game.pool))
        yield {"options": {"grid": grid}}, *game.drawn(word(), grid)
        cells = random_landmarks(rng, game.pool[grid], game.n_landmarks)
        options: dict[str, Any] = {"grid": np.int64(grid), "landmarks": list(cells)}
        yield {"options": options}, grid, game.episode(grid, cells)
        grid, model = given_problem(game, rng)
        yield {"options": {"problem": the_problem(game, grid, model)}}, grid, model
        yield {}, *game.drawn(word())


def playing(game: Game, seed: int) -> Iterator[tuple[dict[str, Any] | list[int], int, Model, Any]]:
    """Yield, of some whole episodes, resets and joint actions with the model after each.

    The last item is the model's (reward, terminated, truncated), None after a reset.
    """
    rng = random.Random(seed)
    for opening, grid, model in openings(game, seed):
        yield opening, grid, model, None
        while not model.ended:
            actions = lively_action(model, rng)
            result = model.step(actions)
            yield actions, grid, model, result


def check_numbers(array: Any, model: Model, kind: str, agent: int) -> None:
    """Hold an agent's observation to be the model's."""
    assert isinstance(array, np.ndarray)
    assert array.dtype == np.float32
    expected = np.array(model.observation(kind, agent), np.float32)
    assert array.shape == expected.shape
    np.testing.assert_allclose(array, expected, rtol=3e-7, atol=0)


def check_team(array: Any, model: Model, kind: str) -> None:
    """Hold what a meta-agent sees, the global vector or the agents' observations, to be so."""
    if kind == "global":
        check_numbers(array, model, kind, 0)
        return
    assert len(array) == model.n_agents
    for agent, view in enumerate(array):
        check_numbers(view, model, kind, agent)


def masks_of(model: Model) -> list[list[int]]:
    """Return all agents' masks."""
    return [model.action_mask(agent) for agent in range(model.n_agents)]


def check_info(info: dict[str, Any], model: Model, grid: int, mask: Any) -> None:
    """Hold an info to have mask, grid and, at the end alone, metrics."""
    assert set(info) - {"joint_action_mask"} == {
        "action_mask",
        "grid",
        *(["metrics"] if model.ended else []),
    }
    assert type(info["grid"]) is int
    assert info["grid"] == grid
    assert info["action_mask"].dtype == np.int8
    assert info["action_mask"].tolist() == mask
    if model.ended:
        assert info["metrics"] == model.metrics()
        assert type(info["metrics"]["success"]) is bool
        assert all(type(info["metrics"][name]) is float for name in COSTS)


def test_games_are_not_vacuous() -> None:
    """The games hold all combinations, both endings, all grids of pools and idle agents."""
    seen: Counter[Any] = Counter()
    for seed in GAMES:
        game = random_game(seed)
        grids, shapes = set(), {(len(rows), len(rows[0])) for rows in game.pool}
        for _, grid, model, result in playing(game, seed):
            grids.add(grid)
            if not model.ended or result is None:
                continue
            seen[game.actions, game.return_home, model.terminated] += 1
            seen["idle agent"] += model.terminated and not all(model.claimed)
            seen["all visited, not home"] += all(model.visited) and not model.terminated
        seen["all grids drawn"] += len(grids) == len(game.pool) > 1
        seen["sizes"] += len(shapes) > 2
        seen["one size"] += len(shapes) == 1 < len(set(game.pool))
        seen[game.actions, game.return_home, game.reward] += 1
        seen["face", seed % 3, game.reward] += len(game.pool) > 1
        seen[game.actions, kind_of(seed)] += 1
        seen["pocket"] += any(
            sum(row.count(".") for row in rows) > len(mapp_env_cells(rows)) for rows in game.pool
        )
        seen["N", game.n_agents] += 1
        seen["K", game.n_landmarks] += 1
        seen["pool", len(game.pool)] += 1
    assert len(seen) == 8 + 12 + 9 + 2 * len(OBSERVATIONS) + 6 + 6 + 8 + 5
    assert all(count >= 2 for count in seen.values()), seen


def mapp_env_cells(rows: tuple[str, ...]) -> list[int]:
    """Return the cells of a grid that can be reached, as the package finds them."""
    return the_grid(rows).reachable.tolist()


@pytest.mark.parametrize("seed", GAMES)
def test_parallel_env_plays_the_model(seed: int) -> None:
    """ParallelEnv: every value of every step, and the state, over resets of all forms."""
    game, kind = random_game(seed), kind_of(seed)
    env = mapp_v0.parallel_env(observation=kind, **arguments(game))
    agents = [f"agent_{index}" for index in range(game.n_agents)]
    for agent in agents:
        assert env.action_space(agent) == gymnasium.spaces.Discrete(game.n_actions)
    for given, grid, model, result in playing(game, seed):
        if result is None:
            observations, infos = env.reset(**given)
        else:
            reward, terminated, truncated = result
            step = env.step(dict(zip(agents, given, strict=True)))
            observations, rewards, terminations, truncations, infos = step
            assert rewards == dict.fromkeys(agents, reward)
            assert terminations == dict.fromkeys(agents, terminated)
            assert truncations == dict.fromkeys(agents, truncated)
        assert env.agents == ([] if model.ended else agents)
        assert list(observations) == list(infos) == agents
        for index, agent in enumerate(agents):
            check_numbers(observations[agent], model, kind, index)
            assert env.observation_space(agent).contains(observations[agent])
            check_info(infos[agent], model, grid, model.action_mask(index))
        check_numbers(env.state(), model, "global", 0)
        assert env.state_space.contains(env.state())


@pytest.mark.parametrize("seed", range(0, 60, 2))
def test_aec_env_plays_the_model(seed: int) -> None:
    """AEC: each agent's last() after each round shows the model's step."""
    game, kind = random_game(seed), kind_of(seed)
    env = mapp_v0.env(observation=kind, **arguments(game))
    for given, grid, model, result in playing(game, seed):
        if result is None:
            env.reset(**given)
            reward, terminated, truncated = 0.0, False, False
        else:
            reward, terminated, truncated = result
            for index, action in enumerate(given):
                assert env.agent_selection == f"agent_{index}"
                env.step(action)
        # PettingZoo sends ended agents off in the order of their names
        for agent in sorted(env.agents) if model.ended else env.agents[:1]:
            index = env.possible_agents.index(agent)
            assert env.agent_selection == agent
            observation, last_reward, last_terminated, last_truncated, info = env.last()
            check_numbers(observation, model, kind, index)
            assert last_reward == reward
            assert (last_terminated, last_truncated) == (terminated, truncated)
            check_info(info, model, grid, model.action_mask(index))
            if model.ended:
                env.step(None)
        for index, agent in enumerate(env.agents):
            check_numbers(env.observe(agent), model, kind, index)
            check_info(env.infos[agent], model, grid, model.action_mask(index))
        assert bool(env.agents) is not model.ended


@pytest.mark.parametrize("central_action", ["auto", "joint", "multi"])
@pytest.mark.parametrize("seed", range(1, 60, 3))
def test_central_env_plays_the_model(seed: int, central_action: str) -> None:
    """Central-v0: joint numbers of moves, MultiDiscrete of landmarks; team views stacked."""
    game, kind = random_game(seed), kind_of(seed)
    joint = central_action != "multi" and game.actions == "moves"
    if central_action == "joint" and not joint:
        with pytest.raises(ValueError, match="central_action"):
            gymnasium.make("mapp_env/Central-v0", central_action="joint", **arguments(game))
        return
    env = gymnasium.make(
        "mapp_env/Central-v0",
        disable_env_checker=True,
        observation=kind,
        central_action=central_action,
        **arguments(game),
    )
    if joint:
        assert env.action_space.n == game.n_actions**game.n_agents
    else:
        assert env.action_space.nvec.tolist() == [game.n_actions] * game.n_agents
    for given, grid, model, result in playing(game, seed):
        if result is None:
            observation, info = env.reset(**given)
        else:
            action = joint_number(given, game.n_actions) if joint else np.array(given)
            observation, reward, terminated, truncated, info = env.step(action)
            assert (reward, terminated, truncated) == result
            assert type(terminated) is type(truncated) is bool
        check_team(observation, model, kind)
        assert env.observation_space.contains(observation)
        check_info(info, model, grid, masks_of(model))
        assert ("joint_action_mask" in info) is joint
        masks = env.unwrapped.action_masks()
        if joint:
            every = functools.reduce(np.multiply.outer, masks_of(model)) if joint else []
            assert info["joint_action_mask"].tolist() == np.ravel(every).tolist()
            assert masks.tolist() == np.ravel(every).astype(bool).tolist()
        else:
            assert masks.tolist() == np.ravel(masks_of(model)).astype(bool).tolist()
        check_numbers(env.unwrapped.state(), model, "global", 0)


@pytest.mark.parametrize("seed", range(2, 60, 3))
def test_tuple_env_plays_the_model(seed: int) -> None:
    """Tuple-v0: tuples of views, the team reward for each agent, masks and metrics at hand."""
    game, kind = random_game(seed), kind_of(seed)
    env = gymnasium.make(
        "mapp_env/Tuple-v0", disable_env_checker=True, observation=kind, **arguments(game)
    )
    for given, _, model, result in playing(game, seed):
        if result is None:
            views, info = env.reset(**given)
        else:
            views, rewards, terminated, truncated, info = env.step(tuple(given))
            assert rewards == [result[0]] * game.n_agents
            assert (terminated, truncated) == result[1:]
        assert info.get("success", None) == (float(model.terminated) if model.ended else None)
        assert isinstance(views, tuple)
        for agent, view in enumerate(views):
            check_numbers(view, model, kind, agent)
        assert env.observation_space.contains(views)
        assert env.unwrapped.action_masks.tolist() == masks_of(model)
        check_numbers(env.unwrapped.state(), model, "global", 0)
        assert env.unwrapped.metrics() == model.metrics()


N_ROWS = 7


def batch_reset(
    game: Game, batch: Batch, rows: list[int], rng: random.Random
) -> dict[str, Any] | None:
    """Reset rows of the model in one of the forms that options have; return the options."""
    form = rng.randrange(8)
    n_rows, n_grids = len(batch.words), len(game.pool)
    if form == 0:
        grid = rng.randrange(n_grids)
        for row in rows:
            batch.draw(row, grid)
        return {"grid": grid}
    if form in (1, 2):
        grids = [rng.randrange(n_grids) for _ in range(n_rows)]
        for row in rows:
            batch.draw(row, grids[row])
        return {"grid": grids if form == 1 else np.array(grids, np.int32)}
    if form == 3:
        grids = [rng.randrange(n_grids) for _ in range(n_rows)]
        cells = [random_landmarks(rng, game.pool[grid], game.n_landmarks) for grid in grids]
        for row in rows:
            batch.give(row, grids[row], game.episode(grids[row], cells[row]))
        return {"grid": grids, "landmarks": np.array(cells)}
    if form == 7:  # the same landmarks for all rows
        grid = rng.randrange(n_grids)
        cells = random_landmarks(rng, game.pool[grid], game.n_landmarks)
        for row in rows:
            batch.give(row, grid, game.episode(grid, cells))
        pairs = [divmod(cell, len(game.pool[grid][0])) for cell in cells]
        return {"grid": [grid] * n_rows, "landmarks": rng.choice((list(cells), pairs))}
    if form == 4:
        grid, model = given_problem(game, rng)
        problem = the_problem(game, grid, model)
        for row in rows:
            own = game.episode(grid, model.landmarks, model.starts, model.max_cycles)
            batch.give(row, grid, own)
        return {"problem": problem}
    if form == 5:
        several = [given_problem(game, rng) for _ in range(n_rows)]
        for row in rows:
            batch.give(row, *several[row])
        return {"problem": [the_problem(game, grid, model) for grid, model in several]}
    for row in rows:
        batch.draw(row)
    return None


def check_batch_infos(infos: dict[str, Any], models: list[Model | None], grids: list[int]) -> None:
    """Hold masks and grids of a batch to be the models'; rows of None have none."""
    there = [model is not None for model in models]
    assert infos["_action_mask"].tolist() == infos["_grid"].tolist() == there
    assert infos["grid"].dtype == np.int64
    assert infos["action_mask"].dtype == np.int8
    for row, model in enumerate(models):
        if model is None:
            assert infos["grid"][row] == 0
            assert not infos["action_mask"][row].any()
            continue
        assert infos["grid"][row] == grids[row]
        assert infos["action_mask"][row].tolist() == masks_of(model)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize("seed", range(0, 60, 3))
def test_batches_play_the_model(seed: int, mode: str) -> None:
    """make_vec: rows draw, end and restart as the model's, also reset with options of each row."""
    game, kind, rng = random_game(seed), kind_of(seed), random.Random(seed)
    envs = mapp_env.make_vec(N_ROWS, observation=kind, autoreset_mode=mode, **arguments(game))
    assert envs.single_action_space.nvec.tolist() == [game.n_actions] * game.n_agents
    observations, infos = envs.reset(seed=seed)
    batch = Batch(game, [words_of(int(one)) for one in envs.np_random_seed], mode)
    for row in range(N_ROWS):
        batch.draw(row)
    check_batch_infos(infos, list(batch.models), batch.grids)
    ends = 0
    for step in range(90):
        states = envs.state()
        for row, model in enumerate(batch.models):
            check_team(observations[row], model, kind)
            check_numbers(states[row], model, "global", 0)
        assert envs.observation_space.contains(observations)
        rows = [row for row in range(N_ROWS) if batch.waiting[row]]
        if (mode == "Disabled" and rows) or step % 13 == 5:
            rows = rows or sorted(rng.sample(range(N_ROWS), rng.randint(1, N_ROWS)))
            options = batch_reset(game, batch, rows, rng) or {}
            mask = np.array([row in rows for row in range(N_ROWS)])
            observations, infos = envs.reset(options={**options, "reset_mask": mask})
            shown = [batch.models[row] if mask[row] else None for row in range(N_ROWS)]
            check_batch_infos(infos, shown, batch.grids)
            assert set(infos) == {"action_mask", "_action_mask", "grid", "_grid"}
            for row, model in enumerate(batch.models):
                check_team(observations[row], model, kind)
        actions = [lively_action(model, rng) for model in batch.models]
        observations, rewards, terminations, truncations, infos = envs.step(np.array(actions))
        found = [batch.step(row, actions[row]) for row in range(N_ROWS)]
        for row, (*result, _, _) in enumerate(found):
            assert [rewards[row], terminations[row], truncations[row]] == result
        check_batch_infos(infos, list(batch.models), batch.grids)
        ended = [result[-2].ended for result in found]
        ends += sum(ended)
        check_endings(infos, found, ended, mode, kind)
    assert ends >= 3


def check_endings(
    infos: dict[str, Any], found: list[Any], ended: list[bool], mode: str, kind: str
) -> None:
    """Hold what is said of the rows that ended to be the models', in its place of each mode."""
    assert ("final_info" in infos) == ("final_obs" in infos) == (mode == "SameStep" and any(ended))
    last = infos.get("final_info", infos)
    assert ("metrics" in last) == any(ended)
    if not any(ended):
        return
    assert last["_metrics"].tolist() == ended
    for row, (*_, model, _) in enumerate(found):
        if ended[row]:
            scored = {name: last["metrics"][name][row] for name in ("success", *COSTS)}
            assert scored == model.metrics()
            if mode == "SameStep":
                check_team(infos["final_obs"][row], model, kind)
    if mode == "SameStep":
        assert infos["_final_obs"].tolist() == infos["_final_info"].tolist() == ended
        shown = [model if over else None for (*_, model, _), over in zip(found, ended, strict=True)]
        check_batch_infos(last, shown, [grid for *_, grid in found])


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("actions", ["moves", "landmarks"])
def test_large_grids_in_a_pool_play_the_model(actions: str, mode: str) -> None:
    """Grids too large to keep all distances, among small ones, are played so after autoresets."""
    rng = random.Random(3)
    wide = tuple("".join(row) for row in [["."] * 70 for _ in range(62)])
    high = [["." if rng.random() < 0.8 else "#" for _ in range(59)] for _ in range(75)]
    high[40][30] = "D"
    small = ("D....", "..#.#", ".#...")
    pool = (("D" + wide[0][1:], *wide[1:]), small, tuple("".join(row) for row in high))
    game = Game(pool, 2, 3, "geodesic", actions, return_home=True, max_cycles=7)
    for kind in ("geodesic", "distances"):
        envs = mapp_env.make_vec(5, observation=kind, autoreset_mode=mode, **arguments(game))
        observations, infos = envs.reset(seed=2)
        batch = Batch(game, [words_of(int(one)) for one in envs.np_random_seed], mode)
        for row in range(5):
            batch.draw(row)
        drawn = set()
        for _ in range(24):
            for row, model in enumerate(batch.models):
                check_team(observations[row], model, kind)
            check_batch_infos(infos, list(batch.models), batch.grids)
            drawn.update(batch.grids)
            joint = [lively_action(model, rng) for model in batch.models]
            observations, rewards, *flags, infos = envs.step(np.array(joint))
            for row in range(5):
                reward, terminated, truncated, *_ = batch.step(row, joint[row])
                assert rewards[row] == reward
                assert [flag[row] for flag in flags] == [terminated, truncated]
        assert drawn == {0, 1, 2}


def test_the_documented_draw() -> None:
    """One word draws the grid by the counters -1, -2, ..., then its landmarks by 0, 1, ...

    So a pool draws on its grid the landmarks that this grid alone would have been given.
    """
    game = random_game(4)
    single = {}
    for grid, rows in enumerate(game.pool):
        own = game.alone(grid)
        single[grid] = mapp_v0.parallel_env(**{**arguments(own), "grid": the_grid(rows)})
    env = mapp_v0.parallel_env(**arguments(game))
    for seed in range(60):
        word = words_of(seed)()
        _, infos = env.reset(seed=seed)
        grid = infos["agent_0"]["grid"]
        assert grid == draw_grid(word, len(game.pool))
        single[grid].reset(seed=seed)
        assert env.state().tolist() == single[grid].state().tolist()
        cells = env.state()[game.n_agents : game.n_agents + game.n_landmarks]
        assert cells.tolist() == list(draw_landmarks(word, game.pool[grid], game.n_landmarks))
