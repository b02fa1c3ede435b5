"""``python -m docs.architecture``: draws the folders of the library and their imports into docs/images.

Names, modules, captions (the first sentence of a folder's ``__init__``) and imports are read from the code. Only the
places of the folders are written here. An import that a path of arrows implies is named in the box of the folder that
imports, and has no arrow of its own. The picture carries its content as text, so that a test can compare it with the
code.
"""

from __future__ import annotations

import ast
import json
import re
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import grimp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Polygon
from PIL import Image

ROOT = Path(__file__).parents[1]
PACKAGE = "sb3_options"
PICTURE = ROOT / "docs" / "images" / "architecture.png"
KEY = "Description"
"""Name of the picture's text chunk that holds its content."""

DPI = 110
WIDTH, HEIGHT = 120.0, 127.0
"""Of the picture, tenths of an inch. All places are given in this unit."""

COLUMNS = (20.5, 60.0, 99.5)
"""Middles of the boxes, from the left."""

FLOORS = (118.0, 106.5, 77.5, 53.0, 28.5, 9.5)
"""Middles of the boxes, from the top."""

BOX = 35.0
"""Width of a box."""

LINE = 1.9
"""Height of a line of text."""

PAD = 1.5
"""Between a box and its text."""

CHARACTERS = 42
"""Of the monospaced face in a line of a box."""

INK, GREY, ARROW = "#1f2933", "#5f6c7b", "#52606d"
BLUE, GREEN, SAND = "#e3ecfa", "#def0e2", "#f5efdf"


class Place(NamedTuple):
    """Column and floor of a folder, and the colour of its box."""

    column: int
    floor: int
    colour: str


DOORS = ("cli", "zoo")
PLACES = {
    "entry points": Place(2, 0, SAND),
    "callbacks": Place(0, 1, BLUE),
    "runs": Place(1, 1, BLUE),
    "envs": Place(2, 1, SAND),
    "checkpoints": Place(0, 2, BLUE),
    "discovery": Place(1, 2, GREEN),
    "learning": Place(0, 3, BLUE),
    "execution": Place(0, 4, BLUE),
    "options": Place(1, 4, GREEN),
    "density": Place(2, 4, GREEN),
    "experience": Place(0, 5, GREEN),
    "embedding": Place(1, 5, GREEN),
}
"""What acts in an environment stands on the left, what is computed from trajectories in the middle. So placed that no
arrow runs behind a box."""

PURE = [(1.0, 1.5), (119.0, 1.5), (119.0, 90.5), (40.25, 90.5), (40.25, 17.2), (1.0, 17.2)]
"""Corners of the area of the folders that import neither Gymnasium nor Stable-Baselines3."""


class Architecture(NamedTuple):
    """What the picture shows.

    Attributes:
        modules: Of each folder.
        captions: What each folder is for.
        imports: Importing folder → imported folders.
    """

    modules: dict[str, list[str]]
    captions: dict[str, str]
    imports: dict[str, list[str]]

    def text(self) -> str:
        """What the picture carries with it."""
        return json.dumps(self._asdict(), sort_keys=True)

    def implied(self, above: str) -> list[str]:
        """The imports of a folder that those of its other imports imply."""
        return [name for name in self.imports[above] if any(name in self._below(b) for b in self.imports[above])]

    def _below(self, name: str) -> set[str]:
        return {deeper for below in self.imports[name] for deeper in (below, *self._below(below))}


def read() -> Architecture:
    """The folders and their imports, from the code."""
    graph = grimp.build_graph(PACKAGE, cache_dir=None)
    inside = {name: graph.find_descendants(f"{PACKAGE}.{name}") for name in _names(graph.find_children(PACKAGE))}
    folders = [name for name, modules in inside.items() if modules]

    def imports(folder: str) -> list[str]:
        imported = set().union(*(graph.find_modules_directly_imported_by(module) for module in inside[folder]))
        return [name for name in folders if name != folder and inside[name] & imported]

    return Architecture(
        modules={name: _names(graph.find_children(f"{PACKAGE}.{name}")) for name in folders},
        captions={name: _caption(ROOT / PACKAGE / name / "__init__.py") for name in folders},
        imports={name: imports(name) for name in folders},
    )


