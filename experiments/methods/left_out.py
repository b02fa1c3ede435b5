"""Entrants of the race that the library leaves out: two counts of visits, and two methods on graphs of transitions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np
import rustworkx as rx
from pydantic import Field, validate_call
from pydantic.dataclasses import dataclass
from scipy.linalg import eigh

from sb3_options.density.regions import Region
from sb3_options.discovery.methods import Experience
from sb3_options.discovery.methods.candidates import CandidateMethod
from sb3_options.discovery.methods.method import Method
from sb3_options.discovery.peaks import MOST_TIED, PeakTracker, plateau_centres
from sb3_options.experience.observations import FloatArray, IntArray

GRAPH_SECONDS = 2e-4
"""Nominal time of a graph."""

CUT_SECONDS = (5e-8, 4e-11)
"""Nominal times of a cut, for the square and for the cube of the number of places."""

PATH_SECONDS = 2e-8
"""Nominal time of betweenness, for each place and transition."""

TOLERANCE = 1e-9
"""Betweenness that differs by less, relative to the largest, is equal."""


@dataclass(kw_only=True, eq=False)
class FirstVisits(CandidateMethod):
    """McGovern & Barto (2001), §3: the place that most successful trajectories visit.

    It must persist: its running average (their §5) must exceed a share of its limit.

    Args:
        decay: λ of the running averages.
        threshold: Share of the limit λ/(1−λ).
        min_successes: Successful trajectories before the first place counts.
        radius: Places within this distance of each other are one, in scaled units.
    """

    STATE = ("_successes", "_tracker")

    needs_success = True

    decay: Annotated[float, Field(gt=0, lt=1)] = 0.75
    threshold: Annotated[float, Field(ge=0, lt=1)] = 0.6
    min_successes: Annotated[int, Field(ge=1)] = 4
    radius: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.5

    def __post_init__(self) -> None:
        """Begin without places."""
        super().__init__()
        self._tracker = PeakTracker(decay=self.decay, radius=self.radius)
        self._successes = 0

    def update(self, experience: Experience) -> list[Region]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        if not experience.success:
            return []
        self._successes += 1
        visits = np.bincount(experience.places.visits)
        most = self._counted(experience, visits, self._hits(visits))
        if self._successes < self.min_successes or not most:
            return []
        points = np.array([region.points[0] for region in most[: MOST_TIED + 1]])
        few = len(points) <= MOST_TIED
        centres = plateau_centres(points, experience.scale, self.radius) if few else points[:0]
        self._tracker.update(centres, experience.scale)
        return [experience.region(concept.point) for concept in self._tracker.persistent(self.threshold)]

    def _hits(self, visits: IntArray) -> IntArray:
        """What counts of how often a trajectory visited each place, (k,)."""
        return np.ones_like(visits)

    def _accepted(self, seen: FloatArray, hits: FloatArray) -> FloatArray:
        """The most visited places, ties included."""
        return np.asarray(hits == hits.max(), dtype=np.float64)

    def seconds(self, experience: Experience) -> float:
        """Nominal time of an update."""
        return super().seconds(experience) if experience.success else 0.0


class EveryVisit(FirstVisits):
    """The place that successful trajectories visit most often, each visit counted."""

    def _hits(self, visits: IntArray) -> IntArray:
        return visits


class GraphMethod(CandidateMethod):
    """A subgoal is a place that was a candidate in ``min_share`` of at least ``min_seen`` graphs.

    A graph is made of the last ``horizon`` transitions of a trajectory. The defaults were set once, and not tuned.

    Args:
        horizon: h, in transitions.
        min_seen: t_o.
        min_share: t_p, in (0, 1).
    """

    @validate_call
    def __init__(
        self,
        *,
        horizon: Annotated[int, Field(ge=2)] = 1000,
        min_seen: Annotated[int, Field(ge=1)] = 10,
        min_share: Annotated[float, Field(gt=0, lt=1)] = 0.5,
    ) -> None:
        super().__init__()
        self.horizon, self.min_seen, self.min_share = horizon, min_seen, min_share

    def update(self, experience: Experience) -> list[Region]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        visits = experience.places.visits[-self.horizon - 1 :]
        nodes, local = np.unique(visits, return_inverse=True)
        seen, hits = np.zeros((2, len(experience.places.points)), dtype=np.int64)
        seen[nodes] = 1
        hits[nodes[self.candidates(local.ravel(), len(nodes))]] = 1
        return self._counted(experience, seen, hits)

    def candidates(self, visits: IntArray, n: int) -> IntArray:
        """The candidates among the places 0 … n − 1 of a graph, which were visited in this order."""
        raise NotImplementedError

    def seconds(self, experience: Experience) -> float:
        """Nominal time of an update."""
        visits = experience.places.visits[-self.horizon - 1 :]
        return super().seconds(experience) + GRAPH_SECONDS + self._graph_seconds(visits)

    def _graph_seconds(self, visits: IntArray) -> float:
        raise NotImplementedError

    def _accepted(self, seen: FloatArray, hits: FloatArray) -> FloatArray:
        """Places seen often enough that were candidates often enough (Şimşek, Wolfe & Barto 2005)."""
        accepted: FloatArray = np.where(seen >= self.min_seen, hits / np.maximum(seen, 1.0) - self.min_share, -1.0)
        return accepted


class LCut(GraphMethod):
    """Şimşek, Wolfe & Barto (2005), *Identifying Useful Subgoals in RL by Local Graph Partitioning*.

    Transitions are weighted by how often each was made. The graph is cut in two by spectral clustering (Shi & Malik
    2000): NCut(A, B) = cut(A, B)/vol(A) + cut(A, B)/vol(B). If this is below ``max_cut``, the places through which
    transitions led from one part into the other are candidates.

    Args:
        max_cut: t_c, of 2.
        min_share: As of `GraphMethod`, like all other arguments.
    """

    @validate_call
    def __init__(
        self,
        *,
        horizon: int = 1000,
        max_cut: Annotated[float, Field(gt=0, le=2)] = 0.05,
        min_seen: int = 10,
        min_share: float = 0.2,
    ) -> None:
        super().__init__(horizon=horizon, min_seen=min_seen, min_share=min_share)
        self.max_cut = max_cut

    def candidates(self, visits: IntArray, n: int) -> IntArray:
        """The places in which transitions across the cut arrived."""
        if n <= 2:
            return visits[:0]
        cut, part = normalised_cut(weights_of(visits, n))
        crosses = part[visits[:-1]] != part[visits[1:]]
        return visits[1:][crosses] if cut < self.max_cut else visits[:0]

    def _graph_seconds(self, visits: IntArray) -> float:
        n_places = len(np.unique(visits))
        return CUT_SECONDS[0] * n_places**2 + CUT_SECONDS[1] * n_places**3


class Betweenness(GraphMethod):
    """Şimşek & Barto (2008), *Skill Characterization Based on Betweenness*.

    The graph has no directions here. The betweenness of a place v is Σ σ(s, t | v)/σ(s, t) over all pairs of other
    places, which count alike; σ is the number of shortest paths, of all and of those through v. A place is a candidate
    if its betweenness exceeds that of all its neighbours.
    """

    def candidates(self, visits: IntArray, n: int) -> IntArray:
        """The local maxima of betweenness."""
        one, other = np.divmod(_edges(visits, n), n)
        graph: rx.PyGraph[None, None] = rx.PyGraph(multigraph=False)
        graph.add_nodes_from([None] * n)
        graph.add_edges_from_no_data(list(zip(one.tolist(), other.tolist(), strict=True)))
        of_place = rx.graph_betweenness_centrality(graph, parallel_threshold=n + 1)  # one thread, as training has
        betweenness = np.array([of_place[place] for place in range(n)])
        largest_near = np.zeros(n)
        np.maximum.at(largest_near, one, betweenness[other])
        np.maximum.at(largest_near, other, betweenness[one])
        return np.flatnonzero(betweenness > largest_near + TOLERANCE * betweenness.max())

    def _graph_seconds(self, visits: IntArray) -> float:
        nodes, local = np.unique(visits, return_inverse=True)
        return PATH_SECONDS * len(nodes) * (len(nodes) + len(_edges(local.ravel(), len(nodes))))


def _edges(visits: IntArray, n: int) -> IntArray:
    """The pairs of different places that a transition joined, each as smaller · n + larger."""
    low, high = np.minimum(visits[:-1], visits[1:]), np.maximum(visits[:-1], visits[1:])
    return np.unique((low * n + high)[low < high])


def weights_of(visits: IntArray, n: int) -> FloatArray:
    """How often each transition between different places was made, in either direction, (n, n)."""
    weights = np.bincount(visits[:-1] * n + visits[1:], minlength=n * n).reshape(n, n).astype(np.float64)
    np.fill_diagonal(weights, 0.0)
    symmetric: FloatArray = weights + weights.T
    return symmetric


def normalised_cut(weights: FloatArray) -> tuple[float, IntArray]:
    """The best normalised cut along the second eigenvector (Shi & Malik 2000)."""
    degrees = weights.sum(axis=1)
    n = len(degrees)
    _, vectors = eigh(np.diag(degrees) - weights, np.diag(degrees), subset_by_index=[1, 1])
    order = np.argsort(vectors[:, 0])
    ordered = weights[np.ix_(order, order)]
    volume = np.cumsum(degrees[order])
    within = 2.0 * np.cumsum(np.tril(ordered, -1).sum(axis=1))
    between = (volume - within)[:-1]
    cuts = between / volume[:-1] + between / (volume[-1] - volume[:-1])
    best = int(cuts.argmin())
    part = np.zeros(n, dtype=np.int64)
    part[order[best + 1 :]] = 1
    return float(cuts[best]), part


LEFT_OUT: dict[str, Callable[..., Method]] = {
    "first-visits": FirstVisits,
    "every-visit": EveryVisit,
    "l-cut": LCut,
    "betweenness": Betweenness,
}
"""Makes each by its name."""
