"""Measure how fast the environments step, next to peers in the same run.

Absolute figures vary with the machine and its load, so every figure is printed with its ratio to a
floor: a `ParallelEnv` that does nothing, the most that PettingZoo's dictionaries allow. The two are
timed alternately, in CPU seconds of this process, and the ratio is the median over rounds. Random
actions, including resets, one thread.

    python benchmarks/env_speed.py            # a minute; --seconds 0.1 for a quick look
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import importlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np
import pettingzoo
from gymnasium.spaces import Box, Discrete

import mapp_env
from mapp_env import mapp_v0

TURNS = 15
N_ACTIONS_AHEAD = 997


class DoNothing(pettingzoo.ParallelEnv):
    """Three agents, 50 steps, the paper's observation: the Python API's floor."""

    metadata = {"name": "do_nothing"}  # noqa: RUF012

    def __init__(self) -> None:
        self.possible_agents = ["agent_0", "agent_1", "agent_2"]
        self.agents: list[str] = []
        self._space = Box(0, 48, (13,), np.float32)
        self._actions = Discrete(4)
        self._observation = np.zeros(13, np.float32)
        self._steps = 0

    def observation_space(self, agent: str) -> Box:
        return self._space

    def action_space(self, agent: str) -> Discrete:
        return self._actions

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.agents = self.possible_agents[:]
        self._steps = 0
        return {a: self._observation for a in self.agents}, {a: {} for a in self.agents}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        agents = self.agents
        self._steps += 1
        truncated = self._steps >= 50
        result = (
            {agent: self._observation for agent in agents},
            {agent: 0.0 for agent in agents},
            {agent: False for agent in agents},
            {agent: truncated for agent in agents},
            {agent: {} for agent in agents},
        )
        if truncated:
            self.agents = []
        return result


def parallel_stepper(env: Any) -> Callable[[int], int]:
    """Return a function that takes n steps with random actions and returns how many it took."""
    env.reset(seed=0)
    spaces = {agent: env.action_space(agent) for agent in env.possible_agents}
    actions = [{a: int(space.sample()) for a, space in spaces.items()} for _ in range(997)]

    def take(n_steps: int) -> int:
        for index in range(n_steps):
            env.step(actions[index % N_ACTIONS_AHEAD])
            if not env.agents:
                env.reset()
        return n_steps

    return take


def gymnasium_stepper(env: Any) -> Callable[[int], int]:
    """Return the same for a Gymnasium environment."""
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(N_ACTIONS_AHEAD)]

    def take(n_steps: int) -> int:
        for index in range(n_steps):
            _, _, terminated, truncated, _ = env.step(actions[index % N_ACTIONS_AHEAD])
            if np.all(terminated) or np.all(truncated):
                env.reset()
        return n_steps

    return take


def vector_stepper(num_envs: int, mode: str) -> Callable[[int], int]:
    """Return the same for a batch; a step of B rows counts as B."""
    envs = mapp_env.make_vec(num_envs, autoreset_mode=mode)
    envs.reset(seed=0)
    actions = np.random.default_rng(0).integers(0, 4, (64, num_envs, 3))
    for joint_actions in actions:  # spread the rows over their episodes
        envs.step(joint_actions)

    def take(n_steps: int) -> int:
        rounds = max(1, n_steps // num_envs)
        for index in range(rounds):
            envs.step(actions[index % len(actions)])
        return rounds * num_envs

    return take


def rate(take: Callable[[int], int], n_steps: int) -> float:
    """Return steps per CPU second."""
    started = time.process_time()
    taken = take(n_steps)
    return taken / (time.process_time() - started)


def compare(takers: dict[str, Callable[[int], int]], floor: str, seconds: float) -> dict[str, Any]:
    """Time everything alternately; return each median rate and median ratio to the floor."""
    n_steps = {}
    for name, take in takers.items():
        take(100)
        n_steps[name] = max(100, int(rate(take, 1000) * seconds / TURNS))
    rates: dict[str, list[float]] = {name: [] for name in takers}
    for _ in range(TURNS):
        for name, take in takers.items():
            rates[name].append(rate(take, n_steps[name]))
    return {
        name: (
            median(rates[name]),
            median(own / base for own, base in zip(rates[name], rates[floor], strict=True)),
        )
        for name in takers
    }


def peers() -> dict[str, Callable[[int], int]]:
    """Return the installed peers, at about this environment's size."""
    found: dict[str, Callable[[int], int]] = {}
    makers: dict[str, Callable[[], Callable[[int], int]]] = {
        "pogema 8x8, 3 agents, PettingZoo": _pogema,
        "mpe2 simple_spread, 3 agents": lambda: parallel_stepper(
            importlib.import_module("mpe2.simple_spread_v3").parallel_env()
        ),
        "lbforaging 8x8-3p-3f": _lbforaging,
    }
    for name, make in makers.items():
        try:
            found[name] = make()
        except ImportError:
            print(f"not installed, left out: {name}")
    return found


