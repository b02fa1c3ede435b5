"""Pictures that a user asks for: their files, and the one of options."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from sb3_options.atomic import atomic_write
from sb3_options.discovery.figures import INITIATION_COLOUR, SUBGOAL
from sb3_options.experience.observations import FloatArray
from sb3_options.options.option import SubgoalOption
from sb3_options.runs.users_code import named_in_errors

DPI = 110
COLUMNS = 2
PANEL = (4.6, 3.4)
"""Inches."""


def format_of(picture: Path) -> str:
    """The format that a picture's name asks for."""
    name = picture.suffix.removeprefix(".").lower()
    if name not in FigureCanvasAgg.get_supported_filetypes():
        raise ValueError(f"--out {picture}: choose a name that ends with .png, .pdf or .svg.")
    return name


def save_picture(figure: Figure, picture: Path) -> None:
    """Write the picture that ``--out`` names, in the format that its name asks for."""
    with named_in_errors("--out", picture, "cannot be written"), atomic_write(picture) as temporary:
        figure.savefig(temporary, dpi=DPI, format=format_of(picture))


def options_picture(options: Mapping[int, SubgoalOption | str], titles: Mapping[int, str], features: str | None) -> Any:
    """A panel for each discovered option: its initiation set and its subgoal, in the first two features that count."""
    drawn = {slot: option for slot, option in options.items() if isinstance(option, SubgoalOption)}
    columns = min(COLUMNS, max(1, len(drawn)))
    rows = max(1, -(-len(drawn) // columns))
    figure = Figure(figsize=(PANEL[0] * columns, PANEL[1] * rows), layout="constrained")
    if not drawn:
        axes = figure.add_subplot()
        axes.set_axis_off()
        axes.text(0.5, 0.5, "No discovered options.", ha="center", va="center")
    for number, (slot, option) in enumerate(drawn.items(), start=1):
        axes = figure.add_subplot(rows, columns, number)
        _draw(axes, option, features)
        axes.set_title(f"slot {slot}: {titles[slot]}", fontsize=10)
    return figure


def _draw(axes: Axes, option: SubgoalOption, features: str | None) -> None:
    group = option.subgoal.group
    side = np.ones(2)
    if features == "categorical" and group is None:
        names = ["number of the state", ""]
        initiation, subgoal = (
            _plane(p.argmax(axis=1)[:, None]) for p in (option.initiation_set.points, option.subgoal.points)
        )
    else:
        numbers = range(option.subgoal.points.shape[1]) if group is None else group.features
        labels = [] if group is None else list(group.labels)
        columns = [i for i, label in enumerate(labels) if label][:2] or [0, 1][: len(numbers)]
        names = [labels[i] if any(labels) else f"feature {numbers[i] + 1}" for i in columns] + [""]
        initiation, subgoal = (_plane(p[:, columns]) for p in (option.initiation_set.points, option.subgoal.points))
        if len(columns) > 1:
            side = 1.0 / _plane(np.maximum(option.subgoal.scale[columns], 1e-9)[None])[0]
    squares = [Rectangle((float(x), float(y)), *map(float, side)) for x, y in initiation - side / 2]
    axes.add_collection(PatchCollection(squares, facecolor=INITIATION_COLOUR, edgecolor="white"))
    axes.plot(*subgoal.T, linestyle="", **SUBGOAL)
    everything = np.concatenate([initiation, subgoal])
    low = everything.min(axis=0) - 1.5 * side
    high = everything.max(axis=0) + 1.5 * side
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), xlabel=names[0], ylabel=names[1])
    for axis in (axes.xaxis, axes.yaxis):
        if np.array_equal(everything, np.round(everything)):
            axis.set_major_locator(MaxNLocator(integer=True))
    if np.ptp(everything[:, 1]) == 0 and not names[1]:
        axes.set_yticks([])


def _plane(points: Any) -> FloatArray:
    """The first two numbers of each point, (n, 2); 0 for the second where there is one only."""
    second = points[:, 1] if points.shape[1] > 1 else np.zeros(len(points))
    return np.column_stack([points[:, 0], second]).astype(np.float64)
