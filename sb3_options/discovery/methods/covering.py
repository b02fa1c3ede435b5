"""Covering options: join the two places that are farthest apart in the Fiedler vector, again and again."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from sb3_options.density.regions import Region
from sb3_options.discovery.methods.candidates import check_counts
from sb3_options.discovery.methods.method import Experience, Passage, Proposal
from sb3_options.discovery.methods.place_graph import MAX_PLACES, LaplacianMethod, smoothest
from sb3_options.experience.observations import BoolArray


class CoveringOptions(LaplacianMethod):
    """Jinnai, Park, Abel & Konidaris (2019), *Discovering Options for Exploration by Minimizing Cover Time*.

    The time in which a random walk visits all places falls with λ₂, the second smallest eigenvalue of the Laplacian.
    So the places where its eigenvector, the Fiedler vector, is largest and smallest are joined by options both ways,
    which makes an edge of the graph; then the Fiedler vector is taken anew (their algorithm 1).

    The paper's options start in one place alone. Options of this library may only go on where they may start, so these
    start wherever saved steps lead to the place that they are bound for.

    Args:
        n_pairs: Of places, each of which makes two options.
        min_trajectories: Before the first proposals, so that the graph is that of the task, and not of a few ways.
        max_places: Most places in the graph.

    Raises:
        ValueError: An argument is out of its range.
    """

    def __init__(self, *, n_pairs: int = 4, min_trajectories: int = 10, max_places: int = MAX_PLACES) -> None:
        check_counts(n_pairs=n_pairs)
        super().__init__(n_solved=n_pairs, min_trajectories=min_trajectories, max_places=max_places)
        self.n_pairs = n_pairs

    def update(self, experience: Experience) -> list[Proposal]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        part = self._grown(experience)
        if part is None:
            return []
        everywhere = Region(part.points, experience.scale, experience.radius)
        if np.count_nonzero(part.allowed) < 2:
            return []
        ends = [end for pair in farthest_pairs(part.adjacency, self.n_pairs, part.allowed) for end in pair]
        return [Passage(experience.region(part.points[end]), everywhere) for end in dict.fromkeys(ends)]


def farthest_pairs(adjacency: csr_array, n_pairs: int, allowed: BoolArray | None = None) -> list[tuple[int, int]]:
    """The places with the largest and the smallest entry of the Fiedler vector, joined each time before the next.

    Args:
        adjacency: Of a connected graph, symmetric, (n, n).
        n_pairs: How many pairs.
        allowed: Places that options may lead to, at least two, (n,); by default all.
    """
    joined, pairs = adjacency.tolil(), []
    places = np.arange(adjacency.shape[0]) if allowed is None else np.flatnonzero(allowed)
    for _ in range(n_pairs):
        fiedler = smoothest(csr_array(joined), 1)[places, 0]
        one, other = int(places[fiedler.argmax()]), int(places[fiedler.argmin()])
        pairs.append((one, other))
        joined[one, other] = joined[other, one] = 1.0
    return pairs
