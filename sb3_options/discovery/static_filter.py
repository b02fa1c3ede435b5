"""From trajectories to bags: first visits only, without what surrounds the start and the goal."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from sb3_options.experience.observations import BoolArray, FloatArray
from sb3_options.experience.trajectories import Trajectory

SuccessRule: TypeAlias = Callable[[Trajectory], bool]
"""Whether a trajectory's bag is positive."""

StaticFilter: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray], BoolArray]
"""Scaled features (m, d), those of the start (d,) and of the end (d,) → which may be subgoals, shape (m,)."""


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


def near_start_and_goal(start_radius: float = 2.0, goal_radius: float = 5.0) -> StaticFilter:
    """The default static filter: nothing within these distances of the trajectory's first and last state.

    The states around start and goal lie on every successful trajectory without being bottlenecks (McGovern & Barto
    2001, §4, after Iba 1989).

    Args:
        start_radius: In scaled units of concept space, ≥ 0.
        goal_radius: Likewise.

    Raises:
        ValueError: A radius is negative.
    """
    if not (start_radius >= 0 and goal_radius >= 0):
        raise ValueError(f"start_radius and goal_radius must be at least 0, got {start_radius} and {goal_radius}.")

    def keep(features: FloatArray, start: FloatArray, end: FloatArray) -> BoolArray:
        from_start = np.linalg.norm(features - start, axis=1)
        from_end = np.linalg.norm(features - end, axis=1)
        kept: BoolArray = (from_start > start_radius) & (from_end > goal_radius)
        return kept

    return keep


def bag_of(features: FloatArray, visits_last: int, scale: FloatArray, static_filter: StaticFilter) -> FloatArray:
    """The bag of one trajectory: its distinct features in order of first visit, filtered.

    Only first visits: a state that is visited often would otherwise count often in the noisy-or (McGovern & Barto
    2001, §3).

    Args:
        features: φ of the trajectory's distinct observations, in order of first visit, shape (m, d).
        visits_last: Row of the last state.
        scale: Factor for every feature, shape (d,).
        static_filter: What may be a subgoal.

    Returns:
        Instances, shape (n, d), n ≤ m, possibly 0.

    Raises:
        ValueError: The filter returned another shape.
    """
    keep = np.asarray(static_filter(features * scale, features[0] * scale, features[visits_last] * scale), dtype=bool)
    if keep.shape != (len(features),):
        raise ValueError(f"static_filter must return shape ({len(features)},), one bool a state, got {keep.shape}.")
    kept = features[keep]
    _, first = np.unique(kept, axis=0, return_index=True)
    bag: FloatArray = kept[np.sort(first)]
    return bag
