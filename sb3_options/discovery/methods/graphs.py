"""Local betweenness, in the graph of the transitions of one trajectory."""

from typing import Annotated

import numpy as np
import rustworkx as rx
from pydantic import Field, validate_call

from sb3_options.density.regions import Region
from sb3_options.discovery.methods.candidates import CandidateMethod, often_enough
from sb3_options.discovery.methods.method import Experience
from sb3_options.experience.observations import IntArray

GRAPH_SECONDS = 2e-4
PATH_SECONDS = 2e-8
"""Nominal times: of a graph, and of betweenness for each place and transition."""

TOLERANCE = 1e-9
"""Betweenness that differs by less, relative to the largest, is equal."""


class Betweenness(CandidateMethod):
    """Şimşek & Barto (2008), *Skill Characterization Based on Betweenness*.

    The last ``horizon`` transitions of a trajectory are a graph, here without directions. The betweenness of a place v
    is Σ σ(s, t | v)/σ(s, t) over all pairs of other places, which count alike; σ is the number of shortest paths, of
    all and of those through v. A place is a candidate if its betweenness exceeds that of all its neighbours. A subgoal
    is a place that was a candidate in ``min_share`` of at least ``min_seen`` graphs.

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
        self.horizon, self.min_seen, self.min_share = horizon, min_seen, min_share
        super().__init__(often_enough(min_seen, min_share))

    def update(self, experience: Experience) -> list[Region]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        places = experience.places
        visits = places.visits[-self.horizon - 1 :]
        seen, hits = np.zeros((2, len(places.points)), dtype=np.int64)
        seen[visits] = 1
        hits[local_maxima(visits)] = 1
        return self._counted(experience, seen, hits)

    def seconds(self, experience: Experience) -> float:
        """Nominal time of an update."""
        visits = experience.places.visits[-self.horizon - 1 :]
        n_places = np.count_nonzero(np.bincount(visits))
        low, high = np.minimum(visits[:-1], visits[1:]), np.maximum(visits[:-1], visits[1:])
        n_pairs = len(np.unique(low * len(experience.places.points) + high))
        return super().seconds(experience) + GRAPH_SECONDS + PATH_SECONDS * n_places * (n_places + n_pairs)


def numbered(visits: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """The places that some visits are of, in order, and which of these each visit is of."""
    visited = np.bincount(visits, minlength=n) > 0
    which: IntArray = np.cumsum(visited)[visits] - 1
    return np.flatnonzero(visited), which


def local_maxima(visits: IntArray) -> IntArray:
    """The places of a trajectory whose betweenness is positive and larger than that of all their neighbours."""
    nodes, local = numbered(visits, int(visits.max()) + 1)
    n = len(nodes)
    low, high = np.minimum(local[:-1], local[1:]), np.maximum(local[:-1], local[1:])
    one, other = np.divmod(np.unique((low * n + high)[low < high]), n)
    graph: rx.PyGraph[None, None] = rx.PyGraph(multigraph=False)
    graph.add_nodes_from([None] * n)
    graph.add_edges_from_no_data(list(zip(one.tolist(), other.tolist(), strict=True)))
    of_place = rx.graph_betweenness_centrality(graph, parallel_threshold=n + 1)  # one thread, as training has
    betweenness = np.array([of_place[place] for place in range(n)])
    largest_near = np.zeros(n)
    np.maximum.at(largest_near, one, betweenness[other])
    np.maximum.at(largest_near, other, betweenness[one])
    maxima: IntArray = nodes[betweenness > largest_near + TOLERANCE * betweenness.max()]
    return maxima
