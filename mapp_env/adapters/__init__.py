"""What trainers of other projects need and do not bring; docs/trainers.md shows each in use.

Importing this package loads no trainer. Each of its modules loads the one that it is for:

- :mod:`mapp_env.adapters.sb3_vec`: the batched engine as a Stable-Baselines3 ``VecEnv``;
- :mod:`mapp_env.adapters.sb3_shared`: agents that share parameters, SuperSuit under
  Stable-Baselines3;
- :mod:`mapp_env.adapters.sb3_rows`: what the two have in common;
- :mod:`mapp_env.adapters.sb3_returns`: a callback that keeps episodes' returns and minds the clock;
- :mod:`mapp_env.adapters.same_infos`: infos with the same entries at every step, for TorchRL;
- :mod:`mapp_env.envs.tuple_env`: ``mapp_env/Tuple-v0`` for trainers in EPyMARL's manner.
"""
