"""Relative novelty: a subgoal leads from states that were visited often to states that were not."""

from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from sb3_options.density.regions import Region
from sb3_options.discovery.methods.candidates import CandidateMethod
from sb3_options.discovery.methods.method import Experience
from sb3_options.experience.observations import FloatArray, IntArray


@dataclass(kw_only=True, eq=False)
class RelativeNovelty(CandidateMethod):
    """Şimşek & Barto (2004), *Using Relative Novelty to Identify Useful Temporal Abstractions in RL*.

    The novelty of some states is 1/√n̄, where n̄ is their mean visit count in the trajectory so far. The relative novelty
    of a time is the novelty of the states from it to ``lag`` steps later, over that of the ``lag`` steps before it. A
    state is a candidate at a time if this exceeds ``threshold``. A subgoal is a candidate more often than other states:
    if k of its n relative novelties exceed the threshold, pᵏ(1−p)ⁿ⁻ᵏ / (qᵏ(1−q)ⁿ⁻ᵏ) > ``odds``.

    Args:
        lag: l_n, in primitive steps.
        threshold: t_RN.
        p_target: p, probability that a visited subgoal is a candidate.
        p_other: q, the same for another state.
        odds: λ_fa/λ_miss · p(N)/p(T): cost ratio of false alarms to misses, times prior odds of other states, 100 each.
    """

    lag: Annotated[int, Field(ge=1)] = 7
    threshold: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 2.0
    p_target: Annotated[float, Field(gt=0, lt=1)] = 0.0712
    p_other: Annotated[float, Field(gt=0, lt=1)] = 0.0056
    odds: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 10_000.0

    def __post_init__(self) -> None:
        """Check the probabilities, and start without places."""
        if self.p_target <= self.p_other:
            raise ValueError(f"p_target must be above p_other, got {self.p_target} and {self.p_other}.")
        super().__init__()

    def update(self, experience: Experience) -> list[Region]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        places = experience.places
        times, relative = relative_novelty(places.visits, self.lag)
        k = len(places.points)
        seen = np.bincount(places.visits[times], minlength=k)
        hits = np.bincount(places.visits[times[relative > self.threshold]], minlength=k)
        return self._counted(experience, seen, hits)

    def _accepted(self, seen: FloatArray, hits: FloatArray) -> FloatArray:
        """Return the log likelihood ratio minus the log odds."""
        target, other = self.p_target, self.p_other
        evidence = hits * np.log(target / other) + (seen - hits) * np.log((1 - target) / (1 - other))
        return np.asarray(evidence - np.log(self.odds))


def relative_novelty(visits: IntArray, lag: int) -> tuple[IntArray, FloatArray]:
    """Return the times of a trajectory with ``lag`` steps on both sides, and their relative novelty."""
    total = np.concatenate([[0], np.cumsum(_count_so_far(visits))])
    times = np.arange(lag, len(visits) - lag)
    before = (total[times] - total[times - lag]) / lag
    after = (total[times + lag + 1] - total[times]) / (lag + 1)
    return times, np.sqrt(before / after)


def _count_so_far(visits: IntArray) -> IntArray:
    """Return for each time the visit count of its place so far, (T + 1,)."""
    order, sizes = np.argsort(visits, kind="stable"), np.bincount(visits)
    counts = np.empty(len(visits), dtype=np.int64)
    counts[order] = np.arange(1, len(visits) + 1) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return counts
