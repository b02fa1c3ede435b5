"""What is run for every seed: discovery from the trajectories of a random walk."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.common.gridworlds import NEAR, world_of
from experiments.common.seeds import Result
from experiments.random_walks.maps import random_map
from sb3_options.discovery.proposed import discovery_with
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.envs import GridWorld
from sb3_options.envs.gridworld.grid_map import Direction
from sb3_options.experience.recording import EpisodeRecorder
from sb3_options.experience.trajectories import Trajectory

TASKS = ("TwoRooms", "KeyDoor", "FourRooms", "random maps")

PLAIN: dict[str, Any] = {
    "loops": "keep", "min_passing": 0.0, "leak": 0.0, "max_places": 2, "goal_radius": 5.0,
}  # fmt: skip
ARMS: dict[str, dict[str, Any]] = {
    "paper's bags": PLAIN,
    "without loops": {**PLAIN, "loops": "erase"},
    "without loops, passages only": {},
    "the same, sooner": {"min_positive": 4, "decay": 0.75},
}
"""What is changed of the defaults."""

METHODS: dict[str, dict[str, Any]] = {
    "diverse density": {},
    "first visits": {"method": "first-visits"},
    "every visit": {"method": "every-visit"},
    "relative novelty": {"method": "relative-novelty"},
    "L-cut": {"method": "l-cut"},
    "local betweenness": {"method": "betweenness"},
    "random places": {"method": "random"},
}
"""Methods of discovery with their defaults."""

N_EPISODES = 60
MAX_OPTIONS = 4


def world_for(task: str, seed: int) -> GridWorld:
    """The task's gridworld; for random maps another one for every seed."""
    if task == "random maps":
        return GridWorld(random_map(seed), observation="xy")
    return world_of(f"sb3_options/{task}-v0", observation="xy")


def is_bottleneck(world: GridWorld, point: Sequence[float]) -> bool:
    """Whether a subgoal is within one step of a doorway, a door or a key."""
    places = [*world.doorways, *world.doors, *world.keys]
    return bool(min(abs(point[0] - x) + abs(point[1] - y) for x, y in places) <= NEAR)


def run(task: str, changed: dict[str, Any], seed: int, n_episodes: int | None = None) -> Result:
    """Discover from one random walk after the other.

    Args:
        task: One of `TASKS`.
        changed: Settings of discovery other than the defaults.
        seed: Of the map, the environment and the walk.
        n_episodes: By default `N_EPISODES`.

    Returns:
        ``found``: of each subgoal the episode, the point and whether it is a bottleneck; ``n_successes``; ``seconds``
        of all searches.
    """
    world, rng = world_for(task, seed), np.random.default_rng(seed)
    discovery = discovery_with(DiscoverySettings(**changed), kind="environment")
    found: list[dict[str, Any]] = []
    world.reset(seed=seed)
    for episode in range(1, (n_episodes or N_EPISODES) + 1):
        trajectory = walk(world, rng)
        discovery.add(trajectory, world.concept_features(np.asarray(trajectory.states)))
        subgoal = discovery.search() if len(found) < MAX_OPTIONS else None
        if subgoal is not None:
            point = subgoal.points[0].tolist()
            found.append({"episode": episode, "point": point, "bottleneck": is_bottleneck(world, point)})
    n_successes = sum(t.success for t in discovery.database)
    return {"seed": seed, "found": found, "n_successes": n_successes, "seconds": discovery.seconds}


def walk(world: GridWorld, rng: np.random.Generator) -> Trajectory:
    """One episode of uniformly random actions."""
    recorder = EpisodeRecorder()
    observation, _ = world.reset()
    recorder.begin(observation)
    while not recorder.finished:
        action = int(rng.integers(len(Direction)))
        observation, reward, terminated, truncated, info = world.step(action)
        recorder.record(action, reward, observation)
        if terminated or truncated:
            recorder.end(terminated=terminated, truncated=truncated, is_success=info["is_success"])
    return recorder.finished[0]
