"""The picture of the study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import color_sequences
from matplotlib.figure import Figure

from experiments.common.seeds import Result
from experiments.minigrid.settings import EPISODES, FAMILIES
from experiments.minigrid.summary import run_frames

COLOURS = color_sequences["tab20"]


def draw(family: str, results: Mapping[str, Sequence[Result]]) -> Figure:
    """Training success by frames of all stages, a line a seed."""
    figure = Figure(figsize=(7.2, max(3.6, 0.18 * len(results))), layout="constrained")
    axes = figure.subplots()
    as_planned = all("frames" not in stage for runs in results.values() for run in runs for stage in run["stages"])
    for number, (name, runs) in enumerate(results.items()):
        colour, style = COLOURS[number % len(COLOURS)], "-" if number < len(COLOURS) else "--"
        for i, run in enumerate(runs):
            before = 0
            spent = run_frames(run, family, name)  # type: ignore[arg-type]  # the names are arms
            for took, noted in zip(spent, run["stages"], strict=True):
                frames = [before + at for at, _ in noted["curve"]]
                success = [rate for _, rate in noted["curve"]]
                label = name if i == 0 and before == 0 else None
                axes.plot(frames, success, color=colour, linestyle=style, linewidth=1.2, label=label)
                if not as_planned:
                    axes.plot(frames[:1], success[:1], ".", color=colour, markersize=8)
                before += took
    stages = FAMILIES[family]
    if as_planned:
        starts = np.cumsum([0, *(stage.frames for stage in stages)])
        for before, stage in zip(starts, stages, strict=False):
            axes.axvline(before, color="0.8", linewidth=0.8, zorder=0)
            axes.text(before, 1.03, f" {stage.env_id.removeprefix('MiniGrid-')}", fontsize=8)
    else:
        names = " → ".join(stage.env_id.removeprefix("MiniGrid-") for stage in stages)
        axes.set_title(f"{names}; a dot where a task begins", fontsize=8)
    axes.set_ylim(-0.02, 1.02)
    alone = "; “stock” spends all of them in the last task" if "stock" in results else ""
    axes.set_xlabel(f"primitive steps of all stages{alone}")
    axes.set_ylabel(f"success, last {EPISODES} episodes")
    axes.legend(fontsize=8)
    return figure
