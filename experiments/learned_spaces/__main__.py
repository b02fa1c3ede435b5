"""Learned spaces: are the subgoals of random walks seen as pictures bottlenecks, without coordinates?

``python -m experiments.learned_spaces --runs 20 --out FOLDER`` lets an agent that sees pictures walk at random in two
rooms and in four, learns a space from them, and searches in it after every episode. It writes ``results.json`` and
``learned_spaces.png``. Interrupted, it goes on where it was.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial

import tyro
from rich.table import Table

from experiments.common.seeds import Part, run_parts
from experiments.common.study import Flags, show, write
from experiments.learned_spaces.conditions import ARMS, MAX_OPTIONS, N_EPISODES, NAMES, TASKS, run
from experiments.learned_spaces.plots import draw
from experiments.learned_spaces.summary import summarise
from sb3_options.embedding.settings import EmbeddingSettings


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Discover in learned spaces for many seeds, and say how many subgoals are bottlenecks."""

    runs: int = 20


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    parts = [
        Part(f"{task}: {NAMES.get(arm, arm)}", partial(run, task, arm), study.out / task / str(NAMES.get(arm, arm)))
        for task in TASKS
        for arm in ARMS
    ]
    settings = {
        "embedding": dataclasses.asdict(EmbeddingSettings()),
        "n_episodes": N_EPISODES,
        "max_options": MAX_OPTIONS,
    }
    results = run_parts(parts, study.seeds(), settings=settings, on=study, description="Walking")
    summary = summarise(results)
    command = f"python -m experiments.learned_spaces --runs {study.runs} --first-seed {study.first_seed}"
    content = {"command": command, **settings, "summary": summary, "runs": results}
    write(study.out, content, {"learned_spaces": draw(results)}, dpi=110)
    table = Table("", "first subgoal a bottleneck", "all", "rank correlation, median", "seconds a run")
    for name, row in summary.items():
        cells = [f"{row[which]['n_bottlenecks']} of {row[which]['n']}" for which in ("first", "all")]
        correlation = "–" if row["rank_correlation"] is None else f"{row['rank_correlation']['median']:.2f}"
        table.add_row(name, *cells, correlation, f"{row['seconds']['all']:.0f}")
    show(table, f"Results: {study.out / 'results.json'}, {study.out / 'learned_spaces.png'}")


if __name__ == "__main__":
    main(tyro.cli(Study))
