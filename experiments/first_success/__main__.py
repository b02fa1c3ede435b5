"""``python -m experiments.first_success --runs 20 --out FOLDER``: primitive steps until the goal is reached once.

Stock PPO and MaskablePPO with discovery, each also with a bonus for what is new. Writes ``results.json``. Interrupted,
it goes on where it was.
"""

from __future__ import annotations

import dataclasses
import shlex
from dataclasses import dataclass
from functools import partial

import tyro
from rich.table import Table

from experiments.common.intervals import steps_until
from experiments.common.seeds import Part, run_parts
from experiments.common.study import Flags, show, write
from experiments.first_success.conditions import ARMS, N_TIMESTEPS, SETTINGS, TASKS, Arm, run


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Train until the first success, with and without discovery and a bonus.

    Attributes:
        tasks: Which.
        arms: What is compared.
    """

    runs: int = 20
    tasks: tuple[str, ...] = TASKS
    arms: tuple[Arm, ...] = ARMS


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    parts = [
        Part(f"{task}: {arm}", partial(run, task, arm), study.out / task.replace(" ", "-") / arm.replace(" ", "-"))
        for task in study.tasks
        for arm in study.arms
    ]
    settings = {"n_timesteps": N_TIMESTEPS, "tasks": TASKS, **dataclasses.asdict(SETTINGS)}
    results = run_parts(parts, study.seeds(), settings=settings, on=study, description="Training")
    summary = {name: steps_until(runs, "first_success", N_TIMESTEPS) for name, runs in results.items()}
    command = f"python -m experiments.first_success --runs {study.runs} --first-seed {study.first_seed}"
    command += f" --tasks {shlex.join(study.tasks)} --arms {shlex.join(study.arms)}"
    write(study.out, {"command": command, "n_timesteps": N_TIMESTEPS, "summary": summary, "runs": results}, {})
    table = Table("", "with a success", "primitive steps until then")
    for name, row in summary.items():
        reached = f"{row['mean']:,.0f} ({row['low']:,.0f} to {row['high']:,.0f})"
        table.add_row(name, f"{row['n_reached']:.0f} of {row['n_runs']:.0f}", reached)
    show(
        table,
        f"Interquartile means with 95 % bootstrap intervals; a run without a success counts as {N_TIMESTEPS:,}.",
        f"Results: {study.out / 'results.json'}",
    )


if __name__ == "__main__":
    main(tyro.cli(Study))
