"""TorchRL sees what the environment does: specs, transitions, ends of episodes, masks, targets."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from model import OBSERVATIONS
from pettingzoo.utils import BaseParallelWrapper
from tensordict import TensorDictBase

import mapp_env
from mapp_env import mapp_v0
from mapp_env.adapters.same_infos import SameInfos

with warnings.catch_warnings():  # TorchRL uses, while imported, what it deprecates itself
    warnings.filterwarnings("ignore", "Creating .*WeightUpdater which", DeprecationWarning)
    from torchrl.collectors import Collector
    from torchrl.envs import PettingZooWrapper
    from torchrl.envs.utils import check_env_specs

# TorchRL names the one PettingZoo version, of 2024, that it tests with. Nothing else is silenced.
pytestmark = pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested:UserWarning")

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
# Small enough that random moves end episodes in both ways.
SHORT = {"n_landmarks": 1, "max_cycles": 8}


def wrap(use_mask: bool = False, **arguments: Any) -> PettingZooWrapper:
    """Return the environment as TorchRL has it."""
    return PettingZooWrapper(
        mapp_v0.parallel_env(**arguments),
        categorical_actions=True,
        return_state=True,
        use_mask=use_mask,
    )


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return examples/torchrl_vdn.py, imported."""
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module("torchrl_vdn")


@pytest.mark.parametrize("use_mask", [False, True])
@pytest.mark.parametrize("observation", OBSERVATIONS)
def test_specs(observation: str, use_mask: bool) -> None:
    """TorchRL's check passes for each observation, without and with a mask of living agents."""
    check_env_specs(wrap(use_mask, observation=observation, allow_wait=use_mask), seed=3)


POOL = [
    mapp_env.make_grid(),
    mapp_env.Grid.from_text("...\n.D.\n...\n.#.\n"),
    mapp_env.Grid.from_text("....D..."),
]


@pytest.mark.parametrize("return_home", [False, True])
@pytest.mark.parametrize("actions", ["moves", "landmarks"])
@pytest.mark.parametrize("pool", [False, True])
def test_specs_of_pools_and_landmarks(pool: bool, actions: str, return_home: bool) -> None:
    """TorchRL's check passes with landmark actions, the way home and, by SameInfos, with a pool.

    What it plays is what the environment says, the number of the grid included, over ends.
    """
    arguments: dict[str, Any] = {
        **SHORT,
        "observation": "distances",
        "actions": actions,
        "return_home": return_home,
        **({"grid": POOL} if pool else {}),
    }
    single = mapp_v0.parallel_env(**arguments)
    env = PettingZooWrapper(
        SameInfos(single) if pool else single, categorical_actions=True, return_state=True
    )
    check_env_specs(env, seed=3)
    env.set_seed(4)
    torch.manual_seed(0)
    played = env.rollout(60, break_when_any_done=False)
    twin = mapp_v0.parallel_env(**arguments)
    twin.reset(seed=4)
    observations, infos = twin.reset()  # TorchRL resets once to seed, once to play
    grids, ends = set(), 0
    for row in played:
        if not twin.agents:
            observations, infos = twin.reset()
            ends += 1
        names = twin.possible_agents
        seen = np.stack([observations[name] for name in names])
        assert torch.equal(row["agent", "observation"], torch.as_tensor(seen))
        if pool:
            assert row["agent", "info", "grid"].tolist() == [infos[name]["grid"] for name in names]
            grids.add(infos["agent_0"]["grid"])
        moves = dict(zip(names, row["agent", "action"].tolist(), strict=True))
        observations, _, terminated, _, infos = twin.step(moves)
        assert row["next", "terminated"].item() is terminated["agent_0"]
    assert ends > 3
    assert grids == ({0, 1, 2} if pool else set())


