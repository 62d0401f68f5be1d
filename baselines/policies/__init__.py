"""Policies, and how they are judged."""

from baselines.policies.evaluation import play
from baselines.policies.policy import load_policy

__all__ = ["load_policy", "play"]
