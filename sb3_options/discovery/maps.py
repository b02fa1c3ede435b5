"""Maps of concept space: everything seen in its first two features, with values, marks, sets and arrows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from sb3_options.density.regions import Region
from sb3_options.experience.observations import FloatArray, IntArray

PANEL_WIDTH = 6.4
"""Of a panel, in inches."""

HEIGHTS = (3.4, 6.0)
"""Lowest and highest panel, in inches; between them a panel has the shape of its map."""

SUBGOAL_COLOUR = "#d62728"
START: dict[str, Any] = {"marker": "o", "markersize": 4, "color": "white", "markeredgecolor": "black"}
GOAL: dict[str, Any] = {"marker": "D", "markersize": 8, "color": "white", "markeredgecolor": "black"}
SUBGOAL: dict[str, Any] = {"marker": "*", "markersize": 15, "color": SUBGOAL_COLOUR, "markeredgecolor": "white"}
MARGIN = 0.75
"""Free space around the outermost centres, in sides of a rectangle."""

INITIATION_COLOUR = "#9ecae1"


class Title(NamedTuple):
    """What a panel shows, and in which unit."""

    name: str
    unit: str


class Marks(NamedTuple):
    """Where trajectories began, where successful ones ended, and the subgoals; (n, d) each."""

    starts: FloatArray
    goals: FloatArray
    subgoals: FloatArray

    def draw(self, axes: Axes, place: Callable[[FloatArray], tuple[FloatArray, FloatArray]]) -> None:
        """Mark them where ``place`` has them, x and y."""
        kinds = {"start": START, "goal: where a success ended": GOAL, "subgoal": SUBGOAL}
        for points, (label, style) in zip(self, kinds.items(), strict=True):
            if len(points):
                axes.plot(*place(points), linestyle="", label=label, **style)


def ticks_of(values: FloatArray | IntArray) -> MaxNLocator:
    """Ticks at whole numbers, where these are enough to tell values apart."""
    whole = np.issubdtype(values.dtype, np.integer) or np.ptp(values) >= 2
    return MaxNLocator(nbins=6, integer=bool(whole), min_n_ticks=1)


class Cells:
    """The first two features of everything seen, as a map: rectangles as wide as neighbours are apart.

    Where features hardly repeat, neighbours are next to nothing apart, and the rectangles have sides of one unit.
    """

    def __init__(self, seen: FloatArray, scale: FloatArray, marks: Marks) -> None:
        flat = seen if seen.shape[1] > 1 else np.column_stack([seen, np.zeros(len(seen))])
        sides = scale if len(scale) > 1 else np.array([scale[0], 1.0])
        self.positions, self.row_of = np.unique(flat[:, :2], axis=0, return_inverse=True)
        self.side = np.array([max(1.0 / s, _spacing(x)) for s, x in zip(sides, self.positions.T, strict=False)])
        self.marks, self.n_features = marks, seen.shape[1]
        extent = np.ptp(self.positions, axis=0) + 2 * MARGIN * self.side
        self.is_map = self.n_features > 1 and bool(np.isclose(*self.side))
        self.height = float(np.clip(PANEL_WIDTH * extent[1] / extent[0], *HEIGHTS)) if self.is_map else HEIGHTS[0]

    def draw(self, axes: Axes, title: Title, values: FloatArray | IntArray) -> None:
        """Colour every square by the largest value that falls into it."""
        largest = np.full(len(self.positions), -np.inf)
        np.maximum.at(largest, self.row_of.reshape(-1), values)
        squares = PatchCollection(self._squares(self.positions), cmap="viridis")
        squares.set_array(largest)
        axes.add_collection(squares)
        axes.figure.colorbar(squares, ax=axes, ticks=ticks_of(values), label=title.unit)
        self._finish(axes, title.name)

    def draw_sets(self, axes: Axes, regions: list[Region]) -> None:
        """Shade the initiation sets over everything seen."""
        self._ground(axes)
        for region in regions:
            squares = self._squares(region.points)
            axes.add_collection(PatchCollection(squares, facecolor=INITIATION_COLOUR, edgecolor="white"))
        self._finish(axes, "initiation set")

    def draw_arrows(self, axes: Axes, starts: FloatArray, moves: FloatArray) -> None:
        """Draw where the greedy action leads on average, from each state of the initiation sets."""
        self._ground(axes)
        length = np.linalg.norm(moves, axis=1, keepdims=True)
        unit = np.divide(moves, length, out=np.zeros_like(moves), where=length > 0) * self.side * 0.8
        axes.quiver(
            *(starts - unit / 2).T,
            *unit.T,
            angles="xy",
            scale_units="xy",
            scale=1,
            width=0.004,
            color="#08519c",
            zorder=3,  # above the marks
        )
        self._finish(axes, "option policy: where the greedy action leads")

    def _ground(self, axes: Axes) -> None:
        axes.add_collection(PatchCollection(self._squares(self.positions), facecolor="0.93", edgecolor="white"))

    def _squares(self, positions: FloatArray) -> list[Rectangle]:
        if positions.shape[1] == 1:
            positions = np.column_stack([positions, np.zeros(len(positions))])
        return [Rectangle(tuple(p - self.side / 2), *self.side) for p in positions[:, :2]]

    def _finish(self, axes: Axes, title: str) -> None:
        self.marks.draw(axes, lambda points: tuple(np.array([plane(p) for p in points]).T))
        margin = MARGIN * self.side
        low, high = self.positions.min(axis=0) - margin, self.positions.max(axis=0) + margin
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(high[1], low[1])  # rows are counted downwards, as in the map
        if np.ptp(self.positions[:, 1]) == 0:
            axes.set_yticks([])  # there is but one feature to show
        elif self.is_map:
            axes.set_aspect("equal")
        if np.array_equal(self.positions, np.round(self.positions)):
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        names = [f"feature {i} of {self.n_features}" for i in (1, 2)]
        axes.set(title=title, xlabel=names[0], ylabel=names[1] if self.n_features > 1 else "")


def _spacing(values: FloatArray) -> float:
    """The smallest distance between two different values; 0 where there is one value only."""
    return float(np.diff(np.unique(values)).min(initial=np.inf)) if np.ptp(values) > 0 else 0.0


def plane(feature: FloatArray) -> FloatArray:
    """The first two features; a second 0 where there is only one."""
    return np.array([feature[0], feature[1] if len(feature) > 1 else 0.0], dtype=np.float64)
