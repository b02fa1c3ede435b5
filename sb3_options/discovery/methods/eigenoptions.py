"""Eigenoptions: gain the eigenvectors of the Laplacian of the graph of places."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_options.discovery.methods.candidates import check_counts
from sb3_options.discovery.methods.method import Experience, IntrinsicReward, Proposal
from sb3_options.discovery.methods.place_graph import MAX_PLACES, PlaceGraph, seconds_of, smoothest
from sb3_options.experience.observations import FloatArray


class Eigenoptions:
    """Machado, Bellemare & Bowling (2017), *A Laplacian Framework for Option Discovery in RL*.

    With e an eigenvector of the Laplacian L = D − A of the graph of places, an option gains the intrinsic reward
    r(s, s') = e(s') − e(s) (their eq. 2), and ends where no action gains more. Every eigenvector makes two options, one
    for −e. Those of the smallest eigenvalues above 0 come first: they lead farthest.

    An option is proposed if the place where it is bound for may be a subgoal.

    Args:
        n_vectors: Eigenvectors; each makes two options.
        min_trajectories: Before the first proposals, so that the graph is that of the task, and not of a few ways.
        max_places: Most places in the graph.

    Raises:
        ValueError: An argument is out of its range.
    """

    def __init__(self, *, n_vectors: int = 4, min_trajectories: int = 10, max_places: int = MAX_PLACES) -> None:
        check_counts(n_vectors=n_vectors, min_trajectories=min_trajectories, max_places=max_places)
        self.n_vectors, self.min_trajectories = n_vectors, min_trajectories
        self._graph = PlaceGraph(max_places)
        self._n = 0

    def update(self, experience: Experience) -> list[Proposal]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        self._n += 1
        self._graph.add(experience)
        if self._n < self.min_trajectories or len(self._graph) < 3:
            return []
        part = self._graph.largest_component()
        proposals: list[Proposal] = []
        for vector in smoothest(part.adjacency, self.n_vectors).T:
            for signed in (vector, -vector):
                if part.allowed[signed.argmax()]:
                    proposals.append(IntrinsicReward(part.points, _spread(signed), experience.scale, experience.radius))
        return proposals

    def seconds(self, experience: Experience) -> float:
        """Nominal time of an update."""
        del experience
        return seconds_of(len(self._graph)) if self._n >= self.min_trajectories else 0.0

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"graph": self._graph.get_state(), "n": self._n}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._graph.set_state(state["graph"])
        self._n = state["n"]


def _spread(vector: FloatArray) -> FloatArray:
    """The vector with a range of 1: a network learns values that are neither tiny nor large."""
    extent = np.ptp(vector)
    spread: FloatArray = (vector - vector.min()) / (extent if extent > 0 else 1.0)
    return spread
