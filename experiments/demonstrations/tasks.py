"""What is learned from demonstrations: MiniGrid's large tasks, the paper's rooms and Taxi."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np

from experiments.common.gridworlds import world_of
from experiments.deep.tasks import SLACK, optimal_steps
from experiments.demonstrations.experts import Policy, expert_of, room_expert, taxi_expert
from experiments.methods.tasks import TAXI_STOPS, best_taxi_steps, taxi_to
from sb3_options.envs.minigrid import DISCOVERY, make
from sb3_options.runs.config import configure

Environment: TypeAlias = gym.Env[Any, Any]

LONGEST = 500
"""Steps of an episode in rooms, so that demonstrations end, whatever the expert does."""

STOP = 0
"""Where all passengers want to go, where Taxi has one destination."""


@dataclass(frozen=True)
class Task:
    """A task and the settings that belong to it.

    Attributes:
        frames: After which a run is given up.
        make: Its environment, without options.
        expert: Of an environment, with a share of random actions, drawn from a seed.
        gamma: Discount per primitive step.
        max_options: Slots.
        within: Steps within which an episode is a success; None leaves it to the environment.
        ppo: Arguments of PPO, those of ``train.py``.
        discovery: Arguments of `SubgoalDiscoveryCallback`.
    """

    frames: int
    make: Callable[[], Environment]
    expert: Callable[[Environment, float, int], Policy]
    gamma: float = 0.97
    max_options: int = 4
    within: float | None = None
    ppo: Mapping[str, Any] = field(default_factory=dict)
    discovery: Mapping[str, Any] = field(default_factory=dict)


def _ppo(env_id: str) -> dict[str, Any]:
    return configure(algo="maskableppo", env=env_id).algo_kwargs


def _minigrid(env_id: str, frames: int, *, mission: bool = False) -> Task:
    """A task of MiniGrid; ``mission``: whether it names what the agent cannot see, and is part of the observation."""
    made = partial(make, env_id, mission=mission, last_action=True)
    return Task(frames, made, expert_of, 0.99, 8, ppo=_ppo(env_id), discovery=DISCOVERY)


def _with_table(frames: int, made: Callable[[], Environment], expert: Any, within: float) -> Task:
    """A task whose states fit a table."""
    return Task(frames, made, expert, within=within, ppo=_ppo("Taxi-v4"))


def _room(name: str) -> Task:
    env_id = f"sb3_options/{name}-v0"
    made = partial(gym.make, env_id, max_steps=LONGEST)
    return _with_table(60_000, made, room_expert, SLACK * optimal_steps(world_of(env_id)))


def _taxi_steps() -> float:
    return float(np.mean([best_taxi_steps(stop) for stop in range(len(TAXI_STOPS))]))


TASKS = {
    "BabyAI-KeyCorridorS3R3-v0": _minigrid("BabyAI-KeyCorridorS3R3-v0", 200_000),
    "BabyAI-KeyCorridorS4R3-v0": _minigrid("BabyAI-KeyCorridorS4R3-v0", 1_000_000),
    "BabyAI-KeyCorridorS6R3-v0": _minigrid("BabyAI-KeyCorridorS6R3-v0", 1_000_000),
    "MiniGrid-ObstructedMaze-1Dl-v0": _minigrid("MiniGrid-ObstructedMaze-1Dl-v0", 400_000),
    "MiniGrid-ObstructedMaze-2Dlh-v0": _minigrid("MiniGrid-ObstructedMaze-2Dlh-v0", 3_000_000),
    "MiniGrid-LockedRoom-v0": _minigrid("MiniGrid-LockedRoom-v0", 300_000, mission=True),
    "BabyAI-UnlockToUnlock-v0": _minigrid("BabyAI-UnlockToUnlock-v0", 300_000),
    "TwoRooms": _room("TwoRooms"),
    "FourRooms": _room("FourRooms"),
    "Taxi": _with_table(100_000, partial(gym.make, "Taxi-v4"), taxi_expert, SLACK * _taxi_steps()),
    "Taxi, one stop": _with_table(60_000, partial(taxi_to, STOP), taxi_expert, SLACK * best_taxi_steps(STOP)),
}