def _names(modules: Iterable[str]) -> list[str]:
    return sorted(module.rpartition(".")[2] for module in modules)


def _caption(file: Path) -> str:
    """The first sentence of a module's docstring, to its first colon or semicolon."""
    first = (ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or "").split("\n\n")[0]
    return re.split(r"[:;]|\.(?=\s|$)", " ".join(first.split()))[0]


def draw(content: Architecture) -> Figure:
    """The picture.

    Raises:
        ValueError: A folder has no place.
    """
    homeless = set(content.modules) - set(PLACES)
    if homeless:
        raise ValueError(f"PLACES must say where {sorted(homeless)} stand: add their column and floor.")
    figure = Figure(figsize=(WIDTH / 10, HEIGHT / 10), facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, WIDTH), ylim=(0, HEIGHT))
    axes.set_axis_off()
    axes.add_patch(Polygon(PURE, facecolor="#f4faf5", edgecolor="#8fbf9a", linestyle=(0, (4, 3)), zorder=0))
    label: dict[str, Any] = {"fontsize": 10, "style": "italic"}
    axes.text(82.0, 87.2, "pure: numpy, scipy and torch", color="#3d7a4b", **label)
    axes.text(2.6, HEIGHT - 4.5, "on Gymnasium and Stable-Baselines3", color="#4a6fa5", **label)
    _box(axes, "entry points", f"import {PACKAGE}", DOORS, [])
    boxes = {
        name: _box(axes, name, content.captions[name], modules, content.implied(name))
        for name, modules in content.modules.items()
    }
    for above, imported in content.imports.items():
        for below in imported:
            if below not in content.implied(above):
                arrow = FancyArrowPatch(
                    _middle(above),
                    _middle(below),
                    patchA=boxes[above],
                    patchB=boxes[below],
                    arrowstyle="-|>,head_length=0.6,head_width=0.28",
                    mutation_scale=14,
                    linewidth=2.0,
                    color=ARROW,
                    zorder=1,
                )
                axes.add_patch(arrow)
    return figure


def _middle(name: str) -> tuple[float, float]:
    return COLUMNS[PLACES[name].column], FLOORS[PLACES[name].floor]


def _box(axes: Axes, name: str, caption: str, modules: Iterable[str], also: list[str]) -> FancyBboxPatch:
    """Draw a folder."""
    styles: dict[str, dict[str, Any]] = {
        "name": {"fontsize": 13.5, "weight": "bold", "color": INK},
        "caption": {"fontsize": 9.3, "style": "italic", "color": INK},
        "modules": {"fontsize": 8.6, "family": "monospace", "color": GREY},
        "also": {"fontsize": 8.8, "color": GREY},
    }
    lines = [("name", name)]
    lines += [("caption", line) for line in textwrap.wrap(caption, CHARACTERS)]
    lines += [("modules", line) for line in textwrap.wrap("  ".join(modules), CHARACTERS, break_long_words=False)]
    lines += [
        ("also", line) for line in textwrap.wrap(f"also imports {', '.join(also)}" if also else "", CHARACTERS + 8)
    ]
    height = LINE * (len(lines) + 0.5) + 2 * PAD
    x, y = _middle(name)
    box = FancyBboxPatch(
        (x - BOX / 2, y - height / 2),
        BOX,
        height,
        boxstyle="round,pad=0,rounding_size=1.2",
        facecolor=PLACES[name].colour,
        edgecolor=GREY,
        linewidth=1.0,
        zorder=2,
    )
    axes.add_patch(box)
    y += height / 2 - PAD
    for kind, text in lines:
        y -= LINE * (1.5 if kind == "name" else 1.0)
        axes.text(x - BOX / 2 + PAD, y + 0.45, text, zorder=3, **styles[kind])
    return box


def main() -> None:
    """Read the code, and write the picture."""
    content = read()
    draw(content).savefig(PICTURE, dpi=DPI, metadata={KEY: content.text(), "Software": None})


def shown() -> str:
    """The content of the picture in docs."""
    with Image.open(PICTURE) as image:
        return str(image.info[KEY])


if __name__ == "__main__":
    main()
