"""What a figure of matplotlib draws, as text: to be compared with a text that somebody looked at.

Nothing in it depends on fonts or on the backend, and numbers have three digits after the point.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.quiver import Quiver
from matplotlib.text import Text


def described(figure: Figure) -> str:
    """All axes, artists and legends of a figure, a line each."""
    layout = type(figure.get_layout_engine()).__name__
    lines = [f"figure {_numbers(figure.get_size_inches())} in, {figure.dpi:g} dpi, {layout}"]
    title = getattr(figure, "_suptitle", None)
    if title is not None:
        lines.append(_text(title))
    for axes in figure.axes:
        lines += ["", *(_axes(axes) if not hasattr(axes, "_colorbar") else _bar(axes))]
    for legend in figure.legends:
        lines += ["", *_legend(legend)]
    return "\n".join(lines) + "\n"


def _numbers(values: npt.ArrayLike) -> str:
    """One row of numbers after another; zero has no sign."""
    rows = np.round(np.atleast_2d(np.asarray(values, dtype=np.float64)), 3) + 0.0
    return "; ".join(" ".join(f"{x:g}" for x in row) for row in rows)


def _colours(colours: Any) -> str:
    distinct = dict.fromkeys(to_hex(c, keep_alpha=True) for c in colours)
    return " ".join(distinct) or "none"


def _text(text: Text) -> str:
    where = _numbers(text.get_position()), text.get_horizontalalignment(), text.get_verticalalignment()
    return f"text {text.get_text()!r} at {' '.join(where)}, {text.get_fontsize():g} pt"


def _ticks(axis: Axis) -> str:
    return f"{axis.label.get_text()!r} ticks {_numbers(axis.get_majorticklocs())}"


def _axes(axes: Axes) -> Iterator[str]:
    place = axes.get_subplotspec()
    assert place is not None
    shown = "" if axes.axison else ", without axes"
    yield f"axes {place.get_geometry()} {axes.get_title()!r}, aspect {axes.get_aspect()}{shown}"
    yield f"  x {_numbers(axes.get_xlim())} {_ticks(axes.xaxis)}"
    yield f"  y {_numbers(axes.get_ylim())} {_ticks(axes.yaxis)}"
    artists: list[Any] = [*axes.collections, *axes.lines, *axes.texts]
    for artist in artists:
        seen = f"z {artist.get_zorder():g}, alpha {artist.get_alpha()}"
        yield f"  {_text(artist) if isinstance(artist, Text) else _artist(artist)}, {seen}"


def _artist(artist: Any) -> str:
    if isinstance(artist, Line2D):
        face, edge = _colours([artist.get_markerfacecolor()]), _colours([artist.get_markeredgecolor()])
        return (
            f"line {artist.get_label()!r} {artist.get_linestyle()} {_numbers(artist.get_xydata())}, "
            f"marker {artist.get_marker()} {artist.get_markersize():g} {face} in {edge}"
        )
    look = f"{_colours(artist.get_facecolor())} in {_colours(artist.get_edgecolor())}"
    if isinstance(artist, Quiver):
        arrows = np.column_stack([artist.get_offsets(), artist.U, artist.V])
        how = f"{artist.angles} {artist.scale_units} {artist.scale:g} width {artist.width:g}"
        return f"arrows {_numbers(arrows)}, {how}, {look}"
    boxes = [path.get_extents().get_points().ravel() for path in artist.get_paths()]
    values = artist.get_array()
    coloured = look if values is None else f"{artist.get_cmap().name} of {_numbers(values)}"
    return f"{type(artist).__name__} {_numbers(boxes)}, {coloured}, width {_numbers(artist.get_linewidth())}"


def _bar(axes: Axes) -> Iterator[str]:
    bar: Any = axes._colorbar  # type: ignore[attr-defined]  # set by matplotlib
    beside = [each.get_title() for each in axes.figure.axes if bar.mappable in each.collections]
    limits = _numbers([bar.vmin, bar.vmax])
    yield f"colour bar of {beside}, {bar.mappable.get_cmap().name} {limits} {_ticks(axes.yaxis)}"


def _legend(legend: Legend) -> Iterator[str]:
    where = getattr(legend, "_outside_loc", None), legend._loc  # type: ignore[attr-defined]  # given as loc
    yield f"legend {where}, {legend._ncols} columns, title {legend.get_title().get_text()!r}"  # type: ignore[attr-defined]
    yield from (f"  {text.get_text()!r} {text.get_fontsize():g} pt" for text in legend.get_texts())
