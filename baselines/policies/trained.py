"""A trained policy together with what it was trained for."""

from pathlib import Path
from typing import NamedTuple

from baselines.policies.policy import NetworkPolicy, find_weights, load_policy
from baselines.policies.settings import Setting, check_fits, read_setting


class Trained(NamedTuple):
    """A policy, its task, and the problems that its training began with."""

    policy: NetworkPolicy
    setting: Setting
    problems: list[tuple[int, ...]]


def load_trained(name: str | Path) -> Trained:
    """Load a policy and what its folder says of it.

    Raises
    ------
    ValueError
        If there is no such policy, or its folder does not say what it was trained for.
    """
    policy = load_policy(name)
    folder = find_weights(name).parent
    setting, problems = read_setting(folder)
    check_fits(policy.spec, setting, folder)
    return Trained(policy, setting, problems)
