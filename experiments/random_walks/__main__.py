"""Random walks: are the subgoals that discovery finds bottlenecks?

``python -m experiments.random_walks --runs 20 --out FOLDER`` lets an agent walk at random in two rooms, in four, with a
key and a door, and on maps that are drawn at random, and searches after every episode. It writes ``results.json`` and
``random_walks.png``. Interrupted, it goes on where it was. ``--compare methods`` does so with other methods of
discovery beside diverse density, ``--compare waiting`` with fewer and more successes before the first search.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import tyro
from rich.table import Table

from experiments.common.seeds import Part, run_parts
from experiments.common.study import Flags, show, write
from experiments.random_walks.conditions import ARMS, MAX_OPTIONS, METHODS, N_EPISODES, TASKS, WAITING, run
from experiments.random_walks.plots import draw
from experiments.random_walks.summary import Summary, summarise

COMPARED = {"bags": ARMS, "methods": METHODS, "waiting": WAITING}
"""What is changed of the defaults, by what is compared."""


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Discover from random walks for many seeds, and say how many subgoals are bottlenecks.

    Attributes:
        compare: How bags are made, methods of discovery with their defaults, or how long to wait for subgoals.
        noise: Largest error of the positions that discovery sees, in cells; above 0 no state is visited twice.
    """

    runs: int = 20
    compare: Literal["bags", "methods", "waiting"] = "bags"
    noise: float = 0.0


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    arms = COMPARED[study.compare]
    parts = [
        Part(
            f"{task}: {arm}",
            partial(run, task, changed, noise=study.noise),
            study.out / study.compare / task.replace(" ", "_") / str(i),
        )
        for task in TASKS
        for i, (arm, changed) in enumerate(arms.items())
    ]
    settings = {"arms": arms, "n_episodes": N_EPISODES, "max_options": MAX_OPTIONS, "noise": study.noise}
    results = run_parts(parts, study.seeds(), settings=settings, on=study, description="Walking")
    summary = summarise(results)
    command = f"python -m experiments.random_walks --runs {study.runs} --first-seed {study.first_seed} "
    command += f"--compare {study.compare}" + (f" --noise {study.noise:g}" if study.noise else "")
    content = {"command": command, **settings, "summary": summary, "runs": results}
    write(study.out, content, {"random_walks": draw(results)}, dpi=110)
    show(_table(summary), f"Results: {study.out / 'results.json'}, {study.out / 'random_walks.png'}")


def _table(summary: Summary) -> Table:
    table = Table("", "first subgoal a bottleneck", "all", "median episode of the first")
    for name, row in summary.items():
        cells = []
        for share in (row["first"], row["all"]):
            text = f"{share['n_bottlenecks']} of {share['n']}"
            cells.append(f"{text} ({share['low']:.2f} to {share['high']:.2f})" if share["n"] else "–")
        table.add_row(name, *cells, "–" if row["median_episode"] is None else f"{row['median_episode']:.0f}")
    return table


if __name__ == "__main__":
    main(tyro.cli(Study))
