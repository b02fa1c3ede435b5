"""What the agents learn, and from where on they can be said to."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sb3_options.envs import GridWorld
from sb3_options.experience.observations import FloatArray

SLACK = 4.0
"""An episode is a success if it takes at most this many times the steps that the best policy takes on average."""


@dataclass(frozen=True)
class Task:
    """A gridworld to learn, and where options may come from.

    Attributes:
        env: Gymnasium id.
        target: Keyword arguments of the environment that is learned.
        source: Of the environment whose options are brought along; None discovers them in the target itself.
        n_timesteps: Of training in the target, primitive steps.
        source_timesteps: Of training in the source.
    """

    env: str
    target: dict[str, Any] = field(default_factory=dict)
    source: dict[str, Any] | None = None
    n_timesteps: int = 30_000
    source_timesteps: int = 30_000


MOVED = {"success_probability": 0.8}
"""In transfer moves are less certain, as in McGovern & Barto (2001), §6.4."""

TASKS = {
    ("same", "TwoRooms"): Task("sb3_options/TwoRooms-v0"),
    ("same", "KeyDoor"): Task("sb3_options/KeyDoor-v0"),
    ("transfer", "TwoRooms"): Task("sb3_options/TwoRooms-v0", {"goal": (20, 0), **MOVED}, {}),
    ("transfer", "FourRooms"): Task("sb3_options/FourRooms-v0", {"goal": (11, 8), **MOVED}, {}),
    ("deadline", "TwoRooms"): Task("sb3_options/TwoRooms-v0", {"goal": (20, 0), "max_steps": 100, **MOVED}, {}),
    ("deadline", "KeyDoor"): Task("sb3_options/KeyDoor-v0", {"goal": (12, 0), "max_steps": 150, **MOVED}, {}),
}
"""The goal moves to another corner of its room. With a deadline, random walks hardly ever reach it in time."""


def optimal_steps(world: GridWorld) -> float:
    """Expected steps to the goal of the best policy, the mean over the start cells."""
    return float(steps_after(world).min(axis=0)[world._start_states].mean())


def steps_after(world: GridWorld) -> FloatArray:
    """Expected steps to the goal, by direction and state, if the best policy follows (value iteration).

    From inside a wall there is no way out, and nothing that is returned counts.
    """
    successors = np.asarray(world._grid.successors)  # (directions, states)
    starts, p = world._start_states, world._success_probability
    goal = np.asarray(world._is_goal)
    steps = np.zeros(successors.shape[1])
    while True:
        after = steps[successors]
        by_direction = 1.0 + (p * after + (1 - p) * after.mean(axis=0))
        best = by_direction.min(axis=0)
        best[goal] = 0.0
        if np.abs(best - steps)[starts].max() < 1e-9:
            return np.asarray(by_direction)
        steps = best
