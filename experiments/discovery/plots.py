"""The picture of the study."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.common.gridworlds import add_colour_bar, counts_of, draw_counts
from experiments.common.seeds import Result
from experiments.discovery.summary import EARLY
from sb3_options.envs import GridWorld


def draw(results: list[Result]) -> Figure:
    """Where the first subgoals fell on the map, and when."""
    world = GridWorld()
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    where, when = figure.subplots(1, 2, width_ratios=(2, 1))
    found = [r for r in results if r["subgoal"] is not None]
    counts = counts_of(world, [r["subgoal"] for r in found])
    shown = draw_counts(where, world, counts, int(counts.max()))
    add_colour_bar(shown, where, "runs")
    where.set_title(f"first subgoal of {len(found)} of {len(results)} runs (doorway framed)")
    when.hist([r["episode"] for r in found], bins=range(0, EARLY + 5, 4), color="#4292c6", edgecolor="white")
    when.axvline(EARLY, color="#d62728", linewidth=1)
    when.set_xlabel("episode of the first option")
    when.set_ylabel("runs")
    when.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    return figure
