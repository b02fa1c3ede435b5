"""The picture of the study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from experiments.common.gridworlds import add_colour_bar, counts_of, draw_counts, world_of
from experiments.common.seeds import Result


def draw(results: Mapping[str, Sequence[Result]]) -> Figure:
    """Where subgoals fell, a row for each task and a column for each space."""
    tasks, arms = (list(dict.fromkeys(name.split(": ")[i] for name in results)) for i in (0, 1))
    figure = Figure(figsize=(3.4 * len(arms), 2.4 * len(tasks)), layout="constrained")
    grid = figure.subplots(len(tasks), len(arms), squeeze=False)
    for row, task in zip(grid, tasks, strict=True):
        world = world_of(f"sb3_options/{task}-v0", observation="image")
        for axes, arm in zip(row, arms, strict=True):
            runs = results[f"{task}: {arm}"]
            counts = counts_of(world, [found["point"] for run in runs for found in _cells(run)])
            shown = draw_counts(axes, world, counts, len(runs))
            axes.set_title(f"{task}: {arm}", fontsize=8)
    add_colour_bar(shown, grid, "subgoals")
    return figure


def _cells(run: Result) -> list[dict[str, list[int]]]:
    return [{"point": [round(x) for x in found["point"][:2]]} for found in run["found"]]
