"""The cost of searches in nominal seconds, by which the `Diary` decides whether one more is affordable.

A run scheduled by the clock could not be repeated or resumed exactly. So training and discovery are counted in nominal
seconds. These follow from numbers that are the same in every run: primitive steps and the sizes of searches. All
constants were measured on one core.
"""

# Training time of a primitive step. The fastest network of the examples, PPO in two rooms with 8 environments, takes
# 0.33 ms. If a step takes longer, discovery uses less than its share.
STEP_SECONDS = 3e-4
TABLE_STEP_SECONDS = 3.6e-5  # the same for tabular values: MacroQ in gridworlds takes 0.035 to 0.05 ms

SHORTEST = 40_000  # least primitive steps assumed for training a network, so that first searches come early
TABLE_SHORTEST = 14_000  # the same for a table

SECONDS = {
    "search": 4.5e-3,  # one search of bags
    "pair": 7e-10,  # in a search, per feature of each pair of instance and point; within a factor of two
    "direct": 5e-4,  # finding peaks that are certain without a search, or searching one-hot codes
    "certain": 1.2e-9,  # per feature of each instance
    "one_hot": 1.2e-8,  # per feature of each instance: states are counted
    "trajectory": 5e-6,  # making bags, per trajectory in the database
    "state": 5e-6,  # per new state
    "state_feature": 2e-8,  # per feature of a new state
    "way_pair": 1.5e-10,  # per feature of each pair of new state and instance
    "cut": 1.5e-4,  # computing the share that one state cuts off
    "contrast": 3e-4,  # one update of a group's contrast
    "compared": 4e-6,  # per trajectory
    "cell": 1e-8,  # per pair of a state with a trajectory or a state
    "telling": 3.6e-4,  # one update of another method, beside its own estimate
    "step": 5e-7,  # per step of its trajectory
    "feature": 2e-8,  # per feature of each state
}
"""Nominal seconds of each unit of work."""

POINT_FEATURES = 4  # fixed cost of a pair, in features, besides its own features


def nominal_seconds(**units: float) -> float:
    """Return the nominal time of some work: Σ `SECONDS` · number of units."""
    return sum(SECONDS[name] * n for name, n in units.items())
