"""``python -m experiments.first_success --runs 20 --out FOLDER``: primitive steps until the goal is reached once.

Stock PPO and MaskablePPO with discovery, each also with a bonus for what is new. Writes ``results.json``. Interrupted,
it goes on where it was.
"""

from __future__ import annotations

import dataclasses
import shlex
from dataclasses import dataclass
from functools import partial

import numpy as np
import tyro
from rich.table import Table

from experiments.common.seeds import Part, Result, run_parts
from experiments.common.study import Flags, show, write
from experiments.first_success.conditions import ARMS, N_TIMESTEPS, SETTINGS, TASKS, Arm, run
from sb3_options.runs.intervals import iqm_interval


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
    summary = {name: summarise(runs) for name, runs in results.items()}
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


def summarise(runs: list[Result]) -> dict[str, float]:
    """Interquartile mean of the steps until the first success, with its interval."""
    steps = np.array([N_TIMESTEPS if r["first_success"] is None else r["first_success"] for r in runs], dtype=float)
    reached = iqm_interval(steps)
    n_reached = sum(r["first_success"] is not None for r in runs)
    return {"n_runs": len(runs), "n_reached": n_reached, "mean": reached.mean, "low": reached.low, "high": reached.high}


if __name__ == "__main__":
    main(tyro.cli(Study))
