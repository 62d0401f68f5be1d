"""Play fixed episodes and write down what happened: the trajectories that pin version 0.

Usage::

    python tests/golden/make.py            # rewrite tests/golden/*.json
    python tests/golden/make.py --digest   # print one digest of every setting and face

A golden file changes only together with a new version of the environment: what it holds is what
users' saved results were made with. ``--digest`` is how the tests compare compiled kernels with
the same source run as plain Python (``NUMBA_DISABLE_JIT=1``).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

import mapp_env
from mapp_env import mapp_v0

FOLDER = Path(__file__).resolve().parent

CORRIDOR = "D......\n"
YARD = ".....\n.#.#.\n..D..\n.#.#.\n....#\n@@@@@\n"

SETTINGS: dict[str, dict[str, Any]] = {
    "paper": {},
    "paper-geodesic": {"reward": "geodesic", "observation": "own_first"},
    "paper-step-wait": {"reward": "step", "allow_wait": True, "n_agents": 2},
    "paper-planes": {"observation": "planes", "n_agents": 4, "n_landmarks": 3},
    "paper-features": {"observation": "geodesic", "n_agents": 7, "n_landmarks": 12},
    "corridor": {"grid": CORRIDOR, "n_agents": 1, "n_landmarks": 3, "max_cycles": 20},
    "yard": {"grid": YARD, "n_agents": 5, "n_landmarks": 8, "max_cycles": 40},
    "yard-features": {
        "grid": YARD, "n_agents": 1, "n_landmarks": 2, "observation": "geodesic",
        "reward": "geodesic", "allow_wait": True, "max_cycles": 200,
    },
}  # fmt: skip

SEEDS = (0, 1, 2**32 + 5)


def arguments(name: str) -> dict[str, Any]:
    """Return the arguments of a setting, its grid built from text."""
    chosen = dict(SETTINGS[name])
    if "grid" in chosen:
        chosen["grid"] = mapp_env.Grid.from_text(chosen["grid"])
    return chosen


def draw_actions(seed: int, n_steps: int, n_agents: int, n_actions: int) -> list[list[int]]:
    """Return joint actions from a little congruential generator, the same on every platform.

    Each agent keeps its direction for a few steps, so that it gets about.
    """
    number = seed % 2**31 + 12345
    actions = [[0] * n_agents for _ in range(n_steps)]
    for step in range(n_steps):
        for agent in range(n_agents):
            number = (1103515245 * number + 12345) % 2**31
            turn = (number >> 16) % 3 == 0 or step == 0
            number = (1103515245 * number + 12345) % 2**31
            previous = actions[step - 1][agent]
            actions[step][agent] = (number >> 16) % n_actions if turn else previous
    return actions


def digest_of(array: np.ndarray) -> str:
    """Return a short digest of an array's dtype, shape and bytes (little-endian)."""
    little = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False)
    head = f"{array.dtype.name}{array.shape}".encode()
    return hashlib.sha256(head + little.tobytes()).hexdigest()[:16]


def play(name: str, seed: int) -> dict[str, Any]:
    """Play one episode through the parallel face; return what JSON can hold of it."""
    env = mapp_v0.parallel_env(**arguments(name))
    observations, infos = env.reset(seed=seed)
    agents = list(env.possible_agents)
    n_actions = int(env.action_space(agents[0]).n)
    n_landmarks = (env.state().size - len(agents)) // 2
    landmarks = env.state()[len(agents) : len(agents) + n_landmarks].astype(int).tolist()
    actions = draw_actions(seed, env.max_cycles, len(agents), n_actions)
    rewards, states = [], [env.state()]
    views = [observations[agent] for agent in agents]
    masks = [infos[agent]["action_mask"] for agent in agents]
    terminations: dict[str, bool] = {}
    for joint in actions:
        observations, reward, terminations, _, infos = env.step(
            dict(zip(agents, joint, strict=True))
        )
        assert len(set(reward.values())) == 1
        rewards.append(reward[agents[0]])
        states.append(env.state())
        views += [observations[agent] for agent in agents]
        masks += [infos[agent]["action_mask"] for agent in agents]
        if not env.agents:
            break
    assert not env.agents
    metrics = {
        key: None if isinstance(value, float) and math.isinf(value) else value
        for key, value in infos[agents[0]]["metrics"].items()
    }
    return {
        "seed": seed,
        "landmarks": landmarks,
        "actions": actions[: len(rewards)],
        "rewards": rewards,
        "terminated": terminations[agents[0]],
        "final_state": states[-1].astype(int).tolist(),
        "states": digest_of(np.array(states)),
        "observations": digest_of(np.array(views)),
        "masks": digest_of(np.array(masks)),
        "metrics": metrics,  # an infinite cost is null
    }


def play_batch(name: str, mode: AutoresetMode) -> str:
    """Return a digest of a batch in the autoreset mode ``mode``: 9 rows, 70 steps."""
    venv = mapp_env.make_vec(9, autoreset_mode=mode, **arguments(name))
    batch, _ = venv.reset(seed=17)
    nvec = venv.single_action_space.nvec
    actions = draw_actions(5, 70, 9 * len(nvec), int(nvec[0]))
    seen = [digest_of(batch)]
    for joint in actions:
        results = venv.step(np.array(joint).reshape(9, len(nvec)))
        seen += [digest_of(array) for array in results[:4]]
        seen.append(digest_of(results[4]["action_mask"]))
        if "metrics" in results[4]:
            seen.append(digest_of(results[4]["metrics"]["makespan"]))
        ended = results[2] | results[3]
        if mode == AutoresetMode.DISABLED and ended.any():
            seen.append(digest_of(venv.reset(options={"reset_mask": ended})[0]))
    return hashlib.sha256("".join(seen).encode()).hexdigest()[:16]


def play_everything() -> str:
    """Return one digest of all settings, seeds and faces."""
    seen: list[Any] = []
    for name in SETTINGS:
        seen += [play(name, seed) for seed in SEEDS]
        seen += [play_batch(name, mode) for mode in AutoresetMode]
        central = gymnasium.make("mapp_env/Central-v0", central_action="multi", **arguments(name))
        observation, info = central.reset(seed=3)
        seen.append(digest_of(observation) + digest_of(info["action_mask"]))
        n_agents = len(central.action_space.nvec)
        problem = mapp_env.Problem(
            arguments(name).get("grid") or mapp_env.make_grid("paper-7x7"),
            play(name, 0)["landmarks"],
            n_agents=n_agents,
        )
        plan = mapp_env.replay(problem, np.array(play(name, 0)["actions"]))
        seen.append([[int(cell) for cell in tour] for tour in plan.tours])
    return hashlib.sha256(json.dumps(seen).encode()).hexdigest()


def main() -> None:
    """Write the golden files, or print the digest."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--digest", action="store_true", help="print a digest, write nothing")
    if parser.parse_args().digest:
        print(play_everything())
        return
    for name in SETTINGS:
        lines = ",\n".join(json.dumps(play(name, seed)) for seed in SEEDS)
        (FOLDER / f"{name}.json").write_text(f"[\n{lines}\n]\n", encoding="utf-8")


if __name__ == "__main__":
    main()
