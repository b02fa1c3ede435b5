"""The robot's pictures."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.common.curves import curve_interval, curves_of, draw_band
from experiments.common.seeds import Result
from experiments.pioneer.settings import TASKS
from experiments.pioneer.summary import DEAD_AHEAD, NEAR, Groups
from sb3_options.envs.pioneer.env import Pioneer
from sb3_options.envs.pioneer.senses import FIELD_OF_VIEW, MAX_WIDTH
from sb3_options.experience.observations import FloatArray

RED, BLUE, GREY = "#d62728", "#1f77b4", "0.75"
TRIALS_PER_POINT = 5
"""Curves show means of this many trials, because lengths of single ones vary with where the ball lies."""

N_POINTS = 200
"""Along the x-axis, where trials do not set them."""

SCENE: dict[str, Any] = {"robot": (-0.9, -0.5, 0.35), "balls": [(0.5, 0.25)]}
TITLES = {"corner": "one marked corner", "clutter": "obstacles", "two_balls": "two balls"}


def draw(figure: str, groups: Groups) -> Figure:
    """The picture of one figure."""
    return {"figure7": _figure7, "figure8": _figure8, "learning": _learning, "transfer": _transfer, "dqn": _dqn}[
        figure
    ](groups)


def _figure7(groups: Groups) -> Figure:
    """The robot, its sonar beams, its vision cone, and below it the retina."""
    env = Pioneer(render_mode="rgb_array")
    env.reset(seed=0, options=SCENE)
    picture = env.render()
    env.close()
    figure = Figure(figsize=(4.8, 5.44))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(np.asarray(picture))
    axes.set_axis_off()
    return figure


def _figure8(groups: Groups) -> Figure:
    """How often each displacement and each width occurs in a subgoal, as in the paper; and the two together."""
    options = [r["option"] for r in groups["learning"] if r["option"]["width"] is not None]
    displacement, width = (np.degrees([o[key] for o in options]) for key in ("displacement", "width"))
    half, widest = math.degrees(FIELD_OF_VIEW / 2), math.degrees(MAX_WIDTH)
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    panels = figure.subplots(1, 3)
    panels[0].axvspan(-math.degrees(DEAD_AHEAD), math.degrees(DEAD_AHEAD), color=GREY, alpha=0.4, linewidth=0)
    panels[0].hist(displacement, bins=np.linspace(-half, half, 29).tolist(), color=BLUE)
    panels[0].set_xlabel("displacement of the ball, degrees (positive: left)")
    panels[0].set_ylabel("subgoals")
    panels[1].axvspan(math.degrees(NEAR), widest, color=GREY, alpha=0.4, linewidth=0)
    panels[1].hist(width, bins=np.linspace(0, widest, 25).tolist(), color=BLUE)
    panels[1].set_xlabel("width of the ball, degrees")
    panels[1].set_ylabel("subgoals")
    panels[2].scatter(displacement, width, color=BLUE, alpha=0.5)
    panels[2].set_xlim(-half, half)
    panels[2].set_ylim(0, widest * 1.05)
    panels[2].set_xlabel("displacement, degrees")
    panels[2].set_ylabel("width, degrees")
    figure.suptitle(
        f"subgoals of {len(options)} of {len(groups['learning'])} runs; grey: dead ahead, near", fontsize=10
    )
    return figure


def _learning(groups: Groups) -> Figure:
    figure = Figure(figsize=(11, 4), layout="constrained")
    runs = groups["learning"]
    for axes, column, label in zip(
        figure.subplots(1, 2), ("steps", "returns"), ("primitive steps", "return"), strict=True
    ):
        _curve(axes, [r["primitive"] for r in runs], column, RED, "primitives only")
        _curve(axes, [r["discovery"] for r in runs], column, BLUE, "with subgoal discovery")
        _label(axes, label, logarithmic=column == "steps")
    figure.suptitle(f"mean of {len(runs)} runs, 95 % intervals", fontsize=10)
    return figure


def _transfer(groups: Groups) -> Figure:
    figure = Figure(figsize=(13, 4), layout="constrained")
    runs = groups["transfer"]
    for axes, task in zip(figure.subplots(1, len(TASKS)), TASKS, strict=True):
        _curve(axes, [r[task]["primitive"] for r in runs], "steps", RED, "primitives only")
        _curve(axes, [r[task]["option"] for r in runs], "steps", BLUE, "earlier option and primitives")
        _label(axes, "primitive steps", logarithmic=True)
        axes.set_title(TITLES[task], fontsize=10)
    figure.suptitle(f"mean of {len(runs)} runs, 95 % intervals", fontsize=10)
    return figure


def _dqn(groups: Groups) -> Figure:
    """Trials done by then: a straight line up is a robot that does its work, the steeper the faster."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes, runs = figure.subplots(), groups["dqn"]
    for name, colour, label in (("primitive", RED, "DQN"), ("discovery", BLUE, "DQN with subgoal discovery")):
        ends = [np.cumsum(r[name]["steps"]) for r in runs]
        steps = np.linspace(0, min(e[-1] for e in ends), N_POINTS)
        done = np.array([np.searchsorted(e, steps, side="right") for e in ends], dtype=np.float64)
        draw_band(axes, steps, curve_interval(done), colour, label)
    axes.set_xlabel("primitive steps")
    axes.set_ylabel("trials done")
    axes.set_title(f"mean of {len(runs)} runs, 95 % intervals", fontsize=10)
    axes.legend(fontsize=8, frameon=False)
    return figure


def _curve(axes: Axes, results: list[Result], column: str, colour: str, label: str) -> None:
    smooth = _smooth(curves_of(results, column))
    draw_band(axes, (np.arange(smooth.shape[1]) + 0.5) * TRIALS_PER_POINT, curve_interval(smooth), colour, label)


def _smooth(curves: FloatArray) -> FloatArray:
    """Means of blocks of trials, (runs, trials) → (runs, blocks)."""
    n = max(curves.shape[1] // TRIALS_PER_POINT, 1)
    size = min(TRIALS_PER_POINT, curves.shape[1])
    means: FloatArray = curves[:, : n * size].reshape(len(curves), n, size).mean(axis=2)
    return means


def _label(axes: Axes, label: str, *, logarithmic: bool) -> None:
    if logarithmic:
        axes.set_yscale("log")
    axes.set_xlabel("trial")
    axes.set_ylabel(label)
    axes.legend(fontsize=8, frameon=False)
