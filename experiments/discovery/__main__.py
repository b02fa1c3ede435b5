"""The main job over many seeds: when is the first option made, and how far from the doorway is its subgoal?

``python -m experiments.discovery --runs 20 --out FOLDER`` trains DQN on the two-room gridworld with the defaults of
``train.py``, and writes ``results.json`` and ``discovery.png``. Interrupted, it goes on where it was.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial

import tyro
from rich.table import Table

from experiments.common.gridworlds import NEAR
from experiments.common.seeds import Result, run_seeds
from experiments.common.study import Flags, show, write
from experiments.discovery.conditions import run
from experiments.discovery.plots import draw
from experiments.discovery.summary import EARLY, summarise
from sb3_options.runs.config import TrainConfig, configure


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Run the main job for many seeds and say where and when the first option was made.

    Attributes:
        n_timesteps: Primitive steps of each run; by default what training takes.
    """

    runs: int = 20
    n_timesteps: int = TrainConfig.n_timesteps


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    config = configure(algo="dqn", n_timesteps=study.n_timesteps)
    results = run_seeds(
        partial(run, config),
        study.seeds(),
        study.out,
        settings=dataclasses.asdict(config),
        on=study,
        description="Training",
    )
    summary = summarise(results)
    command = f"python -m experiments.discovery --runs {study.runs} --first-seed {study.first_seed}"
    write(study.out, {"command": command, **summary, "runs": results}, {"discovery": draw(results)}, dpi=110)
    share = summary["share_near_and_early"]
    show(
        _table(results),
        f"{summary['n_near_and_early']} of {summary['n_runs']} runs made their first option within {NEAR} cell of the "
        f"doorway before episode {EARLY} (95 % interval {share['low']:.2f} to {share['high']:.2f}).",
        f"Results: {study.out / 'results.json'}, {study.out / 'discovery.png'}",
    )


def _table(results: list[Result]) -> Table:
    table = Table("seed", "episode", "primitive step", "subgoal", "cells from doorway", "final steps/episode")
    for r in results:
        cells = [r[k] for k in ("seed", "episode", "primitive_step", "subgoal", "distance", "final_steps")]
        table.add_row(*("–" if c is None else str(c) for c in cells))
    return table


if __name__ == "__main__":
    main(tyro.cli(Study))
