"""What searches take in nominal seconds, by which the `Diary` decides whether one more is affordable.

A schedule by the clock would make a run that cannot be repeated or resumed exactly. So training and discovery are both
counted in nominal seconds, which follow from numbers that are the same in every run: primitive steps, and the sizes of
what was searched. All constants were measured on one core.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

STEP_SECONDS = 3e-4
"""Of training for a primitive step: PPO in two rooms with 8 environments, the fastest network of the examples, takes
0.33 ms. Where a step takes longer, discovery takes a smaller share than it may."""

TABLE_STEP_SECONDS = 3.6e-5
"""The same where values are in a table: MacroQ in gridworlds takes 0.035 to 0.05 ms."""

SHORTEST = 40_000
TABLE_SHORTEST = 14_000
"""Primitive steps that training of a network, or of a table, is assumed to last at least: searches are wanted early."""

SEARCH_SECONDS = 4.5e-3
PAIR_SECONDS = 7e-10
"""Of a search, and for each feature of each pair of an instance and a point it is compared with. Measured with 2 to
2,352 features and 40 to 1,800 instances, within a factor of two."""

POINT_FEATURES = 4
"""Features that a pair takes the time of besides its own."""

CERTAIN_SECONDS = 5e-4
HELD_SECONDS = 1.2e-9
"""Where the peaks are certain without a search, and for each feature of each instance to see that."""

EXHAUSTIVE_SHARE = 0.25
"""An evaluation without a gradient takes this share of one with a gradient."""

ONE_HOT_SEARCH_SECONDS = 5e-4
ONE_HOT_SECONDS = 1.2e-8
"""Of a search among one-hot codes, and for each feature of each instance: states are counted there."""

STATE_SECONDS = 5e-6
STATE_FEATURE_SECONDS = 2e-8
WAY_PAIR_SECONDS = 1.5e-10
TRAJECTORY_SECONDS = 5e-6
"""Of making bags: for each new state, for each of its features, for each feature of each pair of a new state and an
instance, and for each trajectory that is looked at again."""

CUT_SECONDS = 1.5e-4
"""Of computing what a state cuts off."""

ASCENTS = 96
"""Evaluations of all instances by the points that ascend: 8 of them in 12 steps."""

TRIED_BAGS = 3
MOST_PAIRS = 1 << 20
"""A search tries the instances of so many of the smallest positive bags, and compares about so many pairs of them with
others, as `DiverseDensity` has it."""

GROUP_SECONDS = 3e-4
COMPARED_SECONDS = 4e-6
CELL_SECONDS = 1e-8
"""Of the contrast of a group, for each trajectory, and for each pair of a state with a trajectory or a state."""

TELL_SECONDS = 3.6e-4
UPDATE_SECONDS = 5e-7
FEATURE_SECONDS = 2e-8
"""Of another method's update beside its own estimate, for each step, and for each feature of each state."""


def seconds_of_bags(n_trajectories: int, n_new: int, n_instances: int, n_features: int, n_cuts: int = 0) -> float:
    """Nominal seconds of making the bags of a database, where so many states are new, and so many cuts."""
    of_pairs = WAY_PAIR_SECONDS * n_instances * (n_features + POINT_FEATURES)
    of_a_state = STATE_SECONDS + STATE_FEATURE_SECONDS * n_features + of_pairs
    return n_trajectories * TRAJECTORY_SECONDS + n_new * of_a_state + CUT_SECONDS * n_cuts


def seconds_of_search(
    kind: Literal["gradient", "exhaustive", "one-hot"], sizes: Sequence[int], n_instances: int, n_features: int
) -> float:
    """Nominal seconds of a search."""
    if kind == "one-hot":
        return ONE_HOT_SEARCH_SECONDS + ONE_HOT_SECONDS * n_instances * n_features
    if kind == "exhaustive":
        n_points = sum(sizes) * EXHAUSTIVE_SHARE
    else:
        n_points = ASCENTS + min(sum(sorted(sizes)[:TRIED_BAGS]), max(2 * ASCENTS, MOST_PAIRS // n_instances))
    return SEARCH_SECONDS + PAIR_SECONDS * n_instances * n_points * (n_features + POINT_FEATURES)


def seconds_of_certain(n_instances: int, n_features: int) -> float:
    """Nominal seconds where the peaks are certain without a search."""
    return CERTAIN_SECONDS + HELD_SECONDS * n_instances * n_features


def seconds_of_contrast(n_trajectories: int, n_states: int) -> float:
    """Nominal seconds of the contrast of a group with so many distinct states."""
    return GROUP_SECONDS + COMPARED_SECONDS * n_trajectories + CELL_SECONDS * n_states * (n_trajectories + n_states)


def seconds_of_telling(n_steps: int, n_numbers: int) -> float:
    """Nominal seconds of preparing a trajectory of so many steps and numbers for a method."""
    return TELL_SECONDS + UPDATE_SECONDS * n_steps + FEATURE_SECONDS * n_numbers
