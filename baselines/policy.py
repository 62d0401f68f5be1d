"""``load_policy`` by its first name; policies live in :mod:`baselines.policies`."""

from baselines.policies.policy import load_policy

__all__ = ["load_policy"]
