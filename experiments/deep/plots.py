"""Pictures of the study."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.common.curves import draw_band
from experiments.common.seeds import Result
from experiments.deep.summary import GRID, curve, curve_at
from sb3_options.runs.intervals import band

COLOURS = {
    "options": "#d62728",
    "options-n-step": "#8c1515",
    "options-bonus": "#ff7f0e",
    "stock": "0.45",
    "carried": "#2ca02c",
    "n-step": "black",
    "count-bonus": "#9467bd",
    "rnd": "#17becf",
    "repeats": "#1f77b4",
}
"""In the order of the legend."""

LABELS = {
    "stock": "stock",
    "carried": "stock, network carried over",
    "n-step": "stock, n-step returns",
    "count-bonus": "stock, count bonus",
    "rnd": "stock, RND",
    "options": "discovered options",
    "options-n-step": "options, n-step returns",
    "options-bonus": "options, count bonus",
    "repeats": "random repeats",
}
N_SECONDS = 200
MOST_INSIDE = 3
"""A legend of more arms stands below the panels."""


def draw(task: str, runs: dict[tuple[str, str], dict[str, Sequence[Result]]], lengths: dict[str, int]) -> Figure:
    """Success rate over primitive steps, one panel for each environment and algorithm.

    Args:
        task: For the title.
        runs: Environment and algorithm → arm → results.
        lengths: Longest training by environment.
    """

    def arm_in(axes: Axes, env: str, arm: str, results: Sequence[Result]) -> None:
        at = np.arange(0, lengths[env] + 1, GRID)
        curves = band(np.array([curve(r, lengths[env]) for r in results]))
        draw_band(axes, at, curves, COLOURS[arm], f"{LABELS[arm]} ({len(results)} runs)")

    return _panels(task, runs, "primitive steps", arm_in)


def draw_seconds(task: str, runs: dict[tuple[str, str], dict[str, Sequence[Result]]]) -> Figure:
    """The same over seconds of training, the evaluations left out; runs shared the machine with each other.

    Args:
        task: For the title.
        runs: As for `draw`.
    """

    def arm_in(axes: Axes, env: str, arm: str, results: Sequence[Result]) -> None:
        del env
        timed = [r for r in results if "seconds" in r]  # kept by an earlier version without
        if timed:
            at = np.linspace(0.0, max(r["seconds"][-1] for r in timed), N_SECONDS)
            curves = band(np.array([curve_at(r["seconds"], r["success"], at) for r in timed]))
            draw_band(axes, at, curves, COLOURS[arm], f"{LABELS[arm]} ({len(timed)} runs)")

    return _panels(task, runs, "seconds of training", arm_in)


def _panels(
    task: str,
    runs: dict[tuple[str, str], dict[str, Sequence[Result]]],
    over: str,
    arm_in: Callable[[Axes, str, str, Sequence[Result]], None],
) -> Figure:
    """One panel for each environment and algorithm, in which ``arm_in`` draws every arm that has results."""
    environments = list(dict.fromkeys(env for env, _ in runs))
    algorithms = list(dict.fromkeys(algo for _, algo in runs))
    size = (4.6 * len(environments), 3.1 * len(algorithms))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(algorithms), len(environments), squeeze=False, sharey=True)
    for row, algo in zip(panels, algorithms, strict=True):
        for axes, env in zip(row, environments, strict=True):
            of_panel = runs.get((env, algo), {})
            for arm in COLOURS:
                if of_panel.get(arm):
                    arm_in(axes, env, arm, of_panel[arm])
            axes.set_title(f"{algo.upper()}, {env}, {task}")
            axes.set_ylim(-0.03, 1.03)
            axes.grid(alpha=0.25)
    for axes in panels[-1]:
        axes.set_xlabel(over)
    for axes in panels[:, 0]:
        axes.set_ylabel("success rate")
    shown = {label: line for axes in panels.flat for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if len(shown) > MOST_INSIDE:
        figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=3, fontsize=8)
    else:
        panels[0, 0].legend(loc="lower right", fontsize=8)
    return figure
