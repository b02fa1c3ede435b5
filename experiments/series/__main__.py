"""``python -m experiments.series --runs 5 --out FOLDER``: a goal that moves on through a chain of eight rooms.

Options, the network or both are carried on from task to task; beside them the last task alone. Writes ``results.json``
and ``series.png``. Interrupted, it goes on where it was.
"""

from __future__ import annotations

import dataclasses
import shlex
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import tyro
from rich.table import Table

from experiments.common.seeds import Part, Result, run_parts
from experiments.common.study import Flags, show, write
from experiments.series.conditions import ARMS, SETTINGS, Arm, run
from experiments.series.plots import draw
from experiments.series.tasks import Chain
from sb3_options.runs.task_ends import PAYS


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Train through a series of tasks, and in its last task alone.

    Attributes:
        arms: What a task takes over from the one before.
        chain: The tasks.
    """

    runs: int = 5
    arms: tuple[Arm, ...] = ARMS
    chain: Chain = field(default_factory=Chain)


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    parts = [Part(arm, partial(run, arm, study.chain), study.out / arm.replace(" ", "-")) for arm in study.arms]
    settings = {"chain": dataclasses.asdict(study.chain), "pays": PAYS, **dataclasses.asdict(SETTINGS)}
    results = run_parts(parts, study.seeds(), settings=settings, on=study, description="Training")
    summary = {arm: summarise(runs) for arm, runs in results.items()}
    command = f"python -m experiments.series --runs {study.runs} --first-seed {study.first_seed}"
    command += f" --arms {shlex.join(study.arms)}"
    content = {"command": command, "chain": settings["chain"], "summary": summary, "runs": results}
    write(study.out, content, {"series": draw(results, study.chain)}, dpi=110)
    table = Table("", "solve the last task", "primitive steps, all tasks (median)", "in the last task")
    for arm, row in summary.items():
        steps = [f"{row[name]:,.0f}" if row[name] is not None else "–" for name in ("steps", "last_steps")]
        table.add_row(arm, f"{row['solved']} of {row['n_runs']}", *steps)
    show(table, f"Results: {study.out / 'results.json'}, {study.out / 'series.png'}")


def summarise(runs: list[Result]) -> dict[str, float | None]:
    """How many solved the last task, and the medians of those that did."""
    solved = [r for r in runs if r["solved"]]
    return {
        "n_runs": len(runs),
        "solved": len(solved),
        "steps": float(np.median([r["steps"] for r in solved])) if solved else None,
        "last_steps": float(np.median([r["tasks"][-1]["steps"] for r in solved])) if solved else None,
    }


if __name__ == "__main__":
    main(tyro.cli(Study))
