"""A method of discovery that tells what it was told, and trajectories along a line."""

from typing import Any

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.methods import DiscoveryMethod, Experience
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.trajectories import Trajectory


class Told:
    """Proposes what it was given, and remembers what it was told, though not in a checkpoint."""

    def __init__(self, *points: float) -> None:
        self.points = points
        self.told: list[Experience] = []

    def update(self, experience: Experience) -> list[Region]:
        self.told.append(experience)
        return [experience.region(np.array([point])) for point in self.points]

    def get_state(self) -> dict[str, Any]:
        return {}

    def set_state(self, state: dict[str, Any]) -> None:
        pass


def line(n: int = 12, *, success: bool = True) -> tuple[Trajectory, np.ndarray]:
    states = np.arange(n, dtype=np.float64)[:, None]
    visits = np.arange(n)
    actions, rewards = np.zeros(n - 1, dtype=np.int64), np.zeros(n - 1)
    return Trajectory(states, visits, actions, rewards, success, not success, success), states


def searched(discovery: Discovery) -> float | None:
    """Where it finds a subgoal after one more trajectory."""
    discovery.add(*line())
    subgoal = discovery.search()
    return None if subgoal is None else float(subgoal.points[0, 0])


def of(method: DiscoveryMethod, kind: str = "environment", **settings: float) -> Discovery:
    return Discovery(DiscoverySettings(**settings), method=method, kind=kind)  # type: ignore[arg-type]  # of those that are numbers
