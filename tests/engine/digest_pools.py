"""Print a digest of all that environments over pools say, for compiled and plain kernels alike.

It has no test: a test runs it twice, in a process of its own each time.
"""

from __future__ import annotations

import hashlib
import random
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from model import OBSERVATIONS, lively_action
from model_pools import random_game, random_landmarks, random_starts

import mapp_env
from mapp_env import mapp_v0


def add(digest: Any, item: Any) -> None:
    """Add a nested result to a digest: arrays by type, shape and bytes, all else as text."""
    if isinstance(item, np.ndarray) and item.dtype != object:
        digest.update(f"{item.dtype}{item.shape}".encode() + item.tobytes())
    elif isinstance(item, dict):
        for key in sorted(item):
            digest.update(key.encode())
            add(digest, item[key])
    elif isinstance(item, (list, tuple, np.ndarray)):
        for part in item:
            add(digest, part)
    else:
        digest.update(repr(item).encode())


def play(seed: int, digest: Any) -> None:
    """Add an episode with starts, and a batch with autoresets, of one random game."""
    game, rng = random_game(seed), random.Random(seed)
    arguments = {
        "grid": [mapp_env.Grid.from_text("\n".join(rows) + "\n") for rows in game.pool],
        **game.settings(observation=OBSERVATIONS[seed % len(OBSERVATIONS)]),
    }
    cells = random_landmarks(rng, game.pool[-1], game.n_landmarks)
    starts = random_starts(rng, game.episode(-1, cells))
    model = game.episode(-1, cells, starts, 20)
    problem = mapp_env.Problem(arguments["grid"][-1], cells, game.n_agents, 20, starts)
    env = mapp_v0.parallel_env(**arguments)
    add(digest, env.reset(options={"problem": problem}))
    while not model.ended:
        joint = lively_action(model, rng)
        model.step(joint)
        add(digest, env.step(dict(zip(env.agents, joint, strict=True))))
    envs = mapp_env.make_vec(3, autoreset_mode="SameStep", **arguments)
    add(digest, envs.reset(seed=seed))
    for _ in range(25):
        joint = [[rng.randrange(game.n_actions) for _ in range(game.n_agents)] for _ in range(3)]
        add(digest, envs.step(np.array(joint)))


if __name__ == "__main__":
    total = hashlib.sha256()
    for number in range(24):
        play(number, total)
    print(total.hexdigest())
