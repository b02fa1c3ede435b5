"""What learned spaces are measured against: shortest paths."""

from collections.abc import Sequence
from typing import NamedTuple

import networkx as nx
import numpy as np
from scipy.stats import spearmanr

from sb3_options.embedding.encoders import ObservationForm
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.embedding.learner import FeatureLearner
from sb3_options.embedding.settings import EmbeddingSettings
from sb3_options.envs.gridworld.grid_map import GridMap
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import Trajectory


class Walked(NamedTuple):
    """A graph of numbered nodes, and random walks in it."""

    graph: nx.Graph
    trajectories: list[Trajectory]  # observations are the nodes' numbers

    @property
    def steps(self) -> FloatArray:
        """Shortest paths between all nodes, (n, n)."""
        return np.array(nx.floyd_warshall_numpy(self.graph))


def walked(graph: nx.Graph, degree: int, n_steps: int, n_trajectories: int = 8) -> Walked:
    """Random walks that begin anywhere and end after so many steps together.

    A node with fewer than ``degree`` edges is stayed in instead.
    """
    rng = np.random.default_rng(0)
    neighbours = [[*graph[node], *[node] * (degree - len(graph[node]))] for node in range(len(graph))]
    trajectories = []
    for _ in range(n_trajectories):
        at = [int(rng.integers(len(graph)))]
        for choice in rng.integers(degree, size=n_steps // n_trajectories):
            at.append(neighbours[at[-1]][choice])
        trajectories.append(path_through(at))
    return Walked(graph, trajectories)


def path_through(nodes: Sequence[int]) -> Trajectory:
    """The trajectory that visits these, each observed as its number."""
    states, first, visits = np.unique(nodes, return_index=True, return_inverse=True)
    order = np.argsort(first)
    n = len(nodes) - 1
    visits = np.argsort(order)[visits]
    return Trajectory(states[order], visits, np.zeros(n, dtype=np.int64), np.zeros(n), False, True, None)


def rooms(text: str) -> Walked:
    """A walk in a gridworld, whose cells are the nodes."""
    grid = GridMap.parse(text, None, None)
    cells = [(x, y) for y in range(grid.height) for x in range(grid.width) if not grid.walls[y, x]]
    number = {cell: i for i, cell in enumerate(cells)}
    graph = nx.Graph()
    graph.add_nodes_from(range(len(cells)))
    for x, y in cells:
        graph.add_edges_from((number[x, y], number[c]) for c in ((x + 1, y), (x, y + 1)) if c in number)
    return walked(graph, 4, 30_000)


def learned(walk: Walked, seed: int = 0, **settings: float) -> FeatureLearner:
    """A learner that has learned from a walk, in which every node was visited."""
    form = ObservationForm("table", (len(walk.graph),))
    learner = FeatureLearner(LearnedMap(form, seed), EmbeddingSettings(**settings), seed)  # type: ignore[arg-type]  # each of its type
    while not learner.learn(walk.trajectories, len(walk.trajectories), 0):
        pass
    return learner


def distances(features: FloatArray) -> FloatArray:
    """Between all rows, (n, n)."""
    made: FloatArray = np.linalg.norm(features[:, None] - features[None], axis=2)
    return made


def rank_correlation(one: FloatArray, other: FloatArray) -> float:
    """Spearman's, of the distances above the diagonal."""
    above = np.triu_indices(len(one), 1)
    return float(spearmanr(one[above], other[above]).statistic)
