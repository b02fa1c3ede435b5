"""What a new user meets first: ``python -m experiments.first_hour TASK --runs 20 --out FOLDER``.

``rooms``: does the demo's option help, and is it used where it leads? ``lake``: are subgoals of discrete states
bottlenecks? ``readme``: does the program in the README discover anything? It writes ``results.json``. Interrupted, it
goes on where it was.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.table import Table

from experiments.common.seeds import Part, Result, run_parts
from experiments.common.study import Flags, show, write
from experiments.first_hour.conditions import BY_DEFAULT, run

NEAR_GOAL = 3
"""Cells from the goal of the lake within which a subgoal says nothing."""

MEASURES = (
    "competent_after",
    "success_rate",
    "runs",
    "steps_outside",
    "mean_duration",
    "reached_subgoal",
    "processor_seconds",
)
"""Of which the median over the seeds is reported."""


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Train with and without discovery, with the defaults of ``train.py``, and say what became of the options.

    ``readme`` trains what the program in the README trains, with its settings and others.

    Attributes:
        task: Where.
        conditions: Of `CONDITIONS`, or of `README`; by default those of the task.
        n_timesteps: Primitive steps of each run; by default what training takes.
    """

    task: Annotated[Literal["rooms", "lake", "readme"], tyro.conf.Positional]
    runs: int = 20
    conditions: tuple[str, ...] = ()
    n_timesteps: int | None = None


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    parts = [
        Part(
            name,
            partial(run, study.task, name, study.n_timesteps),
            study.out / name.replace(", ", "-").replace(" ", "-"),
        )
        for name in study.conditions or BY_DEFAULT[study.task]
    ]
    settings = {"task": study.task, "n_timesteps": study.n_timesteps}
    results = run_parts(parts, study.seeds(), settings=settings, on=study, description="Training")
    summary = {name: summarise(those) for name, those in results.items()}
    command = f"python -m experiments.first_hour {study.task} --runs {study.runs} --first-seed {study.first_seed}"
    command += "" if study.n_timesteps is None else f" --n-timesteps {study.n_timesteps}"
    command += f" --conditions {shlex.join(summary)}"
    write(study.out, {"command": command, "summary": summary, "runs": results}, {})
    table = Table("median over the seeds", *summary)
    for measure in ("n_competent", "n_with_option", "n_near_goal", *MEASURES):
        table.add_row(measure, *("–" if s[measure] is None else f"{s[measure]:,.4g}" for s in summary.values()))
    show(table, f"Results: {study.out / 'results.json'}")


def summarise(results: list[Result]) -> dict[str, Any]:
    """Medians over the runs; those that never were competent count as last."""
    summary: dict[str, Any] = {
        "n_runs": len(results),
        "n_competent": sum(r["competent_after"] is not None for r in results),
        "n_with_option": sum(bool(r["where"]) for r in results),
        "n_near_goal": sum(cells is not None and cells <= NEAR_GOAL for r in results for cells in r["steps_to_goal"]),
    }
    for name in MEASURES:
        never = np.inf if name == "competent_after" else np.nan
        values = np.array([never if r[name] is None else r[name] for r in results], dtype=np.float64)
        values = values[~np.isnan(values)]
        median = float(np.median(values)) if len(values) else np.nan
        summary[name] = median if np.isfinite(median) else None
    return summary


if __name__ == "__main__":
    main(tyro.cli(Study))
