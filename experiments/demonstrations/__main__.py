"""``python -m experiments.demonstrations --runs 8 --out FOLDER``: frames to 0.8 success from a few demonstrations.

MaskablePPO with the options discovered in them, with its policy cloned, and with both. It writes ``results.json``.
Interrupted, it goes on where it was.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from functools import partial
from typing import Any

import tyro
from rich.table import Table

from experiments.common.intervals import capped, iqm_ratio, steps_until
from experiments.common.seeds import Part, run_parts
from experiments.common.study import Flags, show, write
from experiments.demonstrations.conditions import ARMS, EPISODES, LEARNED, PPO, TASKS, Arm, run
from sb3_options.runs.config import CLONED


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Train from demonstrations until the task is learned.

    Attributes:
        episodes: That are shown.
        noise: Share of the expert's actions that are random.
        tasks: Which.
        arms: What is compared.
    """

    runs: int = 8
    episodes: int = 100
    noise: float = 0.0
    tasks: tuple[str, ...] = tuple(TASKS)
    arms: tuple[Arm, ...] = ARMS


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    parts = [
        Part(
            f"{task}: {arm}",
            partial(run, task, arm, study.episodes, study.noise),
            study.out / task / arm.replace(", ", "-"),
        )
        for task in study.tasks
        for arm in study.arms
    ]
    settings: dict[str, Any] = {
        "episodes": study.episodes,
        "noise": study.noise,
        "frames": TASKS,
        "learned": [LEARNED, EPISODES],
        "ppo": PPO,
        "cloned": CLONED,
    }
    results = run_parts(parts, study.seeds(), settings=settings, on=study, description="Training")
    summary: dict[str, dict[str, Any]] = {}
    for name, runs in results.items():
        task = name.split(":")[0]
        first, frames = (capped(each, "learned", TASKS[task]) for each in (results[f"{task}: {study.arms[0]}"], runs))
        ratio = iqm_ratio(first, frames, paired=True)
        summary[name] = {**steps_until(runs, "learned", TASKS[task]), "ratio": ratio._asdict()}
    command = f"python -m experiments.demonstrations --runs {study.runs} --first-seed {study.first_seed}"
    command += f" --episodes {study.episodes} --noise {study.noise}"
    command += f" --tasks {shlex.join(study.tasks)} --arms {shlex.join(study.arms)}"
    write(study.out, {"command": command, "settings": settings, "summary": summary, "runs": results}, {})
    table = Table("", "learned", "frames until then", "frames of the first arm as a multiple")
    for name, row in summary.items():
        until = f"{row['mean']:,.0f} ({row['low']:,.0f} to {row['high']:,.0f})"
        multiple = "{mean:.2f} ({low:.2f} to {high:.2f})".format(**row["ratio"])
        table.add_row(name, f"{row['n_reached']:.0f} of {row['n_runs']:.0f}", until, multiple)
    show(
        table,
        "Interquartile means with 95 % bootstrap intervals, of pairs by seed for multiples. A run that does not learn "
        "counts with its whole length.",
        f"Results: {study.out / 'results.json'}",
    )


if __name__ == "__main__":
    main(tyro.cli(Study))
