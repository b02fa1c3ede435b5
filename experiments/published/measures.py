"""What is measured, a function for every claim."""

from __future__ import annotations

from collections import Counter
from typing import Any

import networkx as nx
import numpy as np

from experiments.common.gridworlds import cell_of, distance_to_doorway, rooms_of, world_of
from experiments.methods.left_out import TOLERANCE
from experiments.published.graphs import (
    climbed,
    cover_time,
    diffusion_time,
    farthest_pairs,
    grid,
    joined,
    smoothest,
    taxi,
)
from experiments.published.learning import MOST, moves_of, steps_to_learn, tasks_of
from experiments.random_walks.conditions import run, walk
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.methods.relative_novelty import RelativeNovelty
from sb3_options.discovery.settings import DiscoverySettings

N_OPTIONS = (0, 2, 4, 8, 16, 32)


def eigenoptions(n_tasks: int, first_seed: int, env_id: str = "sb3_options/FourRooms-v0") -> dict[str, Any]:
    """Diffusion time and steps of learning by the number of eigenoptions, and where the first four lead."""
    world, cells, adjacency = grid(env_id)
    vectors = smoothest(adjacency, max(N_OPTIONS) // 2).T
    options = [climbed(adjacency, sign * vector) for vector in vectors for sign in (1, -1)]
    ends = [cells[(sign * vector).argmax()].tolist() for vector in vectors[:2] for sign in (1, -1)]
    times = {n: diffusion_time(adjacency, options[:n]) for n in N_OPTIONS}
    moves, tasks = moves_of(cells), tasks_of(world, cells, n_tasks, np.random.default_rng(first_seed))
    steps = {n: steps_to_learn(moves, options[:n], tasks, np.random.default_rng(first_seed)) for n in N_OPTIONS}
    rooms = {i for i, room in enumerate(rooms_of(world)) for x, y in ends if (x, y) in room}
    return {
        "diffusion_time": times,
        "steps_to_learn": {n: np.quantile(of, (0.25, 0.5, 0.75)).tolist() for n, of in steps.items()},
        "mean_steps_to_learn": {n: float(of.mean()) for n, of in steps.items()},
        "never_learned": {n: float((of == MOST).mean()) for n, of in steps.items()},
        "ends_of_the_first_four": ends,
        "rooms": len(rooms),
    }


def covering(runs: int, first_seed: int, env_id: str = "sb3_options/FourRooms-v0") -> dict[str, Any]:
    """Cover time by the number of options: covering options, and eigenoptions between the same kinds of places."""
    _, _, adjacency = grid(env_id)
    vectors = smoothest(adjacency, max(N_OPTIONS) // 2).T
    pairs = {
        "covering": farthest_pairs(adjacency, max(N_OPTIONS) // 2),
        "eigenoptions": [(int(v.argmax()), int(v.argmin())) for v in vectors],
    }
    return {
        name: {
            n: cover_time(joined(adjacency, ends[: n // 2]), np.random.default_rng(first_seed), runs) for n in N_OPTIONS
        }
        for name, ends in pairs.items()
    }


def l_cut(seeds: range) -> dict[str, Any]:
    """How far the first subgoals of random walks in two rooms lie from the doorway."""
    world = world_of("sb3_options/TwoRooms-v0", observation="xy")
    found = [run("TwoRooms", {"method": "l-cut"}, seed)["found"] for seed in seeds]
    steps = [distance_to_doorway(world, cell_of(first[0]["point"])) for first in found if first]
    return {"runs": len(seeds), "at_the_doorway": steps.count(0), "within_one_step": sum(s <= 1 for s in steps)}


def relative_novelty(seeds: range, n_episodes: int = 10) -> dict[str, Any]:
    """How many places of two rooms the rule accepts in a trial of random walks, before any filter, and where."""
    counts, steps = [], []
    for seed in seeds:
        world, random = world_of("sb3_options/TwoRooms-v0", observation="xy"), np.random.default_rng(seed)
        settings = DiscoverySettings(start_radius=0.0, goal_radius=0.0, spacing=0.0, max_share=None)
        method = _Accepting()
        discovery = Discovery(settings, method=method, kind="environment")
        world.reset(seed=seed)
        for _ in range(n_episodes):
            trajectory = walk(world, random)
            discovery.add(trajectory, world.concept_features(np.asarray(trajectory.states)))
            discovery.search()
        counts.append(len(method.accepted))
        steps += [distance_to_doorway(world, cell_of(point)) for point in method.accepted]
    return {
        "runs": len(seeds),
        "episodes": n_episodes,
        "accepted": float(np.mean(counts)),
        "within_one_step": float(np.mean([s <= 1 for s in steps])) if steps else None,
    }


class _Accepting(RelativeNovelty):
    """Remembers all that it ever proposed in a trial."""

    def __init__(self) -> None:
        super().__init__()
        self.accepted: set[tuple[float, ...]] = set()

    def update(self, experience: Any) -> Any:
        proposals = super().update(experience)
        self.accepted |= {tuple(region.points[0].tolist()) for region in proposals}
        return proposals


def betweenness() -> dict[str, Any]:
    """Which states of Taxi are local maxima of betweenness in the graph of all transitions.

    ``stops``: with the passenger aboard, at a stop other than the destination, where the passenger has got in or may
    get out. ``navigation``: elsewhere. The cells of the last are counted.
    """
    states, steps = taxi()
    graph = nx.Graph(steps.tolist())
    values = nx.betweenness_centrality(graph)
    slack = TOLERANCE * max(values.values())
    maxima = [s for s, value in values.items() if all(value > values[other] + slack for other in graph[s])]
    stops = [(0, 0), (0, 4), (4, 0), (4, 3)]
    n_stops, cells = 0, Counter[str]()
    for row, column, passenger, _ in (states[number] for number in maxima):
        if passenger == len(stops) and (row, column) in stops:
            n_stops += 1
        else:
            cells[f"{row},{column}"] += 1
    found = {"stops": n_stops, "navigation": cells.total(), "navigation_cells": dict(cells)}
    return {"states": len(graph), "maxima": len(maxima), **found}
