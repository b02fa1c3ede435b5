"""Which searches discovery can afford: a share of training, counted in work and not by the clock.

A schedule by the clock would make another run of the same seed, and of a run that was killed and resumed. So both sides
are counted in nominal seconds, which follow from numbers that are the same in every run: the steps that were lived
through, and the sizes of what was searched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

STEP_SECONDS = 3e-4
"""Nominal time of training for a primitive step. PPO in two rooms with 8 environments, the fastest network here, takes
0.33 ms on one core. Where a step takes longer, discovery takes a smaller share than it may."""

TABLE_STEP_SECONDS = 3.6e-5
"""Likewise where values are in a table: MacroQ in gridworlds takes 0.035 to 0.05 ms."""

SHORTEST = 14_000
"""Primitive steps that training is taken to last at least: searches are wanted early."""

SEARCH_SECONDS = 4.5e-3
PAIR_SECONDS = 7e-10
"""Nominal time of a search, and for each feature of each pair of an instance and a point it is compared with. Measured
with 2 to 2,352 features and 40 to 1,800 instances, within a factor of two."""

POINT_FEATURES = 4
"""Features that a pair takes the time of besides its own."""

CERTAIN_SECONDS, HELD_SECONDS = 5e-4, 1.2e-9
"""Nominal time where the peaks are certain without a search, and for each feature of each instance to see that."""

EXHAUSTIVE_SHARE = 0.25
"""An evaluation of an exhaustive search takes this share of one that has a gradient, too."""

ONE_HOT_SEARCH_SECONDS = 5e-4
ONE_HOT_SECONDS = 1.2e-8
"""Likewise of a search among one-hot codes, and for each feature of each instance: states are counted there."""

STATE_SECONDS = 5e-6
STATE_FEATURE_SECONDS = 2e-8
WAY_PAIR_SECONDS = 1.5e-10
"""Nominal time of making bags: for each new state, for each of its features, and for each feature of each pair of a new
state and an instance."""

CUT_SECONDS = 1.5e-4
"""Nominal time of computing what a state cuts off."""

TRAJECTORY_SECONDS = 5e-6
"""Nominal time of looking at a trajectory again."""

ASCENTS = 96
"""Evaluations of all instances by the points that ascend: 8 of them in 12 steps."""

TRIED_BAGS = 3
MOST_PAIRS = 1 << 20
"""A search tries the instances of so many of the smallest positive bags, and compares about so many pairs of them with
others, as `DiverseDensity` has it."""

GROUP_SECONDS = 3e-4
COMPARED_SECONDS = 2e-5
CELL_SECONDS = 1e-8
"""Nominal time of the contrast of a group, for each trajectory, and for each pair of a state with a trajectory or a
state."""


@dataclass
class Budget:
    """What discovery has taken, and what it may take, in nominal seconds.

    Attributes:
        max_share: Largest share of training time; None for any.
        steps: Primitive steps that were lived through.
        spent: What discovery has taken.
        skipped: Searches that were not made.
        step_seconds: What training takes for a primitive step.
    """

    max_share: float | None
    steps: int = 0
    spent: float = 0.0
    skipped: int = 0
    step_seconds: float = STEP_SECONDS

    def affords(self) -> bool:
        """Whether one more search may be made. One that cost too much is paid off before the next."""
        if self.max_share is None:
            return True
        if self.spent <= self.max_share * self.step_seconds * max(SHORTEST, self.steps):
            return True
        self.skipped += 1
        return False

    def get_state(self) -> dict[str, float]:
        """For a checkpoint."""
        return {"steps": self.steps, "spent": self.spent, "skipped": self.skipped}

    def set_state(self, state: dict[str, float]) -> None:
        """Go on with what `get_state` gave."""
        self.steps, self.spent, self.skipped = int(state["steps"]), state["spent"], int(state["skipped"])


def seconds_of_bags(n_trajectories: int, n_new: int, n_instances: int, n_features: int) -> float:
    """Nominal time of making the bags of a database.

    Args:
        n_trajectories: In the database.
        n_new: States of the trajectories that are new.
        n_instances: In all bags.
        n_features: Of an instance.
    """
    of_pairs = WAY_PAIR_SECONDS * n_instances * (n_features + POINT_FEATURES)
    of_a_state = STATE_SECONDS + STATE_FEATURE_SECONDS * n_features + of_pairs
    return n_trajectories * TRAJECTORY_SECONDS + n_new * of_a_state


def seconds_of_search(n_instances: int, n_points: float, n_features: int) -> float:
    """Nominal time of a search.

    Args:
        n_instances: In all bags.
        n_points: Evaluations of all of them.
        n_features: Of an instance.
    """
    return SEARCH_SECONDS + PAIR_SECONDS * n_instances * n_points * (n_features + POINT_FEATURES)


def seconds_of_certain(n_instances: int, n_features: int) -> float:
    """Nominal time where the peaks are certain without a search.

    Args:
        n_instances: In all bags.
        n_features: Of an instance.
    """
    return CERTAIN_SECONDS + HELD_SECONDS * n_instances * n_features


def n_compared(sizes: Sequence[int], n_instances: int) -> int:
    """Points that a gradient search compares with all instances.

    Args:
        sizes: Instances of each positive bag.
        n_instances: In all bags.
    """
    tried = min(sum(sorted(sizes)[:TRIED_BAGS]), max(2 * ASCENTS, MOST_PAIRS // n_instances))
    return ASCENTS + tried


def seconds_of_counting(n_instances: int, n_features: int) -> float:
    """Nominal time of a search among one-hot codes.

    Args:
        n_instances: In all bags.
        n_features: Of an instance.
    """
    return ONE_HOT_SEARCH_SECONDS + ONE_HOT_SECONDS * n_instances * n_features


def seconds_of_contrast(n_trajectories: int, n_states: int) -> float:
    """Nominal time of the contrast of a group of features.

    Args:
        n_trajectories: That are compared.
        n_states: Distinct ones of the group.
    """
    return GROUP_SECONDS + COMPARED_SECONDS * n_trajectories + CELL_SECONDS * n_states * (n_trajectories + n_states)
