"""One picture for each figure, from the results of all runs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.common.curves import curve_interval, curves_of, draw_band
from experiments.common.gridworlds import counts_of, frame_doorways
from experiments.common.seeds import Result
from sb3_options.envs import GridWorld
from sb3_options.experience.observations import FloatArray

Groups = Mapping[str, list[Result]]
"""The results of every run, by the group of conditions they belong to."""

COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#ff7f0e", "#8c564b")

SHORTEST = 10
"""Primitive steps: below every mean, where the band of one SD would only go on downwards."""

WALL_COLOUR = "#4a6fa5"

CURVES: dict[str, list[tuple[str, str, str]]] = {
    "figure3": [("learning", "primitive", "primitives only"), ("learning", "discovery", "with subgoal discovery")],
    "figure4": [
        ("learning", "primitive", "primitives only"),
        ("learning", "discovery", "with subgoal discovery"),
        ("controls", "replay_whole", "replay, whole space, equal backups"),
        ("controls", "replay_partial", "replay, input set, equal backups"),
        ("controls", "replay_whole_once", "replay, whole space, one sweep"),
        ("controls", "replay_partial_once", "replay, input set, one sweep"),
    ],
    "figure5": [("transfer", "primitive", "primitives only"), ("transfer", "options", "earlier option and primitives")],
    "figure6": [
        ("transfer", "primitive", "primitives only"),
        ("transfer", "options", "earlier option and primitives"),
        ("reuse", "whole", "earlier value function, whole"),
        ("reuse", "partial", "earlier value function, input set"),
    ],
    "controls": [
        ("learning", "primitive", "primitives only"),
        ("learning", "discovery", "discovered option"),
        ("controls", "handmade", "hand-made doorway option"),
        ("controls", "random", "option for a random subgoal"),
    ],
}
"""The curves of a figure: group, condition and legend."""

LAST_TRIAL = {"figure3": 300, "figure4": 100, "figure5": 100, "figure6": 50, "controls": 200}


def draw(figure: str, groups: Groups) -> Figure:
    """The picture of one figure."""
    if figure == "figure1":
        return _histograms(groups)
    if figure == "figure2":
        return _densities(groups)
    if figure == "negatives":
        return _negatives(groups)
    return _curves(figure, groups)


def _curves(name: str, groups: Groups) -> Figure:
    figure = Figure(figsize=(7.5, 4.5), layout="constrained")
    axes = figure.subplots()
    for (group, condition, label), colour in zip(CURVES[name], COLOURS, strict=False):
        curves = curves_of(groups[group], condition)[:, : LAST_TRIAL[name]]
        trials = np.arange(1, curves.shape[1] + 1)
        draw_band(axes, trials, curve_interval(curves), colour, label)
        if name == "figure3":
            mean, deviation = curves.mean(axis=0), curves.std(axis=0)
            axes.fill_between(trials, np.maximum(mean - deviation, 1), mean + deviation, color=colour, alpha=0.08)
    axes.set_yscale("log")
    axes.set_ylim(bottom=SHORTEST)
    axes.set_xlabel("trial")
    axes.set_ylabel("primitive steps to the goal")
    n = len(groups[CURVES[name][0][0]])
    band = "95 % intervals, ±1 SD pale" if name == "figure3" else "95 % intervals"
    axes.set_title(f"mean of {n} runs, {band}", fontsize=10)
    axes.legend(fontsize=8, frameon=False)
    return figure


def _histograms(groups: Groups) -> Figure:
    figure = Figure(figsize=(12, 3.2), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, kind in zip(panels, ("every", "first"), strict=True):
        counts = np.mean([r["visits"][kind] for r in groups["learning"]], axis=0)
        _map(figure, axes, counts, f"{kind}-visit counts, trials 30–40 of Q-learning")
    return figure


def _densities(groups: Groups) -> Figure:
    figure = Figure(figsize=(12, 6.2), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    runs = groups["learning"]
    _map(figure, panels[0], mean_map([r["log_density"] for r in runs]), "mean log diverse density after 25 trials")
    subgoals = {
        "subgoals found by diverse density": [r["option"]["subgoal"] for r in runs],
        "baseline: most first visits": [r["baselines"]["first"]["subgoal"] for r in runs],
        "baseline: most visits": [r["baselines"]["every"]["subgoal"] for r in runs],
    }
    for axes, (title, cells) in zip(panels[1:], subgoals.items(), strict=True):
        _map(figure, axes, counts_of(GridWorld(), cells), f"{title} ({sum(c is not None for c in cells)} runs)")
    return figure


def _negatives(groups: Groups) -> Figure:
    figure = Figure(figsize=(12, 9.2), layout="constrained")
    panels = figure.subplots(3, 2)
    limited, noisy = groups["negatives"], [r["noisy"] for r in groups["learning"]]
    for column, strength in enumerate(("strict", "soft")):
        words = "η = 1" if strength == "strict" else "η = 0.1"
        density = mean_map([r[strength]["log_density"] for r in limited])
        _map(figure, panels[0, column], density, f"step limit: mean log diverse density, {words}")
        cells = [r[strength]["subgoal"] for r in limited]
        found = sum(c is not None for c in cells)
        _map(figure, panels[1, column], counts_of(GridWorld(), cells), f"step limit: subgoals ({found} runs), {words}")
        cells = [r[strength]["subgoal"] for r in noisy]
        found = sum(c is not None for c in cells)
        _map(figure, panels[2, column], counts_of(GridWorld(), cells), f"noisy bags: subgoals ({found} runs), {words}")
    return figure


def mean_map(maps: list[list[list[float | None]] | None]) -> npt.NDArray[np.float64] | None:
    """Mean over the runs that have one; None if none has."""
    there = [np.array(m, dtype=np.float64) for m in maps if m is not None]
    return np.mean(there, axis=0) if there else None


def _map(figure: Figure, axes: Axes, values: FloatArray | None, title: str) -> None:
    """Lighter is more, as in the paper; the doorway is framed."""
    world = GridWorld()
    shown = np.full(world.walls.shape, np.nan) if values is None else np.where(world.walls, np.nan, values)
    image = axes.imshow(shown, cmap=colormaps["gray"].with_extremes(bad=WALL_COLOUR))
    if values is not None:
        figure.colorbar(image, ax=axes, shrink=0.7)
    frame_doorways(axes, world)
    axes.text(*world.goal, "G", color="#d62728", ha="center", va="center", fontsize=8)
    axes.set_title(title, fontsize=10)
    axes.set_xticks([])
    axes.set_yticks([])
