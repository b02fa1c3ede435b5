"""Figures of discovery: where diverse density is high, and where the options lead."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from sb3_options.discovery.discovery import Discovery
from sb3_options.experience.observations import FloatArray, IntArray, flatten
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import SubgoalOption

PANEL_WIDTH = 6.4  # inches
HEIGHTS = (3.4, 6.0)  # lowest and highest panel, inches; between them a panel has the shape of its map
MARGIN = 0.75  # free space around the outermost centres, in sides of a square
TEXT_WIDTH = 80  # characters of a line
WORST_SHOWN = 60.0  # nats; log densities this far below the best share the darkest colour, unless too few lie above
SHARE_SHOWN = 0.25  # least share of brighter states: without a leak most lie hundreds of nats below the best

START: dict[str, Any] = {"marker": "o", "markersize": 4, "color": "white", "markeredgecolor": "black"}
GOAL: dict[str, Any] = {"marker": "D", "markersize": 8, "color": "white", "markeredgecolor": "black"}
SUBGOAL: dict[str, Any] = {"marker": "*", "markersize": 15, "color": "#d62728", "markeredgecolor": "white"}
INITIATION_COLOUR = "#9ecae1"
GROUND: dict[str, Any] = {"facecolor": "0.93", "edgecolor": "white"}


def subgoals_figure(discovery: Discovery, bank: OptionBank, text: str | None = None) -> Figure:
    """Draw `map_figure` for a run folder, or a text if there is no map.

    ``text`` stands above the panels; by default it says why nothing was found, if so.
    """
    if text is None and not discovery.found:
        text = discovery.why_nothing()
    figure = map_figure(discovery, bank)
    if figure is not None:
        if text:
            figure.suptitle(textwrap.fill(text, TEXT_WIDTH), fontsize="medium")
        return figure
    if not text:
        where = "; ".join(found.where(discovery.kind) for found in discovery.found)
        text = f"Subgoals: {where}. Their features have no map to draw them in."
    figure = Figure(figsize=(PANEL_WIDTH, HEIGHTS[0]), layout="compressed")
    axes = figure.add_subplot()
    axes.set_axis_off()
    axes.text(0.5, 0.5, textwrap.fill(text, TEXT_WIDTH), ha="center", va="center")
    return figure


def map_figure(discovery: Discovery, bank: OptionBank) -> Figure | None:
    """Draw maps of the first two features of all states seen.

    They show diverse density (if that is the method), successful trajectories, and initiation sets and policies of
    options. None before any search, and for states with one-hot codes, one feature, or feature groups.
    """
    runs = list(discovery.database)
    if not runs or discovery.scale is None or len(discovery.scale) < 2 or discovery.kind == "categorical":
        return None
    seen, rows = np.unique(np.concatenate([t.features for t in runs]) + 0.0, axis=0, return_inverse=True)
    density = discovery.method.log_density(seen)
    if density is None and not discovery.found:
        return None
    visits = np.zeros(len(seen), dtype=np.int64)
    of_runs = np.split(rows.ravel(), np.cumsum([len(t.features) for t in runs])[:-1])
    for labelled, own in zip(runs, of_runs, strict=True):
        visits[np.unique(own)] += labelled.success
    options = [o for o in bank.slots if isinstance(o, SubgoalOption) and o.subgoal.group is None]
    squares = _Map(seen, discovery.scale, _axis_names(discovery, seen.shape[1]))
    n_panels = (density is not None) + 1 + 2 * bool(options)
    columns = min(n_panels, 2)
    n_rows = -(-n_panels // columns)
    figure = Figure(figsize=(PANEL_WIDTH * columns, squares.height * n_rows), layout="compressed")
    panels = [figure.add_subplot(n_rows, columns, i + 1) for i in range(n_panels)]
    if density is not None:
        worst = min(density.max() - WORST_SHOWN, np.quantile(density, 1.0 - SHARE_SHOWN))
        squares.colour(panels[0], "log diverse density", "nats", np.maximum(density, worst))
    squares.colour(panels[int(density is not None)], "successful trajectories that visit", "trajectories", visits)
    if options:
        *_, sets, policies = panels
        squares.fill(sets, squares.positions, **GROUND)
        for option in options:
            squares.fill(sets, option.initiation_set.points, facecolor=INITIATION_COLOUR, edgecolor="white")
        sets.set_title("initiation set")
        squares.fill(policies, squares.positions, **GROUND)
        squares.arrows(policies, *_moves(discovery, options))
        policies.set_title("option policy: where the greedy action leads")
    marks = {
        "start": (START, [t.features[t.trajectory.visits[0]] for t in runs]),
        "goal: where a success ended": (GOAL, [t.features[t.trajectory.visits[-1]] for t in runs if t.success]),
        "subgoal": (SUBGOAL, [found.centre for found in discovery.found]),
    }
    for axes in panels:
        for label, (style, points) in marks.items():
            if points:
                axes.plot(*np.unique(points, axis=0)[:, :2].T, linestyle="", label=label, **style)
        squares.finish(axes)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize="large")
    return figure


class _Map:
    """A map of the first two features: one square per state, as wide as neighbours are apart, at least one unit."""

    def __init__(self, seen: FloatArray, scale: FloatArray, names: Sequence[str]) -> None:
        self.names = names
        self.positions, rows = np.unique(seen[:, :2], axis=0, return_inverse=True)
        self._row_of = rows.ravel()
        apart = [np.diff(np.unique(x)).min(initial=np.inf) if np.ptp(x) > 0 else 0.0 for x in self.positions.T]
        self.side = np.maximum(1.0 / scale[:2], apart)
        width, height = np.ptp(self.positions, axis=0) + 2 * MARGIN * self.side
        self._is_to_scale = bool(np.isclose(*self.side))
        self.height = float(np.clip(PANEL_WIDTH * height / width, *HEIGHTS)) if self._is_to_scale else HEIGHTS[0]

    def fill(self, axes: Axes, points: FloatArray, **style: Any) -> PatchCollection:
        """Draw the squares of some states, (n, d)."""
        squares = PatchCollection([Rectangle(tuple(p - self.side / 2), *self.side) for p in points[:, :2]], **style)
        axes.add_collection(squares)
        return squares

    def colour(self, axes: Axes, title: str, unit: str, values: FloatArray | IntArray) -> None:
        """Colour every square by the largest value that falls into it."""
        largest = np.full(len(self.positions), -np.inf)
        np.maximum.at(largest, self._row_of, values)
        squares = self.fill(axes, self.positions, cmap="viridis")
        squares.set_array(largest)
        axes.figure.colorbar(squares, ax=axes, ticks=MaxNLocator(nbins=6, integer=True, min_n_ticks=1), label=unit)
        axes.set_title(title)

    def arrows(self, axes: Axes, starts: FloatArray, moves: FloatArray) -> None:
        """Draw the direction of moves (n, 2) from places (n, 2)."""
        length = np.linalg.norm(moves, axis=1, keepdims=True)
        unit = np.divide(moves, length, out=np.zeros_like(moves), where=length > 0) * self.side * 0.8
        style: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.004, "color": "#08519c"}
        axes.quiver(*(starts - unit / 2).T, *unit.T, zorder=3, **style)  # above the marks

    def finish(self, axes: Axes) -> None:
        """Set the limits and names of the axes."""
        low, high = self.positions.min(axis=0) - MARGIN * self.side, self.positions.max(axis=0) + MARGIN * self.side
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(high[1], low[1])  # rows are counted downwards, as in the map
        if self._is_to_scale:
            axes.set_aspect("equal")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(integer=True))
        axes.set(xlabel=self.names[0], ylabel=self.names[1])


def _axis_names(discovery: Discovery, n: int) -> list[str]:
    """Return the names of the first two of n features: observation keys, coordinates, or numbers."""
    states = next(iter(discovery.database)).trajectory.states
    if discovery.kind == "identity" and isinstance(states, Mapping):
        sizes = {key: flatten(states[key]).shape[1] for key in sorted(states)}
        return [key if size == 1 else f"{key}[{i}]" for key, size in sizes.items() for i in range(size)]
    if n == 2 or discovery.kind == "environment":
        return ["x", "y"]
    return [f"feature {i} of {n}" for i in (1, 2)]


def _moves(discovery: Discovery, options: list[SubgoalOption]) -> tuple[FloatArray, FloatArray]:
    """Return the places of the initiation sets and the mean move of greedy actions from each, (n, 2) each."""
    began, led = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for option in options:
        for labelled in discovery.database:
            trajectory, features = labelled.trajectory, labelled.features
            inside = option.initiation_set.contains(features) & ~option.subgoal.contains(features)
            greedy = option.option_policy.actions(features if option.policy_input == "features" else trajectory.states)
            before, after = trajectory.visits[:-1], trajectory.visits[1:]
            followed = inside[before] & (trajectory.actions == greedy[before])
            began.append(features[before[followed], :2])
            led.append(features[after[followed], :2])
    starts = np.concatenate(began)
    places, which, counts = np.unique(starts + 0.0, axis=0, return_inverse=True, return_counts=True)
    totals = np.zeros_like(places)
    np.add.at(totals, which.ravel(), np.concatenate(led) - starts)
    return places, totals / counts[:, None]
