"""The environment in ten lines: three agents, five landmarks, random moves."""

from mapp_env import mapp_v0

env = mapp_v0.parallel_env(render_mode="ansi")
observations, infos = env.reset(seed=0)
while env.agents:
    actions = {a: env.action_space(a).sample(infos[a]["action_mask"]) for a in env.agents}
    observations, rewards, terminations, truncations, infos = env.step(actions)
print(env.render())
print(infos["agent_0"]["metrics"])
env.close()
