"""Eigenoptions: gain the eigenvectors of the Laplacian of the graph of places."""

from __future__ import annotations

import numpy as np

from sb3_options.discovery.methods.candidates import check_counts
from sb3_options.discovery.methods.method import Experience, IntrinsicReward, Proposal
from sb3_options.discovery.methods.place_graph import MAX_PLACES, LaplacianMethod, smoothest
from sb3_options.experience.observations import FloatArray


class Eigenoptions(LaplacianMethod):
    """Machado, Bellemare & Bowling (2017), *A Laplacian Framework for Option Discovery in RL*.

    With e an eigenvector of the Laplacian L = D − A of the graph of places, not normalised, an option gains the
    intrinsic reward r(s, s') = e(s') − e(s) (their eq. 2), and ends where no action gains more. Every eigenvector makes
    two options, one for −e. Those of the smallest eigenvalues above 0 come first: they lead farthest.

    An option is proposed if the place where it is bound for may be a subgoal.

    Args:
        n_vectors: Eigenvectors; each makes two options.
        min_trajectories: Before the first proposals, so that the graph is that of the task, and not of a few ways.
        max_places: Most places in the graph.
    """

    def __init__(self, *, n_vectors: int = 4, min_trajectories: int = 10, max_places: int = MAX_PLACES) -> None:
        check_counts(n_vectors=n_vectors)
        super().__init__(n_solved=1, min_trajectories=min_trajectories, max_places=max_places)
        self.n_vectors = n_vectors

    def update(self, experience: Experience) -> list[Proposal]:
        """Take note of one more trajectory; as `DiscoveryMethod.update`."""
        part = self._grown(experience)
        if part is None:
            return []
        proposals: list[Proposal] = []
        for vector in smoothest(part.adjacency, self.n_vectors).T:
            for signed in (vector, -vector):
                if part.allowed[signed.argmax()]:
                    proposals.append(IntrinsicReward(part.points, _spread(signed), experience.scale, experience.radius))
        return proposals


def _spread(vector: FloatArray) -> FloatArray:
    """The vector with a range of 1: a network learns values that are neither tiny nor large."""
    extent = np.ptp(vector)
    spread: FloatArray = (vector - vector.min()) / (extent if extent > 0 else 1.0)
    return spread