def scalar_steps(played: TensorDictBase, seed: int, **arguments: Any) -> list[dict[str, Any]]:
    """Play the same joint actions, episode after episode, without TorchRL."""
    env = mapp_v0.parallel_env(**arguments)
    steps = []
    env.reset(seed=seed)
    observations, infos = env.reset()  # the collector resets once more before it plays
    for actions in played["agent", "action"].tolist():
        if not env.agents:
            observations, infos = env.reset()
        names = env.possible_agents
        before = observations, infos, env.state()
        moves = dict(zip(names, actions, strict=True))
        observations, rewards, terminated, truncated, infos = env.step(moves)
        step = {"rewards": rewards, "terminated": terminated, "truncated": truncated}
        for prefix, (seen, told, state) in {
            "": before,
            "next ": (observations, infos, env.state()),
        }.items():
            step[prefix + "observation"] = np.stack([seen[name] for name in names])
            step[prefix + "action_mask"] = np.stack([told[name]["action_mask"] for name in names])
            step[prefix + "state"] = state
        steps.append({**step, "names": names, "ended": not env.agents})
    return steps


def collect(env: PettingZooWrapper, seed: int, steps: int) -> TensorDictBase:
    """Let TorchRL's collector play random moves from a seed."""
    torch.manual_seed(seed)
    env.set_seed(seed)
    collector = Collector(env, None, frames_per_batch=steps, total_frames=steps)
    played = next(iter(collector))
    collector.shutdown(close_env=False)
    return played


@pytest.mark.parametrize("observation", ["global", "own_first", "planes", "geodesic"])
def test_transitions_arrive_to_the_bit(observation: str) -> None:
    """What the collector stores is what the environment returned, over many ends of episodes."""
    arguments = {**SHORT, "observation": observation}
    played = collect(wrap(**arguments), 5, 250)
    expected = scalar_steps(played, 5, **arguments)
    ends = set()
    for row, step in zip(played, expected, strict=True):
        group, names = row["next", "agent"], step["names"]
        assert torch.equal(row["agent", "observation"], torch.as_tensor(step["observation"]))
        assert torch.equal(group["observation"], torch.as_tensor(step["next observation"]))
        assert torch.equal(row["state"], torch.as_tensor(step["state"]))
        assert torch.equal(row["next", "state"], torch.as_tensor(step["next state"]))
        assert torch.equal(row["agent", "action_mask"], torch.as_tensor(step["action_mask"] != 0))
        assert group["reward"][:, 0].tolist() == [step["rewards"][name] for name in names]
        for flag in ("terminated", "truncated"):
            assert group[flag][:, 0].tolist() == [step[flag][name] for name in names]
            assert row["next", flag].tolist() == [step[flag][names[0]]]
        assert row["next", "done"].tolist() == [step["ended"]]
        ends.add((bool(row["next", "terminated"]), bool(row["next", "truncated"])))
    assert ends == {(False, False), (True, False), (False, True)}


class MasksAlone(BaseParallelWrapper):
    """The environment, with infos that hold nothing but the action masks."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Return observations and masks."""
        observations, infos = super().reset(seed, options)
        return observations, self.without_others(infos)

    def step(self, actions: dict[str, int]) -> Any:
        """Return all else as it is."""
        *results, infos = super().step(actions)
        return *results, self.without_others(infos)

    def without_others(self, infos: dict[str, Any]) -> dict[str, Any]:
        """Return the masks."""
        return {agent: {"action_mask": info["action_mask"]} for agent, info in infos.items()}


@pytest.mark.parametrize("home", [False, True])
@pytest.mark.parametrize("actions", ["moves", "landmarks"])
def test_pools_arrive_to_the_bit(actions: str, home: bool) -> None:
    """Without grids and metrics in infos, TorchRL plays pools, landmark actions and ways home."""
    arguments: dict[str, Any] = {
        "grid": [mapp_env.make_grid(), mapp_env.Grid.from_text("...\n.D.\n")],
        "observation": "distances",
        "n_landmarks": 2,
        "max_cycles": 9,
        "actions": actions,
        "return_home": home,
    }
    env = PettingZooWrapper(
        MasksAlone(mapp_v0.parallel_env(**arguments)), categorical_actions=True, return_state=True
    )
    check_env_specs(env, seed=3)
    ends = 0
    played = collect(env, 5, 150)
    for row, step in zip(played, scalar_steps(played, 5, **arguments), strict=True):
        group, names = row["next", "agent"], step["names"]
        assert torch.equal(row["agent", "observation"], torch.as_tensor(step["observation"]))
        assert torch.equal(group["observation"], torch.as_tensor(step["next observation"]))
        assert torch.equal(row["agent", "action_mask"], torch.as_tensor(step["action_mask"] != 0))
        assert group["reward"][:, 0].tolist() == [step["rewards"][name] for name in names]
        assert row["next", "done"].tolist() == [step["ended"]]
        ends += step["ended"]
    assert ends > 3


