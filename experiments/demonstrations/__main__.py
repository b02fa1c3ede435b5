"""``python -m experiments.demonstrations --runs 8 --out FOLDER``: frames to 0.8 success from a few demonstrations.

MaskablePPO and DQN with the options discovered in them, with cloning, with both, and rivals. It writes
``results.json`` and ``demonstrations.png``. Interrupted, it goes on where it was.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from functools import partial
from typing import Any

import tyro
from matplotlib.figure import Figure
from rich.table import Table

from experiments.common.intervals import capped, iqm_ratio, steps_until
from experiments.common.seeds import Part, Result, run_parts
from experiments.common.study import Flags, show, write
from experiments.demonstrations.conditions import (
    DQN,
    EPISODES,
    LEARNED,
    LOSS_DECAY,
    LOSS_WEIGHT,
    Arm,
    after_cloning,
    run,
)
from experiments.demonstrations.tasks import TASKS
from sb3_options.callbacks.cloning import MARGIN, UPDATES
from sb3_options.runs.config import FITTED
from sb3_options.runs.intervals import probability_of_improvement


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Train from demonstrations until the task is learned.

    Attributes:
        episodes: That are shown.
        noise: Share of the expert's actions that are random.
        shown_in: Another task, in which the expert acts; by default the one that is learned.
        tasks: Which.
        arms: What is compared.
    """

    runs: int = 8
    episodes: int = 100
    noise: float = 0.0
    shown_in: str | None = None
    tasks: tuple[str, ...] = tuple(TASKS)
    arms: tuple[Arm, ...] = ("options, cloning", "cloning")


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    parts = [
        Part(
            f"{task}: {arm}",
            partial(run, task, arm, study.episodes, study.noise, shown_in=study.shown_in),
            study.out / task / arm.replace(", ", "-").replace(" ", "-"),
            {"loss": [LOSS_WEIGHT, LOSS_DECAY]} if "loss" in arm else {},
        )
        for task in study.tasks
        for arm in study.arms
    ]
    settings: dict[str, Any] = {
        "episodes": study.episodes,
        "noise": study.noise,
        "frames": {task: TASKS[task].frames for task in study.tasks},
        "learned": [LEARNED, EPISODES],
        "ppo": {task: TASKS[task].ppo for task in study.tasks},
        "dqn": [DQN, FITTED, MARGIN],
        "updates": UPDATES,
        "cloned": after_cloning(study.episodes),
    }
    if study.shown_in is not None:
        settings["shown_in"] = study.shown_in
    results = run_parts(parts, study.seeds(), settings=settings, on=study, description="Training")
    summary: dict[str, dict[str, Any]] = {}
    for name, runs in results.items():
        task = name.split(":")[0]
        most = TASKS[task].frames
        first, frames = (capped(each, "learned", most) for each in (results[f"{task}: {study.arms[0]}"], runs))
        summary[name] = {
            **steps_until(runs, "learned", most),
            "ratio": iqm_ratio(first, frames, paired=True)._asdict(),
            "probability_of_improvement": probability_of_improvement(first, frames)._asdict(),
        }
    command = f"python -m experiments.demonstrations --runs {study.runs} --first-seed {study.first_seed}"
    command += f" --episodes {study.episodes} --noise {study.noise}"
    command += "" if study.shown_in is None else f" --shown-in {study.shown_in}"
    command += f" --tasks {shlex.join(study.tasks)} --arms {shlex.join(study.arms)}"
    write(
        study.out,
        {"command": command, "settings": settings, "summary": summary, "runs": results},
        {"demonstrations": draw(study, results)},
        dpi=110,
    )
    table = Table(
        "", "learned", "frames until then", "frames of the first arm as a multiple", "Pr(the first is faster)"
    )
    for name, row in summary.items():
        until = f"{row['mean']:,.0f} ({row['low']:,.0f} to {row['high']:,.0f})"
        ratios = (row["ratio"], row["probability_of_improvement"])
        cells = ("{mean:.2f} ({low:.2f} to {high:.2f})".format(**each) for each in ratios)
        table.add_row(name, f"{row['n_reached']:.0f} of {row['n_runs']:.0f}", until, *cells)
    show(
        table,
        "Interquartile means with 95 % bootstrap intervals, of pairs by seed for multiples. A run that does not learn "
        "counts with its whole length.",
        f"Results: {study.out / 'results.json'}",
    )


def draw(study: Study, results: dict[str, list[Result]]) -> Figure:
    """Performance profiles (Agarwal et al. 2021, §4.2): the share of runs that had learned after so many frames."""
    figure = Figure(figsize=(3.4 * len(study.tasks), 2.9), layout="constrained")
    panels = figure.subplots(1, len(study.tasks), sharey=True, squeeze=False)[0]
    for axes, task in zip(panels, study.tasks, strict=True):
        most = TASKS[task].frames
        for arm in study.arms:
            axes.ecdf(capped(results[f"{task}: {arm}"], "learned", 2 * most), label=arm)  # beyond the edge: never
        axes.set(title=task.split("-", 1)[-1].removesuffix("-v0"), xlabel="frames", xlim=(0, most), ylim=(0, 1.03))
        axes.xaxis.set_major_formatter(lambda n, _: f"{n / 1000:.0f}k" if n else "0")
    panels[0].set_ylabel("share of runs that had learned")
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(study.arms), frameon=False
    )
    return figure


if __name__ == "__main__":
    main(tyro.cli(Study))
