"""The picture of the study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from experiments.common.gridworlds import add_colour_bar, counts_of, draw_counts
from experiments.common.seeds import Result
from experiments.random_walks.conditions import TASKS, world_for


def draw(results: Mapping[str, Sequence[Result]]) -> Figure:
    """Where subgoals fell on the maps that are the same for every seed, a row for each of the arms."""
    tasks = [task for task in TASKS if task != "random maps"]
    arms = list(dict.fromkeys(name.split(": ")[1] for name in results))
    figure = Figure(figsize=(10.5, 2.1 * len(arms)), layout="constrained")
    grid = figure.subplots(len(arms), len(tasks), squeeze=False)
    for row, arm in zip(grid, arms, strict=True):
        for axes, task in zip(row, tasks, strict=True):
            world = world_for(task, 0)
            runs = results[f"{task}: {arm}"]
            points = [found["point"] for run in runs for found in run["found"]]
            counts = counts_of(world, [(round(x), round(y)) for x, y, *_ in points])
            shown = draw_counts(axes, world, counts, len(runs))
            axes.set_title(f"{task}: {arm}", fontsize=8)
    add_colour_bar(shown, grid, "subgoals")
    return figure