def _pogema() -> Callable[[int], int]:
    pogema = importlib.import_module("pogema")
    config = pogema.GridConfig(
        size=8, num_agents=3, density=0.15, max_episode_steps=50, integration="PettingZoo", seed=0
    )
    return parallel_stepper(pogema.pogema_v0(config))


def _lbforaging() -> Callable[[int], int]:
    import gymnasium

    importlib.import_module("lbforaging")
    return gymnasium_stepper(
        gymnasium.make("Foraging-8x8-3p-3f-v3", disable_env_checker=True).unwrapped
    )


START = """
import time
started = time.perf_counter()
import mapp_env
imported = time.perf_counter()
env = mapp_env.mapp_v0.parallel_env()
env.reset(seed=0)
env.step({agent: 0 for agent in env.agents})
print(imported - started, time.perf_counter() - imported)
"""


def start_times() -> None:
    """Print how long import and the first step take, without and with cached kernels."""
    with tempfile.TemporaryDirectory() as cache:
        environ = {**os.environ, "NUMBA_CACHE_DIR": cache}
        environ.pop("PYTHONDONTWRITEBYTECODE", None)
        runs = []
        for _ in range(4):
            output = subprocess.run(
                [sys.executable, "-P", "-c", START], env=environ, check=True, capture_output=True
            )
            runs.append([float(figure) for figure in output.stdout.split()])
    warm = runs[1:]
    print("\nstarting, wall seconds (best of 3 when warm)")
    print(f"  import mapp_env                  warm {min(run[0] for run in warm):.2f}")
    print(
        f"  construct + reset + first step   warm {min(run[1] for run in warm):.2f}, "
        f"cold (compiling) {runs[0][1]:.1f}"
    )


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--seconds", type=float, default=1.5, help="CPU seconds per line (default 1.5)"
    )
    arguments = parser.parse_args()
    floor = "do-nothing ParallelEnv, 3 agents"
    takers = {floor: parallel_stepper(DoNothing())}
    takers["mapp_v0.parallel_env()"] = parallel_stepper(mapp_v0.parallel_env())
    for kind in ("own_first", "planes", "geodesic"):
        env = mapp_v0.parallel_env(observation=kind)
        takers[f"mapp_v0.parallel_env(observation={kind!r})"] = parallel_stepper(env)
    takers["mapp_v0.env()  (AEC, agent-steps)"] = aec_stepper(mapp_v0.env())
    for num_envs in (1, 64, 4096):
        takers[f"make_vec({num_envs}), next-step"] = vector_stepper(num_envs, "NextStep")
    takers["make_vec(4096), same-step"] = vector_stepper(4096, "SameStep")
    takers.update(peers())
    result = compare(takers, floor, arguments.seconds)
    print(f"\n{'env-steps a CPU second, one core':<52}{'rate':>14}{'ratio to floor':>16}")
    for name, (speed, ratio) in result.items():
        print(f"{name:<52}{speed:>14,.0f}{ratio:>16.3f}")
    agents = 3 * result["make_vec(4096), next-step"][0] / 1e6
    print(f"\nagent-steps a CPU second of make_vec(4096): {agents:.1f} million")
    start_times()


def aec_stepper(env: Any) -> Callable[[int], int]:
    """Return the same for the AEC environment; n counts the steps of single agents."""
    env.reset(seed=0)

    def take(n_steps: int) -> int:
        for index in range(n_steps):
            if not env.agents:
                env.reset()
            _, _, terminated, truncated, _ = env.last()
            env.step(None if terminated or truncated else index % 4)
        return n_steps

    return take


if __name__ == "__main__":
    main()
