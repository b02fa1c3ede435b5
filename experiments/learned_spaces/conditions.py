"""What is run for every seed: discovery from random walks that are seen as pictures, in a space that is learned."""

from __future__ import annotations

import time
from typing import Any

import networkx as nx
import numpy as np
from scipy.stats import spearmanr

from experiments.common.gridworlds import world_of
from experiments.common.seeds import Result
from experiments.random_walks.conditions import is_bottleneck, walk
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.embedding.learner import FeatureLearner
from sb3_options.embedding.settings import EmbeddingSettings, MapName
from sb3_options.envs import GridWorld
from sb3_options.execution.features import form_of
from sb3_options.experience.observations import FloatArray

TASKS = ("TwoRooms", "FourRooms")

ARMS: tuple[MapName | None, ...] = ("temporal-distance", None)
"""How the space is learned; None takes the coordinates, which is the bound."""

NAMES: dict[MapName | None, str] = {None: "coordinates"}

N_EPISODES = 60
MAX_OPTIONS = 4


def run(task: str, arm: MapName | None, seed: int, n_episodes: int | None = None, **settings: Any) -> Result:
    """Discover from one random walk after the other, each seen as pictures.

    Args:
        task: One of `TASKS`.
        arm: One of `ARMS`.
        seed: Of the environment, the walk and the map.
        n_episodes: By default `N_EPISODES`.
        **settings: Of learning, other than the defaults.

    Returns:
        ``found``: of each subgoal the episode, the cell and whether it is within one step of a doorway;
        ``rank_correlation`` of learned distances with shortest paths at the end; ``n_successes``; ``n_learned``, how
        many times the map was learned; ``seconds`` of learning, of searches and of everything, by processor time.
    """
    world, rng = world_of(f"sb3_options/{task}-v0", observation="image"), np.random.default_rng(seed)
    began, learning = time.process_time(), 0.0
    learner = None
    if arm is not None:
        learner = FeatureLearner(
            LearnedMap(form_of(world.observation_space), seed), EmbeddingSettings(**settings), seed
        )
    discovery = Discovery(DiscoverySettings(), kind="environment" if arm is None else arm)
    found: list[dict[str, Any]] = []
    world.reset(seed=seed)
    for episode in range(1, (n_episodes or N_EPISODES) + 1):
        trajectory = walk(world, rng)
        phi = world.concept_features if learner is None else learner.map
        discovery.add(trajectory, phi(np.asarray(trajectory.states)))
        if learner is not None:
            before = time.process_time()
            discovery.learn_if_due(learner)
            learning += time.process_time() - before
        ready = learner is None or learner.map.learned > 0
        if ready and len(found) < MAX_OPTIONS and discovery.search() is not None:
            observation = discovery.found[-1].observation
            cell = world.concept_features(np.asarray(observation))[0].tolist()
            found.append({"episode": episode, "point": cell, "bottleneck": is_bottleneck(world, cell)})
    is_learned = learner is not None and learner.map.learned > 0
    return {
        "seed": seed,
        "found": found,
        "rank_correlation": rank_correlation(world, learner.map) if learner is not None and is_learned else None,
        "n_learned": 0 if learner is None else learner.map.learned,
        "n_successes": sum(t.success for t in discovery.database),
        "seconds": {"learning": learning, "searches": discovery.diary.seconds, "all": time.process_time() - began},
    }


def free_cells(world: GridWorld) -> list[tuple[int, int]]:
    """All cells (x, y) that are neither wall nor goal, row by row: an episode cannot begin at the goal."""
    cells = [(x, y) for y in range(world.height) for x in range(world.width) if not world.walls[y, x]]
    return [cell for cell in cells if cell != world.goal]


def pictures_of(world: GridWorld) -> FloatArray:
    """What the agent sees in each of `free_cells`, (n, height, width, 3)."""
    return np.stack([world.reset(options={"start": cell})[0] for cell in free_cells(world)])


def rank_correlation(world: GridWorld, phi: LearnedMap) -> float:
    """Spearman's, between learned distances and shortest paths, over all pairs of cells."""
    cells = free_cells(world)
    graph = nx.Graph()
    graph.add_nodes_from(cells)
    graph.add_edges_from((c, d) for c in cells for d in ((c[0] + 1, c[1]), (c[0], c[1] + 1)) if d in set(cells))
    features, above = phi(pictures_of(world)), np.triu_indices(len(cells), 1)
    learned = np.linalg.norm(features[:, None] - features[None], axis=2)
    steps = np.asarray(nx.floyd_warshall_numpy(graph, nodelist=cells))
    return float(spearmanr(learned[above], steps[above]).statistic)
