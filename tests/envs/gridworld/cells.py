"""The cell an agent is seen in."""

from typing import Any, Literal

from numpy.typing import NDArray

from sb3_options.envs import GridWorld
from sb3_options.envs.gridworld.grid_map import Cell

KINDS: tuple[Literal["onehot"], Literal["xy"], Literal["image"]] = ("onehot", "xy", "image")
Kind = Literal["onehot", "xy", "image"]


def cell_of(env: GridWorld, observation: NDArray[Any]) -> Cell:
    x, y = env.concept_features(observation[None])[0, :2]
    return int(x), int(y)
