"""What the studies in gridworlds share: how near the doorway a subgoal is, and maps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, cast

import gymnasium as gym
import networkx as nx
import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator

from sb3_options.envs import GridWorld
from sb3_options.experience.observations import FloatArray

Cell = tuple[int, int]

NEAR = 1
"""A subgoal this many steps from the doorway still is at the doorway: every crossing visits it."""


def world_of(env_id: str, **kwargs: Any) -> GridWorld:
    """The gridworld itself."""
    return cast("GridWorld", gym.make(env_id, **kwargs).unwrapped)


def cell_of(point: Iterable[float]) -> Cell:
    """The cell (x, y) of a point of concept space."""
    x, y = point
    return round(float(x)), round(float(y))


def distance_to_doorway(world: GridWorld, cell: Sequence[int]) -> int:
    """Steps without walls."""
    return min(abs(cell[0] - x) + abs(cell[1] - y) for x, y in world.doorways)


def counts_of(world: GridWorld, cells: Iterable[Sequence[int] | None]) -> FloatArray:
    """How often each cell is there, shape (height, width)."""
    counts = np.zeros(world.walls.shape)
    for cell in cells:
        if cell is not None:
            counts[cell[1], cell[0]] += 1
    return counts


def rooms_of(world: GridWorld) -> list[set[Cell]]:
    """The cells (x, y) of each room: the parts of the map without its doorways and doors."""
    graph = nx.grid_2d_graph(world.width, world.height)
    rows, columns = np.nonzero(world.walls)
    graph.remove_nodes_from([*zip(columns.tolist(), rows.tolist(), strict=True), *world.doorways, *world.doors])
    return [set(part) for part in nx.connected_components(graph)]


def draw_counts(axes: Axes, world: GridWorld, counts: FloatArray, most: int) -> AxesImage:
    """Draw how often each cell was found, with walls and doorways and without ticks.

    Args:
        axes: To draw on.
        world: Whose cells they are.
        counts: Of each cell, (height, width), as `counts_of` gives them.
        most: The count of the darkest colour; 1 at least is taken.

    Returns:
        The counts, for a colour bar.
    """
    shown = axes.imshow(counts, cmap="Blues", vmin=0, vmax=max(most, 1))
    axes.imshow(world.walls, cmap="binary", alpha=0.6 * world.walls, vmin=0, vmax=1)
    frame_doorways(axes, world)
    axes.set_xticks([])
    axes.set_yticks([])
    return shown


def add_colour_bar(shown: AxesImage, axes: Axes | Iterable[Axes], label: str) -> None:
    """Say what the colours of counts mean, in whole numbers.

    Args:
        shown: What `draw_counts` drew.
        axes: From which the bar takes its room.
        label: What is counted.
    """
    shown.figure.colorbar(shown, ax=axes, label=label, shrink=0.5, ticks=MaxNLocator(6, integer=True))


def frame_doorways(axes: Axes, world: GridWorld) -> None:
    """Mark them in a map."""
    for x, y in world.doorways:
        axes.plot(x, y, "s", markersize=14, markerfacecolor="none", markeredgecolor="#d62728")
