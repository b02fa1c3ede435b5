"""L-cut as an entrant of the race: places where a good cut of the graph of an episode's transitions is crossed."""

from typing import Annotated

import numpy as np
from pydantic import Field, validate_call
from scipy.linalg import eigh

from sb3_options.density.regions import Region
from sb3_options.discovery.methods import Experience
from sb3_options.discovery.methods.candidates import CandidateMethod, often_enough
from sb3_options.discovery.methods.graphs import GRAPH_SECONDS, numbered
from sb3_options.experience.observations import FloatArray, IntArray

CUT_SECONDS = (5e-8, 4e-11)
"""Nominal times of a cut, for the square and for the cube of the number of places."""


class LCut(CandidateMethod):
    """Şimşek, Wolfe & Barto (2005), *Identifying Useful Subgoals in RL by Local Graph Partitioning*.

    The last ``horizon`` transitions of a trajectory are a graph, weighted by how often each was made. It is cut in two
    by spectral clustering (Shi & Malik 2000): NCut(A, B) = cut(A, B)/vol(A) + cut(A, B)/vol(B). If this is below
    ``max_cut``, the places through which transitions led from one part into the other are candidates. A subgoal is a
    place that was a candidate in ``min_share`` of at least ``min_seen`` graphs. The defaults were set once, and not
    tuned.

    Args:
        horizon: h, in transitions.
        max_cut: t_c, of 2.
        min_seen: t_o.
        min_share: t_p, in (0, 1).
    """

    @validate_call
    def __init__(
        self,
        *,
        horizon: Annotated[int, Field(ge=2)] = 1000,
        max_cut: Annotated[float, Field(gt=0, le=2)] = 0.05,
        min_seen: Annotated[int, Field(ge=1)] = 10,
        min_share: Annotated[float, Field(gt=0, lt=1)] = 0.2,
    ) -> None:
        self.horizon, self.max_cut, self.min_seen, self.min_share = horizon, max_cut, min_seen, min_share
        super().__init__(often_enough(min_seen, min_share))

    def update(self, experience: Experience) -> list[Region]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        places = experience.places
        k = len(places.points)
        visits = places.visits[-self.horizon - 1 :]
        nodes, local = numbered(visits, k)
        seen, hits = np.zeros((2, k), dtype=np.int64)
        seen[nodes] = 1
        if len(nodes) > 2:
            cut, part = normalised_cut(weights_of(local, len(nodes)))
            if cut < self.max_cut:
                crosses = part[local[:-1]] != part[local[1:]]
                hits[nodes[local[1:][crosses]]] = 1
        return self._counted(experience, seen, hits)

    def seconds(self, experience: Experience) -> float:
        """Nominal time of an update."""
        n_places = np.count_nonzero(np.bincount(experience.places.visits[-self.horizon - 1 :]))
        of_cut = CUT_SECONDS[0] * n_places**2 + CUT_SECONDS[1] * n_places**3
        return super().seconds(experience) + GRAPH_SECONDS + of_cut


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
