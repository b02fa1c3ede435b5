"""``python -m experiments.methods.tune --method l-cut --trials 30 --out FOLDER``.

Chooses the settings of one method. All methods get the same number of trials, tasks, learner and seeds, and each a
space of its own; the first trial is the defaults. Optuna's TPE proposes. Interrupted, it goes on where it was. What was
best goes into ``experiments/methods/tuned.json``, which the race reads with ``--settings tuned``. Seeds count from 0,
so that none of them, and no random map, is one of the race's.
"""

from __future__ import annotations

import json
import math
import shlex
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import tyro
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from rich.json import JSON

from experiments.common.machines import Machines
from experiments.common.seeds import Part, run_parts, write_json
from experiments.common.study import show
from experiments.methods.conditions import SETTINGS, Entry, length_of, run
from experiments.methods.entrants import TUNED, all_settings_of
from experiments.methods.spaces import SPACES, defaults_of
from experiments.methods.summary import PHASES, steps_of


@dataclass(frozen=True, kw_only=True)
class Tuning(Machines):
    """Choose the settings of one method.

    Attributes:
        out: Folder for the trials.
        method: Which.
        trials: How many settings are tried; for a fair race as many for each method.
        seeds: Each trial is run with this many seeds, from 0, in every task.
        tasks: Where.
        learner: Who learns.
        n_timesteps: Primitive steps of each training, at most; by default as the learner needs.
        chosen: File with the settings of all methods, of which this one's are replaced.
    """

    out: Path
    method: str
    trials: int = 30
    seeds: int = 3
    tasks: tuple[str, ...] = ("TwoRooms", "FourRooms", "KeyDoor", "random maps")
    learner: str = "macroq"
    n_timesteps: int | None = None
    chosen: Path = TUNED

    def __post_init__(self) -> None:
        """Refuse a method that has nothing to tune."""
        if self.method not in SPACES:
            raise SystemExit(f"--method: {self.method!r} has nothing to tune, choose from {', '.join(SPACES)}.")

    def command(self) -> str:
        """What was called."""
        told = f"--method {self.method} --trials {self.trials} --seeds {self.seeds} --learner {self.learner}"
        return f"python -m experiments.methods.tune {told} --tasks {shlex.join(self.tasks)}"


def main(tuning: Tuning) -> None:
    """Try, and write and print what was best."""
    folder = tuning.out / tuning.method
    folder.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        storage=JournalStorage(JournalFileBackend(str(folder / "trials.log"))),
        study_name=tuning.method,
        sampler=optuna.samplers.TPESampler(seed=0, multivariate=True),
        direction="minimize",
        load_if_exists=True,
    )
    for cut in study.get_trials(states=(TrialState.RUNNING,)):  # with its finished seeds
        study.tell(cut.number, state=TrialState.FAIL)
        study.enqueue_trial(cut.params, user_attrs={"place": _place(cut)})
    defaults = defaults_of(tuning.method)
    if not study.trials:
        study.enqueue_trial(defaults)
    else:
        study.sampler.reseed_rng()  # or it would propose what it began with
    for _ in range(len(_completed(study)), tuning.trials):
        trial = study.ask(fixed_distributions=SPACES[tuning.method])
        study.tell(trial, score(tuning, trial.params, folder / _place(trial)))
    best = study.best_trial
    content = {
        "command": tuning.command(),
        "settings": best.params,
        "trial": best.number,
        "score": best.value,
        "score_of_defaults": next(trial.value for trial in _completed(study) if trial.params == defaults),
    }
    chosen: dict[str, Any] = json.loads(tuning.chosen.read_text(encoding="utf-8")) if tuning.chosen.is_file() else {}
    write_json(tuning.chosen, dict(sorted({**chosen, tuning.method: content}.items())))
    show(JSON.from_data(content), f"Written to {tuning.chosen}")


def _completed(study: optuna.Study) -> list[FrozenTrial]:
    return study.get_trials(states=(TrialState.COMPLETE,))


def _place(trial: optuna.Trial | FrozenTrial) -> str:
    """The folder of a trial's runs, which is that of the one that was cut off and is made again."""
    return str(trial.user_attrs.get("place", trial.number))


def score(tuning: Tuning, settings: dict[str, Any], folder: Path) -> float:
    """Mean log of the steps to the criterion, over tasks, seeds, and both places of the goal; lower is better."""
    lengths = {task: tuning.n_timesteps or length_of(task, tuning.learner) for task in tuning.tasks}
    parts = [
        Part(task, partial(run, Entry(task, tuning.learner, tuning.method, settings, n)), folder / task)
        for task, n in lengths.items()
    ]
    told = {"settings": all_settings_of(tuning.method, settings), "lengths": lengths}
    results = run_parts(parts, range(tuning.seeds), settings=told, on=tuning, description=folder.name)
    taken = [steps_of(of[phase], lengths[task]) for task, runs in results.items() for of in runs for phase in PHASES]
    return float(np.mean([math.log(max(steps, SETTINGS.evaluate_every)) for steps in taken]))


if __name__ == "__main__":
    main(tyro.cli(Tuning))
