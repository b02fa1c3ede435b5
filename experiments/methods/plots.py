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
PANEL = (3.0, 0.24)
"""Width of a panel and height of a row, in inches."""


def draw(summaries: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> Figure:
    """Steps to the criterion as a multiple of the primitives', a panel for each task and learner.

    Where some agent never met the criterion the mark is hollow: the ratio is a lower bound.

    Args:
        summaries: Of `summary.summarise`, by task and learner.
    """
    tasks = list(summaries)
    learners = list(dict.fromkeys(learner for of in summaries.values() for learner in of))
    entrants = list(dict.fromkeys(e for of in summaries.values() for by in of.values() for e in by if e != NONE))
    size = (2.0 + PANEL[0] * len(tasks), 1.2 + (0.7 + PANEL[1] * len(entrants)) * len(learners))
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(learners), len(tasks), squeeze=False, sharex=True, sharey=True)
    for row, learner in zip(grid, learners, strict=True):
        for axes, task in zip(row, tasks, strict=True):
            _panel(axes, summaries[task].get(learner, {}), entrants)
            axes.set_title(f"{task}, {learner}", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("steps to the criterion / primitives'", fontsize=8)
    marks = dict(zip(*reversed(grid[0, 0].get_legend_handles_labels()), strict=True))
    if marks:
        figure.legend(marks.values(), marks.keys(), loc="outside lower center", ncols=len(marks), fontsize=8)
    return figure


def _panel(axes: Axes, of: Mapping[str, Mapping[str, Any]], entrants: list[str]) -> None:
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
