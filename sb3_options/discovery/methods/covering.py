"""Covering options: join the two places that are farthest apart in the Fiedler vector, again and again."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import ClassVar

import numpy as np
from scipy.sparse import csr_array

from sb3_options.density.regions import Region
from sb3_options.discovery.methods.candidates import check_counts
from sb3_options.discovery.methods.method import Experience, Passage, Proposal
from sb3_options.discovery.methods.place_graph import MAX_PLACES, LaplacianMethod, smoothest
from sb3_options.experience.observations import BoolArray

Pair = tuple[int, int]


class CoveringOptions(LaplacianMethod):
    """Jinnai, Park, Abel & Konidaris (2019), *Discovering Options for Exploration by Minimizing Cover Time*.

    The time in which a random walk visits all places falls with λ₂, the second smallest eigenvalue of the Laplacian.
    So the places where its eigenvector, the Fiedler vector, is largest and smallest are joined by options both ways,
    which makes an edge of the graph; then the Fiedler vector is taken anew (their algorithm 1). The graph grows with
    experience. A pair stays joined once there is an option to one of its ends, and the other end comes next.

    The paper's options start in one place alone. Options of this library may only go on where they may start, so these
    start wherever saved steps lead to the place that they are bound for.

    Args:
        n_pairs: Of places, each of which makes two options.
        min_trajectories: Before the first proposals, so that the graph is that of the task, and not of a few ways.
        max_places: Most places in the graph.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_joined", "_proposed", "_n_solved")

    def __init__(self, *, n_pairs: int = 4, min_trajectories: int = 10, max_places: int = MAX_PLACES) -> None:
        check_counts(n_pairs=n_pairs)
        super().__init__(n_solved=n_pairs, min_trajectories=min_trajectories, max_places=max_places)
        self.n_pairs = n_pairs
        self._joined: list[Pair] = []  # numbers of places
        self._proposed: list[Pair] = []

    def update(self, experience: Experience) -> list[Proposal]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        self._join(experience.taken)
        part = self._grown(experience)
        if part is None:
            return []
        self._proposed = []
        if np.count_nonzero(part.allowed) >= 2:
            place = {number: i for i, number in enumerate(part.numbers.tolist())}
            edges = [(place[one], place[other]) for one, other in self._joined if one in place and other in place]
            pairs = farthest_pairs(part.adjacency, self._n_solved, part.allowed, edges)
            self._proposed = [(int(part.numbers[one]), int(part.numbers[other])) for one, other in pairs]
        ends = dict.fromkeys(end for pair in [*self._joined, *self._proposed] for end in pair)
        return [Passage(experience.region(self._graph.point(end)), experience.everywhere) for end in ends]

    def _join(self, taken: Sequence[Region]) -> None:
        """Join the pairs that were proposed, if there is an option to one of their ends by now."""
        for pair in self._proposed:
            points = np.stack([self._graph.point(end) for end in pair])
            if any(region.contains(points).any() for region in taken):
                self._joined.append(pair)
        self._proposed = []
        self._n_solved = max(self.n_pairs - len(self._joined), 0)


def farthest_pairs(
    adjacency: csr_array, n_pairs: int, allowed: BoolArray | None = None, joined: Iterable[Pair] = ()
) -> list[Pair]:
    """The places with the largest and the smallest entry of the Fiedler vector, joined each time before the next."""
    edges, pairs = adjacency.tolil(), []
    for one, other in joined:
        edges[one, other] = edges[other, one] = 1.0
    places = np.arange(adjacency.shape[0]) if allowed is None else np.flatnonzero(allowed)
    for _ in range(n_pairs):
        fiedler = smoothest(csr_array(edges), 1)[places, 0]
        one, other = int(places[fiedler.argmax()]), int(places[fiedler.argmin()])
        pairs.append((one, other))
        edges[one, other] = edges[other, one] = 1.0
    return pairs
