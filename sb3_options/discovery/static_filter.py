"""Which states may be subgoals at all: those away from start and goal."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from sb3_options.experience.observations import BoolArray, FloatArray, IntArray

StaticFilter: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray], BoolArray]
"""Scaled features of the states (m, d), start (d,) and end (d,) → which states may be subgoals, shape (m,)."""


def near_start_and_goal(start_radius: float = 2.0, goal_radius: float = 2.0) -> StaticFilter:
    """Make the default static filter: no subgoal within a radius, in scaled units, of the first or the last state.

    The states around start and goal lie on every successful trajectory without being bottlenecks (McGovern & Barto
    2001, §4, after Iba 1989).
    """

    def keep(features: FloatArray, start: FloatArray, end: FloatArray) -> BoolArray:
        from_start = np.linalg.norm(features - start, axis=1)
        from_end = np.linalg.norm(features - end, axis=1)
        kept: BoolArray = (from_start > start_radius) & (from_end > goal_radius)
        return kept

    return keep


def steps_from_start_and_goal(visits: IntArray, start_radius: float, goal_radius: float) -> BoolArray:
    """`near_start_and_goal` for states without distances: radii count steps along the trajectory."""
    first = np.unique(visits, return_index=True)[1]
    left = np.unique(visits[::-1], return_index=True)[1]
    return (first > start_radius) & (left > goal_radius)


def steps_from(rows: IntArray, visits: IntArray) -> IntArray:
    """Return the fewest steps along a trajectory from each of its states to a visit of one of ``rows``."""
    fewest = np.full(int(visits.max()) + 1, len(visits))
    if len(rows) == 0:
        return fewest
    among = np.zeros(len(fewest), dtype=bool)
    among[rows] = True
    times, at = np.arange(len(visits)), np.flatnonzero(among[visits])
    place = np.searchsorted(at, times)
    after, before = at[np.minimum(place, len(at) - 1)], at[np.maximum(place - 1, 0)]
    np.minimum.at(fewest, visits, np.minimum(np.abs(after - times), np.abs(times - before)))
    return fewest
