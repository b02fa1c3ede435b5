"""The picture of the race."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, NullFormatter

from experiments.methods.entrants import NONE

STYLES = {"same": ("#1f77b4", "o", -0.15, "same task"), "moved": ("#d62728", "D", 0.15, "goal moved")}
"""Colour, marker, offset in rows and label of each phase."""

TICKS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
PANEL = (2.9, 0.22)
"""Width of a panel and height of a row, in inches."""

COLUMNS = 3
"""Panels side by side: as many as a page shows in letters that can be read."""

ALL_TASKS = "all tasks (geometric mean)"


def draw(summaries: Mapping[str, Mapping[str, Mapping[str, Any]]], means: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Steps to the criterion as a multiple of the primitives', a panel for each task and learner, fewest steps on top.

    Where some agent never met the criterion the mark is hollow: the ratio is a lower bound.

    Args:
        summaries: Of `summary.summarise`, by task and learner.
        means: Of `summary.over_tasks`, a panel of its own for each learner with several tasks.
    """
    learners = list(dict.fromkeys(learner for of in summaries.values() for learner in of))
    panels = {
        learner: ({ALL_TASKS: means[learner]} if learner in means and len(summaries) > 1 else {})
        | {task: of[learner] for task, of in summaries.items() if learner in of}
        for learner in learners
    }
    in_order = [
        *(e for of in means.values() for e in of),
        *(e for by in panels.values() for of in by.values() for e in of),
    ]
    entrants = [entrant for entrant in dict.fromkeys(in_order) if entrant != NONE]
    n_columns = min(COLUMNS, max(map(len, panels.values())))
    n_rows = {learner: -(-len(of) // n_columns) for learner, of in panels.items()}
    height = (0.7 + PANEL[1] * len(entrants)) * sum(n_rows.values())
    figure = Figure(figsize=(1.6 + PANEL[0] * n_columns, 0.6 + height), layout="constrained")
    grid = figure.subplots(sum(n_rows.values()), n_columns, squeeze=False, sharex=True, sharey=True)
    first = 0
    for learner, of in panels.items():
        places = grid[first : first + n_rows[learner]].ravel()
        for axes, (title, summary) in zip(places, of.items(), strict=False):
            _panel(axes, summary, entrants)
            axes.set_title(f"{title}, {learner}", fontsize=9, fontweight="bold" if title == ALL_TASKS else None)
        for axes in places[len(of) :]:
            axes.set_axis_off()
        first += n_rows[learner]
    for axes in grid[-1]:
        axes.set_xlabel("steps to the criterion / primitives'", fontsize=8)
    marks = dict(zip(*reversed(grid[0, 0].get_legend_handles_labels()), strict=True))
    if marks:
        figure.legend(marks.values(), marks.keys(), loc="outside lower center", ncols=len(marks), fontsize=8)
    return figure


def _panel(axes: Axes, of: Mapping[str, Any], entrants: list[str]) -> None:
    for phase, (colour, marker, offset, label) in STYLES.items():
        for row, entrant in enumerate(entrants):
            ratio = of[entrant][phase]["of_primitives"] if entrant in of else None
            if ratio is not None:
                face = "white" if of[entrant][phase]["never"] else colour
                axes.plot(ratio["mean"], row + offset, marker, color=colour, markersize=4, markerfacecolor=face)
                axes.plot([], [], marker, color=colour, markersize=4, label=label)  # what the legend shows is full
                axes.hlines(row + offset, ratio["low"], ratio["high"], color=colour, linewidth=1.2)
    axes.axvline(1.0, color="0.6", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_xticks(TICKS)
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_yticks(range(len(entrants)), entrants, fontsize=8)
    axes.set_ylim(max(len(entrants), 1) - 0.5, -0.5)
    axes.grid(axis="x", alpha=0.25)
