"""What the papers report of their methods, measured with the methods of this library.

``python -m experiments.published --out FOLDER`` writes ``results.json``: eigenoptions' diffusion time and covering
options' cover time in four rooms, L-cut's and relative novelty's subgoals in two rooms, betweenness on Taxi.
"""

from __future__ import annotations

from dataclasses import dataclass

import tyro
from rich.table import Table

from experiments.common.study import Flags, show, write
from experiments.published import measures


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Measure what papers report.

    Attributes:
        walks: Random walks for each cover time.
    """

    runs: int = 50
    walks: int = 500


def main(study: Study) -> None:
    """Measure, write and print."""
    found = {
        "eigenoptions": measures.eigenoptions(),
        "covering": measures.covering(study.walks, study.first_seed),
        "l_cut": measures.l_cut(study.seeds()),
        "relative_novelty": measures.relative_novelty(study.seeds()),
        "betweenness": measures.betweenness(),
    }
    command = f"python -m experiments.published --runs {study.runs} --first-seed {study.first_seed}"
    write(study.out, {"command": f"{command} --walks {study.walks}", **found}, {})
    table = Table("method", "measured")
    for name, values in found.items():
        table.add_row(name, "\n".join(f"{what}: {value}" for what, value in values.items()))
    show(table)


if __name__ == "__main__":
    main(tyro.cli(Study))
