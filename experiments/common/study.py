"""The flags that every study has, and what it leaves: results.json, pictures, a table on the screen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.console import Console, RenderableType

from experiments.common.machines import Machines
from experiments.common.seeds import write_json

RESULTS = "results.json"


@dataclass(frozen=True, kw_only=True)
class Flags(Machines):
    """What every study is told.

    Attributes:
        out: Folder for results.json, the pictures and one file per finished run.
        runs: Number of seeds.
        first_seed: Seeds count up from here. Settings were chosen on smaller ones.
    """

    out: Path
    runs: int = 30
    first_seed: int = 1000

    def __post_init__(self) -> None:
        """Refuse what says nothing."""
        if self.runs < 1:
            raise SystemExit(f"--runs must be at least 1, got {self.runs}.")

    def seeds(self, n: int | None = None) -> range:
        """The seeds, or the first ``n`` of them."""
        return range(self.first_seed, self.first_seed + (self.runs if n is None else n))


def write(out: Path, content: Mapping[str, Any], pictures: Mapping[str, Figure], *, dpi: int = 100) -> None:
    """Write results.json and the pictures, by their names without ending."""
    out.mkdir(parents=True, exist_ok=True)
    for name, picture in pictures.items():
        picture.savefig(out / f"{name}.png", dpi=dpi)
    write_json(out / RESULTS, content)


def show(*parts: RenderableType) -> None:
    """Print tables and lines; lines are not broken, so that paths in them can be copied."""
    console = Console(highlight=False, soft_wrap=True)
    for part in parts:
        console.print(part)
