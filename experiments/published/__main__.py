"""What the papers report of their methods, measured with the methods of this library.

``python -m experiments.published --out FOLDER`` writes ``results.json``: how soon agents with eigenoptions learn, their
diffusion time and covering options' cover time in four rooms, L-cut's and relative novelty's subgoals in two rooms,
betweenness on Taxi. With ``--rows relative_novelty`` it measures that row alone. The others of ``FOLDER/results.json``
stay as they are: each row holds the command that measured it.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import tyro
from rich.table import Table

from experiments.common.study import RESULTS, Flags, show, write
from experiments.published import measures


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Measure what papers report.

    Attributes:
        rows: Which of ``eigenoptions``, ``covering``, ``l_cut``, ``relative_novelty`` and ``betweenness``; by default
            all.
        walks: Random walks for each cover time.
        tasks: Starts and goals that agents with eigenoptions learn.
    """

    runs: int = 50
    rows: tuple[str, ...] = ()
    walks: int = 500
    tasks: int = 500

    def __post_init__(self) -> None:
        """Refuse a row that there is not."""
        super().__post_init__()
        for row in self.rows:
            if row not in ROWS:
                raise SystemExit(f"--rows: there is no {row!r}, choose from {', '.join(ROWS)}.")

    def command(self, row: str) -> str:
        """What measures this row."""
        flags = {"runs": self.runs, "first-seed": self.first_seed, "walks": self.walks, "tasks": self.tasks}
        told = "".join(f" --{name} {flags[name]}" for name in ROWS[row][1])
        return f"python -m experiments.published --rows {row}{told}"


ROWS: dict[str, tuple[Callable[[Study], dict[str, Any]], tuple[str, ...]]] = {
    "eigenoptions": (lambda study: measures.eigenoptions(study.tasks, study.first_seed), ("first-seed", "tasks")),
    "covering": (lambda study: measures.covering(study.walks, study.first_seed), ("first-seed", "walks")),
    "l_cut": (lambda study: measures.l_cut(study.seeds()), ("runs", "first-seed")),
    "relative_novelty": (lambda study: measures.relative_novelty(study.seeds()), ("runs", "first-seed")),
    "betweenness": (lambda study: measures.betweenness(), ()),
}
"""What measures each row, and the flags that it depends on."""


def main(study: Study) -> None:
    """Measure, write and print."""
    path = study.out / RESULTS
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"] if path.is_file() else {}
    for name in study.rows or ROWS:
        rows[name] = {"command": study.command(name), **ROWS[name][0](study)}
        write(study.out, {"rows": {name: rows[name] for name in ROWS if name in rows}}, {})
    table = Table("method", "measured")
    for name in study.rows or ROWS:
        table.add_row(name, "\n".join(f"{what}: {value}" for what, value in rows[name].items()))
    show(table, f"Results: {path}")


if __name__ == "__main__":
    main(tyro.cli(Study))
