"""A method of discovery that tells what it was told, and trajectories along a line."""

from typing import Any

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.methods import DiscoveryMethod, Experience
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import Trajectory
from tests.discovery.lines import on_a_line


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


def line(n_states: int = 12, *, success: bool = True) -> tuple[Trajectory, FloatArray]:
    return on_a_line(*range(n_states), success=success)


def searched(discovery: Discovery, n: int = 1, **changes: Any) -> list[float | None]:
    """Where it finds a subgoal after each of ``n`` more trajectories."""
    found: list[float | None] = []
    for _ in range(n):
        discovery.add(*line(**changes))
        subgoal = discovery.search()
        found.append(None if subgoal is None else float(subgoal.points[0, 0]))
    return found


def of(method: DiscoveryMethod, kind: str = "environment", **settings: float) -> Discovery:
    return Discovery(DiscoverySettings(**settings), method=method, kind=kind)  # type: ignore[arg-type]  # of those that are numbers
