"""The graph of all places that were visited, which grows with experience, and the eigenvectors of its Laplacian."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
from scipy.linalg import eigh
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, laplacian
from scipy.sparse.linalg import eigsh

from sb3_options.discovery.methods.candidates import check_counts
from sb3_options.discovery.methods.method import Experience, Method
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray

MAX_PLACES = 2_000
"""As many are in the graph; places that come later are left out."""

DENSE_SECONDS, SPARSE_SECONDS = (9e-4, 5e-8), (2e-3, 6e-6)
"""Nominal times of `smoothest`, and for the square of the number of places, or for each."""

DENSE = 300
"""Up to so many places all eigenvectors at once take less time than Lanczos iterations."""

LEAST_PLACES = 3
"""Fewer have no place that is not an end."""

SHIFT = -1e-4
"""Eigenvalues are searched near this one: a Laplacian is singular at 0."""


class Component(NamedTuple):
    """The largest connected part of the graph.

    Attributes:
        numbers: Of its places in the graph, which do not change, (n,).
        points: One state of each place, (n, d).
        allowed: Which places may be subgoals, as of their last visit, (n,).
        adjacency: 1 where a transition was made in either direction, (n, n), symmetric.
    """

    numbers: IntArray
    points: FloatArray
    allowed: BoolArray
    adjacency: csr_array


class PlaceGraph:
    """Places are joined if a transition was made between them, in either direction."""

    def __init__(self, max_places: int = MAX_PLACES) -> None:
        self.max_places = max_places
        self._number: dict[bytes, int] = {}
        self._points: list[FloatArray] = []
        self._allowed: list[bool] = []
        self._edges: dict[tuple[int, int], None] = {}

    def __len__(self) -> int:
        """How many places there are."""
        return len(self._points)

    def add(self, experience: Experience) -> None:
        """Add the places and transitions of a trajectory."""
        places = experience.places
        numbers = np.full(len(places.points), -1)
        order = np.unique(places.visits, return_index=True)[1]
        for row in places.visits[np.sort(order)]:
            key = places.bins[row].tobytes()
            number = self._number.get(key)
            if number is None:
                if len(self._points) >= self.max_places:
                    continue
                number = self._number[key] = len(self._points)
                self._points.append(places.points[row].copy())  # a view would keep all of its trajectory
                self._allowed.append(False)
            numbers[row] = number
            self._allowed[number] = bool(places.allowed[row])
        way = numbers[places.visits]
        pairs = np.sort(np.stack([way[:-1], way[1:]], axis=1), axis=1)
        pairs = np.unique(pairs[(pairs[:, 0] >= 0) & (pairs[:, 0] < pairs[:, 1])], axis=0)
        self._edges.update(dict.fromkeys(map(tuple, pairs.tolist())))

    def largest_component(self) -> Component:
        """The largest connected part; with one place at least."""
        n, edges = len(self), np.array(list(self._edges), dtype=np.int64).reshape(-1, 2)
        rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
        adjacency = csr_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))
        _, labels = connected_components(adjacency, directed=False)
        kept = np.flatnonzero(labels == np.bincount(labels).argmax())
        points, allowed = np.array(self._points)[kept], np.array(self._allowed)[kept]
        return Component(kept, points, allowed, adjacency[kept][:, kept])

    def point(self, number: int) -> FloatArray:
        """One state of a place, (d,)."""
        return self._points[number]

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "bins": np.array([np.frombuffer(key) for key in self._number]),
            "points": np.array(self._points),
            "allowed": np.array(self._allowed, dtype=bool),
            "edges": np.array(list(self._edges), dtype=np.int64).reshape(-1, 2),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._number = {of.tobytes(): number for number, of in enumerate(state["bins"])}
        self._points, self._allowed = list(state["points"]), state["allowed"].tolist()
        self._edges = dict.fromkeys((int(i), int(j)) for i, j in state["edges"])


class LaplacianMethod(Method):
    """A method of discovery on the Laplacian of the graph of all places, which it takes anew after each trajectory."""

    STATE: ClassVar[tuple[str, ...]] = ("_graph", "_n")

    def __init__(self, *, n_solved: int, min_trajectories: int, max_places: int) -> None:
        check_counts(min_trajectories=min_trajectories)
        check_counts(LEAST_PLACES, max_places=max_places)
        self.min_trajectories, self.max_places = min_trajectories, max_places
        self._n_solved = n_solved
        self._graph = PlaceGraph(max_places)
        self._n = 0

    def _grown(self, experience: Experience) -> Component | None:
        """Count a trajectory, and give the largest part of the graph; None as long as it says too little."""
        self._n += 1
        self._graph.add(experience)
        if self._n < self.min_trajectories or len(self._graph) < LEAST_PLACES:
            return None
        component = self._graph.largest_component()
        return component if len(component.points) >= LEAST_PLACES else None

    def seconds(self, experience: Experience) -> float:
        """Nominal time of an update."""
        del experience
        return self._n_solved * seconds_of(len(self._graph)) if self._n >= self.min_trajectories else 0.0


def smoothest(adjacency: csr_array, k: int) -> FloatArray:
    """The k eigenvectors of the Laplacian D − A with the smallest eigenvalues above 0, smallest first, (n, k).

    Their sign, which is arbitrary, is such that the largest entry is positive.
    """
    n = adjacency.shape[0]
    k = min(k, n - 1)
    matrix = csr_array(cast("Any", laplacian(adjacency)))  # it may give other kinds of matrices to others
    if n <= DENSE or k >= n - 2:
        _, vectors = eigh(matrix.toarray(), subset_by_index=[1, k])
    else:
        start = np.cos(np.arange(n, dtype=np.float64))  # Lanczos iterations draw one otherwise
        values, vectors = eigsh(matrix.tocsc(), k + 1, sigma=SHIFT, v0=start)
        vectors = vectors[:, np.argsort(values)[1:]]
    largest: IntArray = np.abs(vectors).argmax(axis=0)
    signed: FloatArray = vectors * np.sign(vectors[largest, np.arange(k)])
    return signed


def seconds_of(n_places: int) -> float:
    """Nominal time of `smoothest`."""
    if n_places <= DENSE:
        return DENSE_SECONDS[0] + DENSE_SECONDS[1] * n_places**2
    return SPARSE_SECONDS[0] + SPARSE_SECONDS[1] * n_places
