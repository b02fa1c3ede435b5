"""The cell an agent is seen in, and pictures without a display."""

from collections.abc import Iterator
from typing import Any, Literal

import matplotlib.pyplot as plt
import pytest
from numpy.typing import NDArray

from sb3_options.envs import GridWorld
from sb3_options.envs.gridworld.grid_map import Cell

KINDS: tuple[Literal["onehot"], Literal["xy"], Literal["image"]] = ("onehot", "xy", "image")
Kind = Literal["onehot", "xy", "image"]

# "human" is checked on matplotlib's backend without windows, which warns where there is a display.
without_windows = pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")


@pytest.fixture(autouse=True)
def no_display() -> Iterator[None]:
    plt.switch_backend("agg")
    yield
    plt.close("all")


def cell_of(env: GridWorld, observation: NDArray[Any]) -> Cell:
    x, y = env.concept_features(observation[None])[0, :2]
    return int(x), int(y)
