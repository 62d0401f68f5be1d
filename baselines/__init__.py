"""Runnable baselines of mapp_env: the paper's meta-agent and what it is compared with."""

import importlib.util

for _name in ("torch", "tyro", "safetensors"):
    if importlib.util.find_spec(_name) is None:
        raise ModuleNotFoundError(
            f"the baselines need {_name}: in a checkout, "
            'pip install -c constraints.txt -e ".[baselines]"',
            name=_name,
        )
