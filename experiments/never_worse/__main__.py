"""``python -m experiments.never_worse --out FOLDER``: discovery on against off, where no setting was chosen.

Both sides are MaskablePPO as ``train.py`` trains it by default. A task is learned once the mean return of 50 training
episodes reaches its level. Reported are the primitive steps and the processor time until then, as a share of those
without discovery. It writes ``results.json``. Interrupted, it goes on where it was.
"""

from __future__ import annotations

import shlex
import time
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import numpy as np
import tyro
from rich.table import Table
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from experiments.common.intervals import iqm_ratio
from experiments.common.seeds import Part, Result, run_parts
from experiments.common.study import Flags, show, write
from experiments.never_worse.tasks import TASKS, WINDOW
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.runs import folder as runs
from sb3_options.runs.algorithms import make_model
from sb3_options.runs.config import configure

COSTS = ("steps", "seconds")


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Does discovery cost anything in tasks that no setting was chosen on?

    Attributes:
        tasks: Of `TASKS`; by default all.
    """

    tasks: tuple[str, ...] = tuple(TASKS)
    runs: int = 20
    first_seed: int = 7000


class Learned(BaseCallback):
    """Ends training once the task is learned.

    Attributes:
        at: Primitive steps and seconds of processor time until then; None before.
    """

    def __init__(self, discovery: SubgoalDiscoveryCallback, level: float) -> None:
        super().__init__()
        self.discovery, self.level = discovery, level
        self.at: dict[str, float] | None = None

    def _on_training_start(self) -> None:
        self.began = time.process_time()
        self._seen = 0

    def _on_step(self) -> bool:
        history = self.discovery.history
        if len(history) == self._seen or len(history) < WINDOW:
            return True
        self._seen = len(history)
        if np.mean([episode.total_reward for episode in history[-WINDOW:]]) < self.level:
            return True
        self.at = {"steps": self.num_timesteps, "seconds": time.process_time() - self.began}
        return False


def run(name: str, seed: int, *, discovers: bool) -> Result:
    """Train once.

    Returns:
        ``steps`` and ``seconds`` until the task was learned, those of the whole training if it never was (``learned``);
        the mean return of its first and last tenth; the options that were ``found`` and ``closed``.
    """
    task = TASKS[name]
    off = {} if discovers else {"max_new_options": 0}
    config = configure(env=task.env, algo="maskableppo", seed=seed, n_timesteps=task.frames, **task.settings, **off)
    model = make_model(config, runs.make_env(config, config.n_envs, seed))
    discovery = SubgoalDiscoveryCallback(
        config.discovery, config.option, max_new_options=config.max_new_options, usefulness=config.usefulness
    )
    learned = Learned(discovery, task.level)
    with closing(cast("VecEnv", model.get_env())):
        model.learn(config.n_timesteps, callback=[discovery, learned])
    whole = {"steps": config.n_timesteps, "seconds": time.process_time() - learned.began}
    returns = [(episode.timestep, episode.total_reward) for episode in discovery.history]
    tenth = config.n_timesteps / 10
    return {
        "seed": seed,
        **(learned.at or whole),
        "learned": learned.at is not None,
        "first": mean([total for at, total in returns if at <= tenth]),
        "last": mean([total for at, total in returns if at > 9 * tenth]),
        "found": [found.where for found in discovery.discoveries],
        "closed": len(discovery.closed),
    }


def mean(values: list[float]) -> float | None:
    """Of some values; None of none."""
    return float(np.mean(values)) if values else None


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    parts = [
        Part(
            f"{name}, {side}",
            partial(run, name, discovers=side == "on"),
            study.out / f"{name}-{side}",
            vars(TASKS[name]),
        )
        for name in study.tasks
        for side in ("on", "off")
    ]
    results = run_parts(parts, study.seeds(), settings={}, on=study, description="Training")
    summary = {name: compared(results[f"{name}, on"], results[f"{name}, off"]) for name in study.tasks}
    command = f"python -m experiments.never_worse --runs {study.runs} --first-seed {study.first_seed}"
    command += "" if study.tasks == Study.tasks else f" --tasks {shlex.join(study.tasks)}"
    write(study.out, {"command": command, "summary": summary, "runs": results}, {})
    table = Table("task", "learned, on", "off", "with an option", *(f"{cost}, of off's" for cost in COSTS))
    for name, each in summary.items():
        ratios = ["{:.2f} ({:.2f} to {:.2f})".format(*each[cost]) for cost in COSTS]
        table.add_row(name, *(str(each[what]) for what in ("learned_on", "learned_off", "with_option")), *ratios)
    show(table, f"Results: {study.out / 'results.json'}")


def compared(on: list[Result], off: list[Result]) -> dict[str, Any]:
    """How many learned, and the ratios of interquartile means with their intervals, pairs of a seed resampled."""
    sides = [[np.array([each[cost] for each in side], dtype=np.float64) for side in (on, off)] for cost in COSTS]
    return {
        "learned_on": sum(each["learned"] for each in on),
        "learned_off": sum(each["learned"] for each in off),
        "with_option": sum(bool(each["found"]) for each in on),
        **{cost: list(iqm_ratio(*both, paired=True)) for cost, both in zip(COSTS, sides, strict=True)},
    }


if __name__ == "__main__":
    main(tyro.cli(Study))
