"""Pictures of discovery: where diverse density is high, and what the options made of it do."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.maps import (
    HEIGHTS,
    PANEL_WIDTH,
    Cells,
    Marks,
    Title,
    plane,
    ticks_of,
)
from sb3_options.experience.observations import FloatArray, IntArray, batch_size
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option, SubgoalOption

WORST_SHOWN = 60.0
"""Log densities this far below the best share the darkest colour, in nats, unless too few are above that."""

SHARE_SHOWN = 0.25
"""Share of the states that have a brighter colour: without a leak all but the best are hundreds of nats below it."""

TEXT_WIDTH = 80
"""Characters of a line of text."""


def discovery_figures(discovery: Discovery, bank: OptionBank) -> dict[str, Figure]:
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


def subgoals_figure(discovery: Discovery, bank: OptionBank, text: str | None = None) -> Figure:
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


def _is_drawn(option: Option | None) -> bool:
    return isinstance(option, SubgoalOption) and option.subgoal.group is None


def _add_legend(figure: Figure) -> None:
    """Say once, below all panels, what the marks in them mean."""
    marks = {label: mark for axes in figure.axes for mark, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if marks:
        figure.legend(marks.values(), marks.keys(), loc="outside lower center", ncols=len(marks), fontsize="large")


DENSITY = Title("log diverse density", "nats")
VISITS = Title("successful trajectories that visit", "trajectories")


class _Seen(NamedTuple):
    """Features of everything seen, each once, (n, d), and the marks."""

    seen: FloatArray
    marks: Marks


def _seen(discovery: Discovery) -> _Seen | None:
    """None before any search."""
    if discovery.scale is None or not len(discovery.database):
        return None
    runs = list(discovery.database)
    seen = np.unique(np.concatenate([t.features for t in runs]) + 0.0, axis=0)  # -0.0 and 0.0 are one
    d = seen.shape[1]
    marks = Marks(
        np.unique([t.features[t.trajectory.visits[0]] for t in runs], axis=0),
        np.unique(np.reshape([t.features[t.trajectory.visits[-1]] for t in runs if t.success], (-1, d)), axis=0),
        np.reshape([finding.centre for finding in discovery.found], (-1, d)),
    )
    return _Seen(seen, marks)


def _panels(discovery: Discovery, bank: OptionBank) -> tuple[dict[str, Callable[[Axes], None]], float]:
    """What draws each panel, by name, and the height of one in inches."""
    about = _seen(discovery)
    density = None if about is None else discovery.method.log_density(about.seen)
    if about is None or (density is None and not discovery.found):
        return {}, HEIGHTS[0]
    seen, marks = about
    visits = _first_visits(discovery, seen)
    panels: dict[str, Callable[[Axes], None]] = {}
    if discovery.kind == "categorical":
        if density is not None:
            panels["diverse_density"] = lambda axes: _bars(axes, DENSITY, seen, density, marks)
        panels["first_visits"] = lambda axes: _bars(axes, VISITS, seen, visits, marks)
        return panels, HEIGHTS[0]
    assert discovery.scale is not None  # there was a search
    cells = Cells(seen, discovery.scale, marks)
    if density is not None:
        shown = np.maximum(density, min(density.max() - WORST_SHOWN, np.quantile(density, 1.0 - SHARE_SHOWN)))
        panels["diverse_density"] = lambda axes: cells.draw(axes, DENSITY, shown)
    panels["first_visits"] = lambda axes: cells.draw(axes, VISITS, visits)
    options = [o for o in bank.slots if isinstance(o, SubgoalOption) and _is_drawn(o)]
    if options:
        panels["initiation_set"] = lambda axes: cells.draw_sets(axes, [o.initiation_set for o in options])
        panels["option_policy"] = lambda axes: _draw_policies(axes, cells, discovery, options)
    return panels, cells.height


def _first_visits(discovery: Discovery, seen: FloatArray) -> IntArray:
    """How many successful trajectories visit each row of ``seen``."""
    counts = np.zeros(len(seen), dtype=np.int64)
    row_of = {row.tobytes(): i for i, row in enumerate(seen)}
    for labelled in discovery.database:
        if labelled.success:
            counts[[row_of[row.tobytes()] for row in np.unique(labelled.features + 0.0, axis=0)]] += 1
    return counts


def _bars(axes: Axes, title: Title, seen: FloatArray, values: FloatArray | IntArray, marks: Marks) -> None:
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
    axes.yaxis.set_major_locator(ticks_of(values))


def _moves_of(discovery: Discovery, options: list[SubgoalOption]) -> tuple[FloatArray, FloatArray] | None:
    """Where the greedy actions of options led in the saved trajectories, from each state of the initiation sets."""
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
                moves.setdefault((plane(a) + 0.0).tobytes(), []).append(plane(b) - plane(a))
    if not moves:
        return None
    starts = np.array([np.frombuffer(key, dtype=np.float64) for key in moves])
    return starts, np.array([np.mean(m, axis=0) for m in moves.values()])


def _draw_policies(axes: Axes, cells: Cells, discovery: Discovery, options: list[SubgoalOption]) -> None:
    moves = _moves_of(discovery, options)
    if moves is None:
        axes.set_axis_off()
    else:
        cells.draw_arrows(axes, *moves)
