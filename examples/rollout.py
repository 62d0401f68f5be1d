"""Play one episode with a simple rule and save it as an animated GIF.

python examples/rollout.py --out rollout.gif
"""

from __future__ import annotations

import argparse

import numpy as np

import mapp_env
from mapp_env import mapp_v0
from mapp_env.rendering import save_gif


def spread_out(grid: mapp_env.Grid, state: np.ndarray, n_agents: int) -> list[int]:
    """Move each agent a step towards the nearest landmark not taken by an earlier agent."""
    n_landmarks = (len(state) - n_agents) // 2
    cells = state[:n_agents].astype(int)
    landmarks = state[n_agents : n_agents + n_landmarks].astype(int)
    left = set(landmarks[state[n_agents + n_landmarks :] == 0].tolist())
    free = set(left)
    actions = []
    for cell in cells:
        chosen = min(free or left, key=lambda landmark: (grid.distances[cell, landmark], landmark))
        free.discard(chosen)
        actions.append(int(np.argmin(grid.distances[grid.moves[cell], chosen])))
    return actions


def main() -> None:
    """Write the animation and print what the episode cost."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", default="rollout.gif", help="where to write (default rollout.gif)")
    parser.add_argument("--seed", type=int, default=3, help="seed of the problem (default 3)")
    arguments = parser.parse_args()

    env = mapp_v0.parallel_env(render_mode="rgb_array")
    _, infos = env.reset(seed=arguments.seed)
    frames = [env.render()]
    grid = mapp_env.make_grid("paper-7x7")
    while env.agents:
        moves = spread_out(grid, env.state(), len(env.agents))
        actions = dict(zip(env.agents, moves, strict=True))
        _, _, _, _, infos = env.step(actions)
        frames.append(env.render())
    metrics = infos["agent_0"]["metrics"]
    env.close()

    size = save_gif(arguments.out, frames)
    print(f"wrote {arguments.out}: {len(frames)} pictures, {size} bytes, {metrics}")


if __name__ == "__main__":
    main()
