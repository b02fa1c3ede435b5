"""``python -m experiments.deep.tune --algo ppo --arm stock|options --out FOLDER``.

Chooses the hyper-parameters of one side of the study: the same search space, the same number of trials and the same
seeds for stock Stable-Baselines3 and for the library with options. Optuna's TPE proposes, and its Wilcoxon pruner stops
a trial whose runs so far are worse, run by run, than those of the best one. Interrupted, it goes on where it was. What
is proposed depends on which of several processes is done first, so that another search may choose otherwise.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import optuna
import tyro
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from rich.json import JSON

from experiments.common.machines import Machines, finished
from experiments.common.seeds import Part, Result, run_parts, write_json
from experiments.common.study import show
from experiments.deep.agents import reached_at
from experiments.deep.conditions import train, train_source
from experiments.deep.settings import DeepSettings
from experiments.deep.tasks import TASKS, Task

STEPS_AFTER = 1000
"""Training ends here, primitive steps after the first success: only steps to 90 % count."""

NET_ARCHS: dict[str, list[int]] = {"none": [], "64, 64": [64, 64], "256": [256]}


def space(trial: optuna.Trial, algo: str) -> dict[str, Any]:
    """Hyper-parameters of the algorithm, one of the search space that both sides share."""
    kwargs: dict[str, Any] = {}
    if algo == "ppo":
        kwargs["learning_rate"] = trial.suggest_float("learning_rate", 5e-4, 5e-3, log=True)
        kwargs["n_steps"] = trial.suggest_categorical("n_steps", [16, 32, 64])
        kwargs["batch_size"] = trial.suggest_categorical("batch_size", [64, 128])
        kwargs["n_epochs"] = trial.suggest_categorical("n_epochs", [4, 8, 16])
        kwargs["gae_lambda"] = trial.suggest_categorical("gae_lambda", [0.8, 0.9, 0.95, 0.98])
        kwargs["ent_coef"] = trial.suggest_float("ent_coef", 3e-4, 3e-2, log=True)
        kwargs["normalize_advantage"] = trial.suggest_categorical("normalize_advantage", [False, True])
    else:
        kwargs["learning_rate"] = trial.suggest_float("learning_rate", 2e-4, 4e-3, log=True)
        kwargs["batch_size"] = trial.suggest_categorical("batch_size", [32, 64, 128])
        kwargs["target_update_interval"] = trial.suggest_categorical("target_update_interval", [50, 100, 200, 500])
        kwargs["exploration_fraction"] = trial.suggest_categorical("exploration_fraction", [0.1, 0.2, 0.4])
        kwargs["exploration_final_eps"] = trial.suggest_categorical("exploration_final_eps", [0.02, 0.05, 0.1])
    net_arch = NET_ARCHS[trial.suggest_categorical("net_arch", list(NET_ARCHS))]
    return {**kwargs, "policy_kwargs": {"net_arch": net_arch}}


@dataclass(frozen=True)
class Tuning(Machines):
    """Choose the hyper-parameters of one side of the study.

    Attributes:
        out: Folder for tuned.json, the trials and the options brought along.
        algo: Of which algorithm.
        arm: Of which side.
        trials: How many sets of hyper-parameters are tried.
        seeds: Each is run on this many seeds, from 0, in every task, until it proves worse than the best.
    """

    out: Path
    algo: Literal["dqn", "ppo"] = "ppo"
    arm: Literal["stock", "options"] = "options"
    trials: int = 17
    seeds: int = 2

    @property
    def folder(self) -> Path:
        """Of this side."""
        return self.out / f"{self.algo}-{self.arm}"


def main(tuning: Tuning) -> None:
    """Try, and write and print what was best."""
    tuning.folder.mkdir(parents=True, exist_ok=True)
    if tuning.arm == "options":
        _make_sources(tuning)
    study = _study(tuning)
    done = sum(trial.state.is_finished() for trial in study.trials)
    missing = max(0, tuning.trials - done)
    # On a cluster a lost share is run again, whatever it had done.
    n_shares = (tuning.jobs or os.cpu_count() or 1) if tuning.cluster is None else max(1, missing)
    shares = [missing // n_shares + (i < missing % n_shares) for i in range(n_shares)]
    for _ in finished([partial(_optimise, tuning, n) for n in shares if n], tuning):
        pass  # each leaves its trials in the journal
    best = study.best_trial
    content = {
        "command": f"python -m experiments.deep.tune --algo {tuning.algo} --arm {tuning.arm} --trials {tuning.trials} "
        f"--seeds {tuning.seeds}",
        "finished": sum(trial.state == optuna.trial.TrialState.COMPLETE for trial in study.trials),
        "pruned": sum(trial.state == optuna.trial.TrialState.PRUNED for trial in study.trials),
        "steps_to_90": {f"{task}, {env}": best.user_attrs[f"{task}, {env}"] for task, env in TASKS},
        "best": best.params,
    }
    write_json(tuning.folder / "tuned.json", content)
    show(JSON.from_data(content))


def _study(tuning: Tuning) -> optuna.Study:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        pruner = optuna.pruners.WilcoxonPruner(p_threshold=0.1, n_startup_steps=4)
    return optuna.create_study(
        storage=JournalStorage(JournalFileBackend(str(tuning.folder / "trials.log"))),
        study_name=f"{tuning.algo}-{tuning.arm}",
        sampler=optuna.samplers.TPESampler(seed=0, n_startup_trials=8, multivariate=True, constant_liar=True),
        pruner=pruner,
        direction="minimize",
        load_if_exists=True,
    )


def _optimise(tuning: Tuning, n_trials: int) -> None:
    study = _study(tuning)
    study.sampler.reseed_rng()  # or both processes would propose the same
    study.optimize(partial(_objective, tuning), n_trials=n_trials)


def _objective(tuning: Tuning, trial: optuna.Trial) -> float:
    """Mean log of the steps to 90 %, over the tasks and seeds."""
    settings = _proposed(trial, tuning)
    taken: dict[tuple[str, str], list[int]] = {}
    logs: list[float] = []
    tuned = [key for key in TASKS if key[0] != "deadline"]  # that is a test of what was chosen
    for seed, (kind, env) in itertools.product(range(tuning.seeds), tuned):
        task = TASKS[kind, env]
        options = None
        if kind == "transfer" and tuning.arm == "options":
            options = tuning.folder / "sources" / env / f"{seed}.safetensors"
        trained = train(task, tuning.algo, tuning.arm, settings, seed, options=options, steps_after=STEPS_AFTER)
        result = trained.result
        steps = reached_at(result["steps"], result["success"]) or task.n_timesteps
        taken.setdefault((kind, env), []).append(steps)
        logs.append(math.log(max(steps, settings.evaluate_every)))
        trial.report(logs[-1], len(logs))
        trial.set_user_attr(f"{kind}, {env}", taken[kind, env])
        if trial.should_prune():
            raise optuna.TrialPruned
    return sum(logs) / len(logs)


def _proposed(trial: optuna.Trial, tuning: Tuning) -> DeepSettings:
    settings = DeepSettings()
    sides = getattr(settings, tuning.algo)
    changes: dict[str, Any] = {
        tuning.algo: {**sides, tuning.arm: {**sides[tuning.arm], **space(trial, tuning.algo)}},
    }
    if tuning.arm == "options":
        share = trial.suggest_categorical("max_option_exploration", [0.25, 0.5, 0.75])
        changes["max_option_exploration"] = {**settings.max_option_exploration, tuning.algo: share}
    return dataclasses.replace(settings, **changes)


def _make_sources(tuning: Tuning) -> None:
    """Options to bring along, from the old task, with the settings as they are before tuning."""
    parts = [
        Part(env, partial(_source, task, tuning, env), tuning.folder / "sources" / env)
        for (kind, env), task in TASKS.items()
        if kind == "transfer"
    ]
    settings = DeepSettings().of(tuning.algo, "options")
    run_parts(parts, range(tuning.seeds), settings=settings, on=tuning, description="Options of the old task")


def _source(task: Task, tuning: Tuning, env: str, seed: int) -> Result:
    discovery = train_source(task, tuning.algo, "options", DeepSettings(), seed).discovery
    assert discovery is not None  # of this arm
    discovery.bank.save(tuning.folder / "sources" / env / f"{seed}.safetensors")
    return {"subgoals": [[float(x) for x in d.subgoal] for d in discovery.discoveries]}


if __name__ == "__main__":
    main(tyro.cli(Tuning))
