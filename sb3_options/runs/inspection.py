"""What is in an options file: a table and a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_options.density.regions import HalfSpace
from sb3_options.discovery.maps import INITIATION_COLOUR, SUBGOAL
from sb3_options.discovery.settings import described
from sb3_options.experience.observations import FloatArray
from sb3_options.options import file as option_file
from sb3_options.options.archive import NAME
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from sb3_options.runs.pictures import save_picture

COLUMNS = 2
PANEL = (4.6, 3.4)
"""Inches."""


@dataclass(frozen=True)
class InspectConfig:
    """Show the options of a run folder, an options file or a model.zip, without loading the model.

    Attributes:
        file: Which.
        out: A picture of subgoals and initiation sets.
    """

    file: Annotated[Path, tyro.conf.Positional]
    out: Path | None = None


def show_options(config: InspectConfig, *, console: Console) -> None:
    """Print what is in an options file, and draw it.

    Args:
        config: Which.
        console: For the table.

    Raises:
        ValueError: It is damaged, or something else.
        OSError: There is none, or the picture cannot be written.
    """
    contents = contents_of(config.file)
    console.print(table_of(contents))
    console.print(*map(escape, summary_of(contents)), sep="\n")
    if config.out is not None:
        save_picture(picture_of(contents), config.out)
        console.print(f"Picture: {escape(str(config.out))}")


class Contents(NamedTuple):
    """What an options file says.

    Attributes:
        options: By slot; a hand-made one is a name only.
        max_options: Slots of the bank.
        n_primitive: Actions of the environment.
        observations: The space that policies act on, in words; None in files of early versions.
        features: Where φ comes from (`features.FeatureKind`); None where that is not said.
        digest: SHA-256 of the content.
    """

    options: dict[int, SubgoalOption | str]
    max_options: int
    n_primitive: int
    observations: str | None
    features: str | None
    digest: str


def contents_of(path: Path) -> Contents:
    """Read a run folder, an options file or a ``model.zip``; nothing is unpickled.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, or something else.
    """
    file = option_file.opened(path / NAME if path.is_dir() else path)
    space, features = (file.made_for.space, file.made_for.features) if file.made_for else (None, None)
    options: dict[int, SubgoalOption | str] = {**file.hand_made, **file.options()}
    return Contents(dict(sorted(options.items())), file.max_options, file.n_primitive, space, features, file.digest)


def subgoal_of(option: SubgoalOption, features: str | None) -> str:
    """Its subgoal for people."""
    if not len(option.subgoal.points):
        return "none"
    place = described(option.subgoal.points[0], features, option.subgoal.group)
    return f"beyond the plane through {place}" if isinstance(option.subgoal, HalfSpace) else place


def table_of(contents: Contents) -> Table:
    """A row for every option."""
    table = Table("slot", "name", "subgoal", "radius", "initiation set", "policy", "longest run")
    for slot, option in contents.options.items():
        if isinstance(option, str):
            table.add_row(str(slot), option, "by hand: code, not in the file", "", "", "", "")
            continue
        policy = option.option_policy
        kind = f"table of {len(policy.states):,} states" if isinstance(policy, TabularPolicy) else "network"
        table.add_row(
            str(slot),
            option.name,
            subgoal_of(option, contents.features),
            f"{option.subgoal.radius:g}",
            f"{len(option.initiation_set.points):,} states, radius {option.initiation_set.radius:g}",
            f"{kind} on the {'observation' if option.policy_input == 'observation' else 'features'}",
            f"{option.max_duration:,} steps",
        )
    return table


def summary_of(contents: Contents) -> list[str]:
    """What holds for all options, a line each."""
    return [
        f"{len(contents.options)} of {contents.max_options} slots are taken; "
        f"policies choose among {contents.n_primitive} primitive actions.",
        f"Made for observations {contents.observations or 'of a space that is not said'}.",
        f"SHA-256 {contents.digest}",
    ]


def picture_of(contents: Contents) -> Figure:
    """A panel for each discovered option: its initiation set and its subgoal, in the first two features that count.

    Of a group of features with labels, these are the first two that have one.
    """
    options = {slot: o for slot, o in contents.options.items() if isinstance(o, SubgoalOption)}
    columns = min(COLUMNS, max(1, len(options)))
    rows = max(1, -(-len(options) // columns))
    figure = Figure(figsize=(PANEL[0] * columns, PANEL[1] * rows), layout="constrained")
    if not options:
        axes = figure.add_subplot()
        axes.set_axis_off()
        axes.text(0.5, 0.5, "No discovered options.", ha="center", va="center")
    for number, (slot, option) in enumerate(options.items(), start=1):
        _draw(figure.add_subplot(rows, columns, number), slot, option, contents.features)
    return figure


def _draw(axes: Axes, slot: int, option: SubgoalOption, features: str | None) -> None:
    group = option.subgoal.group
    if features == "categorical" and group is None:
        names = ["number of the state", ""]
        initiation, subgoal = (
            _on_a_line(p.argmax(axis=1)) for p in (option.initiation_set.points, option.subgoal.points)
        )
        side = np.ones(2)
    else:
        numbers = range(option.subgoal.points.shape[1]) if group is None else group.features
        labels = [] if group is None else list(group.labels)
        columns = [i for i, label in enumerate(labels) if label][:2] or [0, 1][: len(numbers)]
        names = [labels[i] if any(labels) else f"feature {numbers[i] + 1}" for i in columns] + [""]
        initiation, subgoal = (_plane(p[:, columns]) for p in (option.initiation_set.points, option.subgoal.points))
        side = np.ones(2)
        if len(columns) > 1:
            side = 1.0 / _plane(np.maximum(option.subgoal.scale[columns], 1e-9)[None])[0]
    squares = [Rectangle((float(x), float(y)), *map(float, side)) for x, y in initiation - side / 2]
    axes.add_collection(PatchCollection(squares, facecolor=INITIATION_COLOUR, edgecolor="white"))
    axes.plot(*subgoal.T, linestyle="", **SUBGOAL)
    everything = np.concatenate([initiation, subgoal])
    low, high = everything.min(axis=0) - 1.5 * side, everything.max(axis=0) + 1.5 * side
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), xlabel=names[0], ylabel=names[1])
    axes.set_title(f"slot {slot}: {subgoal_of(option, features)}", fontsize=10)
    for axis in (axes.xaxis, axes.yaxis):
        if np.array_equal(everything, np.round(everything)):
            axis.set_major_locator(MaxNLocator(integer=True))
    if np.ptp(everything[:, 1]) == 0 and not names[1]:
        axes.set_yticks([])


def _plane(points: FloatArray) -> FloatArray:
    """The first two numbers of each point, (n, 2); 0 for the second where there is one only."""
    return np.column_stack([points[:, 0], points[:, 1] if points.shape[1] > 1 else np.zeros(len(points))])


def _on_a_line(numbers: Any) -> FloatArray:
    return np.column_stack([numbers, np.zeros(len(numbers))]).astype(np.float64)
