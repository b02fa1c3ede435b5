"""Pictures of discovery: where diverse density is high, and what the options made of it do."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from sb3_options.density.regions import Region
from sb3_options.discovery.subgoals import SubgoalDiscovery
from sb3_options.experience.observations import FloatArray, IntArray, batch_size
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import SubgoalOption

PANEL_WIDTH = 6.4
"""Of a panel, in inches."""

HEIGHTS = (3.4, 6.0)
"""Lowest and highest panel, in inches; between them a panel has the shape of its map."""

WORST_SHOWN = 60.0
"""Log densities this far below the best share the darkest colour, in nats, unless too few are above that."""

SHARE_SHOWN = 0.25
"""Share of the states that have a brighter colour: without a leak all but the best are hundreds of nats below it."""

TEXT_WIDTH = 80
"""Characters of a line of text."""

SUBGOAL_COLOUR = "#d62728"
START: dict[str, Any] = {"marker": "o", "markersize": 4, "color": "white", "markeredgecolor": "black"}
GOAL: dict[str, Any] = {"marker": "D", "markersize": 8, "color": "white", "markeredgecolor": "black"}
SUBGOAL: dict[str, Any] = {"marker": "*", "markersize": 15, "color": SUBGOAL_COLOUR, "markeredgecolor": "white"}
MARGIN = 0.75
"""Free space around the outermost centres, in sides of a rectangle."""

INITIATION_COLOUR = "#9ecae1"


def discovery_figures(discovery: SubgoalDiscovery, bank: OptionBank) -> dict[str, Figure]:
    """One figure per panel, by name: for TensorBoard.

    Args:
        discovery: After at least one search, or there is nothing to draw.
        bank: The options made so far.

    Returns:
        ``diverse_density``, ``first_visits``, ``initiation_set`` and ``option_policy``; empty before any search, the
        first only where that is the method, and the last two only once there is an option in a space that can be drawn.
    """
    panels, height = _panels(discovery, bank)
    figures: dict[str, Figure] = {}
    for name, draw in panels.items():
        figures[name] = figure = Figure(figsize=(PANEL_WIDTH, height), layout="compressed")
        draw(figure.add_subplot())
        _add_legend(figure)
    return figures


def subgoals_figure(discovery: SubgoalDiscovery, bank: OptionBank, text: str | None = None) -> Figure:
    """All panels in one figure: for a run folder.

    Args:
        discovery: What was found.
        bank: The options made.
        text: Said above the panels; by default why nothing was found, where that is so.

    Returns:
        A figure; only text where nothing was searched, or where concepts are on groups of features.
    """
    if text is None and not discovery.found:
        text = discovery.why_nothing()
    panels, height = _panels(discovery, bank)
    if not (text or panels):
        where = [found.where(discovery.kind) for found in discovery.found]
        text = f"Subgoals: {'; '.join(where)}. Groups of features have no map to draw them in."
    text = textwrap.fill(text or "", TEXT_WIDTH)
    columns = min(2, max(1, len(panels)))
    rows = max(1, -(-len(panels) // columns))
    figure = Figure(figsize=(PANEL_WIDTH * columns, height * rows), layout="compressed")
    for i, draw in enumerate(panels.values()):
        draw(figure.add_subplot(rows, columns, i + 1))
    if not panels:
        axes = figure.add_subplot()
        axes.set_axis_off()
        axes.text(0.5, 0.5, text, ha="center", va="center")
    elif text:
        figure.suptitle(text, fontsize="medium")
    _add_legend(figure)
    return figure


def _add_legend(figure: Figure) -> None:
    """Say once, below all panels, what the marks in them mean."""
    marks = {label: mark for axes in figure.axes for mark, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if marks:
        figure.legend(marks.values(), marks.keys(), loc="outside lower center", ncols=len(marks), fontsize="large")


class Title(NamedTuple):
    """What a panel shows, and in which unit."""

    name: str
    unit: str


DENSITY = Title("log diverse density", "nats")
VISITS = Title("successful trajectories that visit", "trajectories")


class _Marks(NamedTuple):
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


def _panels(discovery: SubgoalDiscovery, bank: OptionBank) -> tuple[dict[str, Callable[[Axes], None]], float]:
    """What draws each panel, by name, and the height of one in inches."""
    bags = discovery.found[-1].bags if discovery.found else discovery.last.bags
    if discovery.scale is None or (bags is None and not discovery.found):
        return {}, HEIGHTS[0]
    seen = np.unique(np.concatenate([t.features for t in discovery.database]), axis=0)
    visits = _first_visits(discovery, seen)
    d = seen.shape[1]
    runs = list(discovery.database)
    marks = _Marks(
        np.unique([t.features[t.trajectory.visits[0]] for t in runs], axis=0),
        np.unique(np.reshape([t.features[t.trajectory.visits[-1]] for t in runs if t.success], (-1, d)), axis=0),
        np.reshape([finding.centre for finding in discovery.found if len(finding.subgoal.points)], (-1, d)),
    )
    density = None if bags is None else np.asarray(discovery.engine().log_density(seen, bags))
    panels: dict[str, Callable[[Axes], None]] = {}
    if discovery.kind == "categorical":
        if density is not None:
            panels["diverse_density"] = lambda axes: _bars(axes, DENSITY, seen, density, marks)
        panels["first_visits"] = lambda axes: _bars(axes, VISITS, seen, visits, marks)
        return panels, HEIGHTS[0]
    cells = _Cells(seen, discovery.scale, marks)
    if density is not None:
        shown = np.maximum(density, min(density.max() - WORST_SHOWN, np.quantile(density, 1.0 - SHARE_SHOWN)))
        panels["diverse_density"] = lambda axes: cells.draw(axes, DENSITY, shown)
    panels["first_visits"] = lambda axes: cells.draw(axes, VISITS, visits)
    options = [o for o in bank.slots if isinstance(o, SubgoalOption)]
    if options:
        panels["initiation_set"] = lambda axes: cells.draw_sets(axes, [o.initiation_set for o in options])
        panels["option_policy"] = lambda axes: _draw_policies(axes, cells, discovery, options)
    return panels, cells.height


def _first_visits(discovery: SubgoalDiscovery, seen: FloatArray) -> IntArray:
    """How many successful trajectories visit each row of ``seen``."""
    counts = np.zeros(len(seen), dtype=np.int64)
    row_of = {row.tobytes(): i for i, row in enumerate(seen)}
    for labelled in discovery.database:
        if labelled.success:
            counts[[row_of[row.tobytes()] for row in np.unique(labelled.features, axis=0)]] += 1
    return counts


def _bars(axes: Axes, title: Title, seen: FloatArray, values: FloatArray | IntArray, marks: _Marks) -> None:
    states = seen.argmax(axis=1)
    order = np.argsort(states)
    axes.plot(states[order], values[order], ".", markersize=5, color="0.4")
    of = dict(zip(states.tolist(), values.tolist(), strict=True))

    def place(points: FloatArray) -> tuple[FloatArray, FloatArray]:
        numbers = points.argmax(axis=1)
        return numbers.astype(float), np.array([of.get(n, np.nan) for n in numbers.tolist()])

    marks.draw(axes, place)
    axes.set(title=title.name, xlabel="number of the state", ylabel=title.unit)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_locator(_ticks(values))


def _ticks(values: FloatArray | IntArray) -> MaxNLocator:
    """Ticks at whole numbers, where these are enough to tell values apart."""
    whole = np.issubdtype(values.dtype, np.integer) or np.ptp(values) >= 2
    return MaxNLocator(nbins=6, integer=bool(whole), min_n_ticks=1)


class _Cells:
    """The first two features of everything seen, as a map: rectangles as wide as neighbours are apart.

    Where features hardly repeat, neighbours are next to nothing apart, and the rectangles have sides of one unit.
    """

    def __init__(self, seen: FloatArray, scale: FloatArray, marks: _Marks) -> None:
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
        axes.figure.colorbar(squares, ax=axes, ticks=_ticks(values), label=title.unit)
        self._finish(axes, title.name)

    def draw_sets(self, axes: Axes, regions: list[Region]) -> None:
        """Shade the initiation sets over everything seen."""
        self._ground(axes)
        for region in regions:
            axes.add_collection(
                PatchCollection(self._squares(region.points), facecolor=INITIATION_COLOUR, edgecolor="white")
            )
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
        self.marks.draw(axes, lambda points: tuple(np.array([_plane(p) for p in points]).T))
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


def _draw_policies(axes: Axes, cells: _Cells, discovery: SubgoalDiscovery, options: list[SubgoalOption]) -> None:
    moves: dict[bytes, list[FloatArray]] = {}
    for option in options:
        for labelled in discovery.database:
            trajectory, features = labelled.trajectory, labelled.features
            inside = option.initiation_set.contains(features) & ~option.subgoal.contains(features)
            if not inside.any() or batch_size(trajectory.states) == 0:
                continue
            greedy = option.option_policy.actions(features if option.policy_input == "features" else trajectory.states)
            began, led = trajectory.visits[:-1], trajectory.visits[1:]
            followed = inside[began] & (trajectory.actions == greedy[began])
            for a, b in zip(features[began[followed]], features[led[followed]], strict=True):
                moves.setdefault(_plane(a).tobytes(), []).append(_plane(b) - _plane(a))
    if not moves:
        axes.set_axis_off()
        return
    starts = np.array([np.frombuffer(key, dtype=np.float64) for key in moves])
    cells.draw_arrows(axes, starts, np.array([np.mean(m, axis=0) for m in moves.values()]))


def _plane(feature: FloatArray) -> FloatArray:
    """The first two features; a second 0 where there is only one."""
    return np.array([feature[0], feature[1] if len(feature) > 1 else 0.0], dtype=np.float64)
