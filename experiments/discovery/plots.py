"""The picture of the study."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from experiments.common.gridworlds import counts_of, frame_doorways
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
    colours = colormaps["viridis"].with_extremes(bad="0.25")
    image = where.imshow(np.where(world.walls, np.nan, counts), cmap=colours, vmin=0)
    figure.colorbar(image, ax=where, shrink=0.7, label="runs")
    frame_doorways(where, world)
    where.set_title(f"first subgoal of {len(found)} of {len(results)} runs (doorway framed)")
    when.hist([r["episode"] for r in found], bins=range(0, EARLY + 5, 4), color="#4292c6", edgecolor="white")
    when.axvline(EARLY, color="#d62728", linewidth=1)
    when.set_xlabel("episode of the first option")
    when.set_ylabel("runs")
    return figure