def test_last_masks_are_made_again(example: ModuleType) -> None:
    """The wrapper opens all masks on an episode's last step; the example stores the true ones."""
    args = example.Args(reward_scale=0.5)
    env = wrap(**SHORT)
    played = collect(env, 5, 250)
    stored = example.for_replay(played, env, args)
    opened = 0
    for row, kept, step in zip(played, stored, scalar_steps(played, 5, **SHORT), strict=True):
        true_mask = torch.as_tensor(step["next action_mask"] != 0)
        if step["ended"]:
            assert row["next", "agent", "action_mask"].all()
            opened += not true_mask.all()
        assert torch.equal(kept["next", "agent", "action_mask"], true_mask)
        assert kept["next", "reward"].tolist() == [0.5 * step["rewards"]["agent_0"]]
        assert torch.equal(kept["next", "terminated"], row["next", "terminated"])
    assert opened > 0


def test_loss_bootstraps_on_truncation_alone(example: ModuleType) -> None:
    """The targets are the team's reward plus, unless terminated, the sum of best legal values."""
    args = example.Args()
    torch.manual_seed(0)
    env = wrap(observation="geodesic", **SHORT)
    actor = example.make_actor(env, args)
    batch = example.for_replay(collect(env, 5, 500), env, args)
    # The collector's random moves may bump; the loss counts what the mask forbids as -inf.
    legal = batch["agent", "action_mask"].gather(-1, batch["agent", "action"].unsqueeze(-1))
    batch = batch[legal.all(-2)[:, 0]]
    assert batch["next", "terminated"].any()
    assert (batch["next", "done"] & ~batch["next", "terminated"]).any()
    network = actor.module[0].module
    with torch.no_grad():
        values = network(batch["agent", "observation"])
        chosen = values.gather(-1, batch["agent", "action"].unsqueeze(-1)).sum((-2, -1))
        following = network(batch["next", "agent", "observation"])
        following[~batch["next", "agent", "action_mask"]] = -torch.inf
        best = following.max(-1).values.sum(-1)
        alive = ~batch["next", "terminated"][:, 0]
        targets = batch["next", "reward"][:, 0] + args.discount * best * alive
        expected = torch.nn.functional.smooth_l1_loss(chosen, targets)
    loss = example.make_loss(actor, env, args)
    example.SoftUpdate(loss, tau=args.tau)  # without one, the loss warns
    torch.testing.assert_close(loss(batch)["loss"].detach(), expected, rtol=1e-6, atol=1e-7)


def test_actions_respect_the_masks(example: ModuleType) -> None:
    """No move that bumps is ever taken, neither by exploring nor by the values."""
    args = example.Args(explore=0.5, steps=400, steps_per_batch=200, updates_per_batch=1)
    torch.manual_seed(0)
    env = example.make_env(args)
    env.set_seed(0)
    stored = example.train(env, example.make_actor(env, args), args)[:]
    legal = stored["agent", "action_mask"].gather(-1, stored["agent", "action"].unsqueeze(-1))
    assert len(stored) == 400
    assert legal.all()
    assert not stored["agent", "action_mask"].all()


@pytest.mark.slow
def test_example_learns(tmp_path: Path) -> None:
    """A minute's training of one core more than triples the return and solves nearly all."""
    command = [sys.executable, str(EXAMPLES / "torchrl_vdn.py"), "--problems", "200"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    printed = done.stdout
    training = [float(text) for text in re.findall(r"episodes (-[\d.]+)", printed)]
    assert training[-1] > training[0] / 3
    solved = re.search(r"^after: .* solved ([\d.]+) %", printed, re.MULTILINE)
    assert solved is not None
    assert float(solved[1]) >= 95
