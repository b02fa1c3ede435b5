"""What does a Ray cluster cost, and what would many machines give?

``python -m experiments.cluster --out FOLDER`` lets the Pioneer's environments step in Ray actors and in worker
processes, in turns on this machine, and times the parts that a step consists of. From these it works out what up to 100
machines would give. It writes ``results.json``.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.table import Table

from experiments.cluster import calculation, measured
from experiments.cluster.calculation import Assumptions
from experiments.cluster.measured import PIONEER, WORKERS, Turn
from experiments.common.intervals import ratio_interval
from experiments.common.study import show, write
from sb3_options.execution.ray_vec_env import connect
from sb3_options.runs.intervals import mean_interval

BAR = 0.9
"""Least steps per second in as many actors as there are cores, as a share of those in worker processes."""

ROUND_TRIP = 0.5e-3
"""Seconds within a data centre; assumed, not measured."""

MACHINES = (1, 10, 100)
PER_ACTOR = (4, 32)
PARTS, HOURS = 400, 0.5
"""Of the study that is worked out: 20 seeds of 20 parts, half an hour each."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """Time a Ray cluster on this machine, and work out what many would give.

    Attributes:
        out: Folder for results.json.
        rounds: Turns of every contestant.
        steps: Steps of all environments in a turn.
        envs: Environments.
        actors: Numbers of actors, one of which is the number of cores.
        seed: Of environments and actions.
    """

    out: Path
    rounds: int = 20
    steps: int = 50
    envs: int = 16
    actors: tuple[int, ...] = (1, 2, 4, 8)
    seed: int = 0


def main(study: Study) -> None:
    """Measure, work out, write and print."""
    ray = connect()
    turns = measured.race(study.envs, study.actors, study.rounds, study.steps, study.seed)
    calls = {int(name): [turn.busy for turn in those] for name, those in turns.items() if name != WORKERS}
    taken = measured.stepping(20 * study.steps, study.seed)
    told = Assumptions(
        cores=os.cpu_count() or 1,
        round_trip=ROUND_TRIP,
        step=float(taken.mean()),
        call=calculation.slope(calls),
        learn=measured.learning(study.envs),
        task=measured.tasks(2 * study.steps, ray.get_runtime_context().gcs_address),
    )
    ray.shutdown()
    results = summarise(turns, study.envs)
    random = np.random.default_rng(study.seed)
    content = {
        "command": f"python -m experiments.cluster --rounds {study.rounds} --steps {study.steps} --envs {study.envs}",
        "env": PIONEER,
        "n_envs": study.envs,
        "cores": os.cpu_count(),
        "load": mean_interval(np.array([turn.load for turn in turns[WORKERS]]))._asdict(),
        **results,
        "call_milliseconds": {
            str(n): {
                "wall": 1e3 * float(np.median([turn.call for turn in turns[str(n)]])),
                "busy": 1e3 * float(np.median(seconds)),
            }
            for n, seconds in calls.items()
        },
        "assumptions": calculation.as_json(told),
        "environments": [
            {"per_actor": each, **calculation.environments(machines, each, told, taken, random)}
            for each in PER_ACTOR
            for machines in MACHINES
        ],
        "study": [calculation.study(machines, PARTS, HOURS, told) for machines in MACHINES],
    }
    write(study.out, content, {})
    show(*_tables(content), f"Results: {study.out / 'results.json'}")


def summarise(turns: dict[str, list[Turn]], n_envs: int) -> dict[str, Any]:
    """Steps per second with 95 % intervals over turns, and as a share of those in worker processes, turn by turn."""
    rates = {name: np.array([n_envs / turn.seconds for turn in those]) for name, those in turns.items()}
    shares = {name: ratio_interval(rate, rates[WORKERS])._asdict() for name, rate in rates.items() if name != WORKERS}
    cores = str(os.cpu_count())
    usual = cores if cores in shares else max(shares, key=int)
    return {
        "n_turns": len(turns[WORKERS]),
        "steps_per_second": {name: mean_interval(rate)._asdict() for name, rate in rates.items()},
        "of_subproc": shares,
        "bar": {"actors": int(usual), "least": BAR, "reached": shares[usual]["mean"] >= BAR},
    }


def _tables(content: dict[str, Any]) -> list[Table]:
    first = Table(
        "", "steps per second", "of SubprocVecEnv", title=f"{content['n_envs']} environments {content['env']}"
    )
    for name, rate in content["steps_per_second"].items():
        share = content["of_subproc"].get(name)
        cells = [f"{each[key]:.{digits}f} ({each['low']:.{digits}f} to {each['high']:.{digits}f})" if each else ""
                 for each, key, digits in ((rate, "mean", 0), (share, "mean", 2))]  # fmt: skip
        first.add_row(name if name == WORKERS else f"RayVecEnv, actors: {name}", *cells)
    second = Table(
        "machines", "environments", "steps per second", "of one machine", "with learning", title="Worked out"
    )
    for row in content["environments"]:
        numbers = (row["steps_per_second"], row["times_one_machine"], row["steps_per_second_with_learning"])
        second.add_row(str(row["machines"]), f"{row['environments']:,}", *(f"{number:,.1f}" for number in numbers))
    third = Table("machines", f"hours of {PARTS} parts of {HOURS} h", title="Worked out")
    for row in content["study"]:
        third.add_row(str(row["machines"]), f"{row['hours']:.2f}")
    return [first, second, third]


if __name__ == "__main__":
    main(tyro.cli(Study))
