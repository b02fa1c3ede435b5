"""What searches take in nominal seconds, by which the `Diary` decides whether one more is affordable.

A schedule by the clock would make a run that cannot be repeated or resumed exactly. So training and discovery are both
counted in nominal seconds, which follow from numbers that are the same in every run: primitive steps, and the sizes of
what was searched. All constants were measured on one core.
"""

from __future__ import annotations

STEP_SECONDS = 3e-4
"""Of training for a primitive step: PPO in two rooms with 8 environments, the fastest network of the examples, takes
0.33 ms. Where a step takes longer, discovery takes a smaller share than it may."""

TABLE_STEP_SECONDS = 3.6e-5
"""The same where values are in a table: MacroQ in gridworlds takes 0.035 to 0.05 ms."""

SHORTEST = 40_000
TABLE_SHORTEST = 14_000
"""Primitive steps that training of a network, or of a table, is assumed to last at least: searches are wanted early."""

SECONDS = {
    "search": 4.5e-3,  # of bags
    "pair": 7e-10,  # in it, for each feature of each pair of an instance and a point; within a factor of two
    "direct": 5e-4,  # peaks that are certain without a search, or a search among one-hot codes
    "certain": 1.2e-9,  # for each feature of each instance
    "one_hot": 1.2e-8,  # for each feature of each instance: states are counted
    "trajectory": 5e-6,  # of making bags, for each one that is looked at again
    "state": 5e-6,  # for each new state
    "state_feature": 2e-8,  # for each of its features
    "way_pair": 1.5e-10,  # for each feature of each pair of a new state and an instance
    "cut": 1.5e-4,  # of computing what a state cuts off
    "contrast": 3e-4,  # of a group
    "compared": 4e-6,  # for each trajectory
    "cell": 1e-8,  # for each pair of a state with a trajectory or a state
    "telling": 3.6e-4,  # of another method's update, beside its own estimate
    "step": 5e-7,  # for each step of its trajectory
    "feature": 2e-8,  # for each feature of each state
}
"""Nominal seconds of each unit of work."""

POINT_FEATURES = 4
"""Features that a pair takes the time of besides its own."""


def nominal_seconds(**units: float) -> float:
    """The time of some work: Σ `SECONDS` · number of units."""
    return sum(SECONDS[name] * n for name, n in units.items())
