"""What is run for every seed: discovery from the trajectories of a random walk."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from experiments.common.few_peaks import FewPeaks
from experiments.common.gridworlds import NEAR, world_of
from experiments.common.seeds import Result
from experiments.methods.left_out import LEFT_OUT
from experiments.random_walks.maps import random_map
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.methods import Method
from sb3_options.discovery.methods.diverse_density import PersistentPeaks
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.envs import GridWorld
from sb3_options.envs.gridworld.grid_map import Direction
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.recording import TrajectoryRecorder
from sb3_options.experience.trajectories import Trajectory

TASKS = ("TwoRooms", "KeyDoor", "FourRooms", "random maps")

PLAIN: dict[str, Any] = {
    "loops": "keep", "min_passing": 0.0, "leak": 0.0, "max_places": 2, "goal_radius": 5.0,
    "min_positive": 8, "decay": 0.9, "search_growth": 0.0, "cut_threshold": 0.6,
}  # fmt: skip
ARMS: dict[str, dict[str, Any]] = {
    "paper's bags": PLAIN,
    "without loops": {**PLAIN, "loops": "erase"},
    "without loops, passages only": {"min_positive": 8, "decay": 0.9, "search_growth": 0.0, "cut_threshold": 0.6},
    "the same, sooner": {},
}
"""What is changed of the defaults."""

WAITING: dict[str, dict[str, Any]] = {
    "eight successes, decay 0.9": {"min_positive": 8, "decay": 0.9, "search_growth": 0.0, "cut_threshold": 0.6},
    "four, decay 0.75": {"cut_threshold": 0.6},
    "four, decay 0.5": {"decay": 0.5, "cut_threshold": 0.6},
    "four, decay 0.75, known cuts sooner": {},
}
"""How many successes the first search waits for, and how long a peak must persist. The first is how it was before, the
last is the default."""

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
    """Whether a subgoal's cell is within one step of a doorway, a door or a key."""
    column, row = round(point[0]), round(point[1])
    places = [*world.doorways, *world.doors, *world.keys]
    return min(abs(column - x) + abs(row - y) for x, y in places) <= NEAR


class Positions(gym.Wrapper[Any, Any, Any, Any]):
    """Shows concept features, with an error in the position, so that no state is visited twice.

    Args:
        env: A gridworld.
        noise: Largest error of column and row, in cells.
        seed: Of the errors.
    """

    def __init__(self, env: GridWorld, noise: float, seed: int) -> None:
        super().__init__(env)
        self._world, self._noise = env, noise
        self._rng = np.random.default_rng([seed, 1])  # not that of the walk

    def reset(self, **kwargs: Any) -> tuple[FloatArray, dict[str, Any]]:
        """Begin an episode."""
        observation, info = super().reset(**kwargs)
        return self._shown(observation), info

    def step(self, action: Any) -> tuple[FloatArray, Any, bool, bool, dict[str, Any]]:
        """One step."""
        observation, reward, terminated, truncated, info = super().step(action)
        return self._shown(observation), reward, terminated, truncated, info

    def _shown(self, observation: Any) -> FloatArray:
        features: FloatArray = self._world.concept_features(np.asarray(observation)[None])[0]
        if self._noise:
            features[:2] += self._rng.uniform(-self._noise, self._noise, 2)
        return features


def run(task: str, changed: dict[str, Any], seed: int, n_episodes: int | None = None, noise: float = 0.0) -> Result:
    """Discover from one random walk after the other.

    Args:
        task: One of `TASKS`.
        changed: Settings of discovery other than the defaults.
        seed: Of the map, the environment and the walk.
        n_episodes: By default `N_EPISODES`.
        noise: Largest error of positions, in cells.

    Returns:
        ``found``: of each subgoal the episode, the point and whether it is a bottleneck; ``instances``: how many
        distinct ones positive bags held when the first was found, or in the end, and how many are bottlenecks;
        ``n_successes``; ``seconds`` of all searches.
    """
    world, rng = world_for(task, seed), np.random.default_rng(seed)
    seen = Positions(world, noise, seed)
    name = changed.get("method")
    own: Method | None = LEFT_OUT[name]() if name in LEFT_OUT else None
    if "cut_threshold" in changed:
        own = FewPeaks(changed.get("max_places", math.inf))
    of_own = {"method", "max_places", "cut_threshold"} if own is not None else set()
    settings = DiscoverySettings(**{key: value for key, value in changed.items() if key not in of_own})
    discovery = Discovery(settings, own, kind="environment")
    found: list[dict[str, Any]] = []
    instances: FloatArray = np.zeros((0, 2))
    seen.reset(seed=seed)
    for episode in range(1, (n_episodes or N_EPISODES) + 1):
        trajectory = walk(seen, rng)
        discovery.add(trajectory, np.asarray(trajectory.states))
        subgoal = discovery.search() if len(found) < MAX_OPTIONS else None
        if not found and isinstance(discovery.method, PersistentPeaks) and discovery.method.evidence is not None:
            instances = np.unique(np.concatenate(discovery.method.evidence.positive), axis=0)
        if subgoal is not None:
            point = subgoal.points[0].tolist()
            found.append({"episode": episode, "point": point, "bottleneck": is_bottleneck(world, point)})
    n_successes = sum(t.success for t in discovery.database)
    return {
        "seed": seed,
        "found": found,
        "instances": {"n": len(instances), "n_bottlenecks": sum(is_bottleneck(world, each) for each in instances)},
        "n_successes": n_successes,
        "seconds": discovery.diary.seconds,
    }


def walk(world: gym.Env[Any, Any], rng: np.random.Generator) -> Trajectory:
    """One episode of uniformly random actions."""
    recorder = TrajectoryRecorder()
    observation, _ = world.reset()
    recorder.begin(observation)
    while not recorder.finished:
        action = int(rng.integers(len(Direction)))
        observation, reward, terminated, truncated, info = world.step(action)
        recorder.record(action, float(reward), observation)
        if terminated or truncated:
            recorder.end(terminated=terminated, truncated=truncated, is_success=info["is_success"])
    return recorder.finished[0]
