"""Which trajectories succeeded."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np

from sb3_options.experience.trajectories import Trajectory

SuccessRule: TypeAlias = Callable[[Trajectory], bool]
"""Whether a trajectory succeeded, so that its bag is positive."""


def success_in(info: Mapping[str, Any]) -> bool | None:
    """What the info that ends an episode says of it; None where it says nothing.

    Args:
        info: Its ``is_success``, if any, is a truth value, or 0 or 1 of any type, perhaps as an array of one element.

    Raises:
        ValueError: It is anything else, which might count as success by being something: NaN, "no".
    """
    said = info.get("is_success")
    if said is None:
        return None
    array = np.asarray(said)
    if array.size != 1 or array.dtype.kind not in "biuf" or array.item() not in (0, 1):
        raise ValueError(
            f'info["is_success"] must be True or False (or 1 or 0), got {said!r}: let the environment say which of the '
            "two it means, or leave it out and say what success is by SubgoalDiscoveryCallback(success=...)."
        )
    return bool(array.item())


def reported_success(trajectory: Trajectory) -> bool:
    """What the environment says in ``info["is_success"]``.

    For one that does not say: whether it ended in a terminal state with a positive reward that exceeds all earlier
    ones, the reward peak of Iba (1989) that McGovern & Barto (2001, §2) take over.
    """
    if trajectory.is_success is not None:
        return trajectory.is_success
    rewards = trajectory.rewards
    return trajectory.terminated and len(rewards) > 0 and float(rewards[-1]) > float(rewards[:-1].max(initial=0.0))


def success_by_return(threshold: float) -> SuccessRule:
    """Success is an undiscounted return of at least ``threshold``."""
    return lambda trajectory: float(trajectory.rewards.sum()) >= threshold


def success_by_steps(limit: int) -> SuccessRule:
    """Success is reported success within ``limit`` primitive steps (McGovern & Barto 2001, §4).

    Raises:
        ValueError: ``limit`` < 1.
    """
    if limit < 1:
        raise ValueError(f"limit must be at least 1 primitive step, got {limit}.")
    return lambda trajectory: reported_success(trajectory) and len(trajectory) <= limit
