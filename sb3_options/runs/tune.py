"""Searching for settings with Optuna: TPE proposes, and every trial is trained on the same seeds.

Wilcoxon's test stops a trial whose runs so far are worse, seed by seed, than those of the best one. With several jobs,
what is proposed depends on which of them ends first, so another search may choose otherwise.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from joblib import Parallel, delayed
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState
from rich.console import Console
from rich.markup import escape

from sb3_options.runs import config as configs
from sb3_options.runs import yaml_file
from sb3_options.runs.algorithms import class_of
from sb3_options.runs.commands import TuneConfig
from sb3_options.runs.compare import Goal, Run, read_run
from sb3_options.runs.config import IMPORTING, TrainConfig
from sb3_options.runs.training import train

BEST = "best.yml"
JOURNAL = "trials.log"
RUNS = "runs"
LOG = "output.txt"

N_RANDOM = 8
"""Trials that are drawn at random before TPE proposes."""

P_THRESHOLD = 0.1
N_BEFORE = 4
"""Runs of a trial before it may be stopped: with fewer, Wilcoxon's test says nothing."""

COUNTED = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.RUNNING)
"""Trials that count; one that failed is made up for."""

N_FAILED = 3
"""Failures that end a search in which no trial was completed."""


class SearchSpace(NamedTuple):
    """Settings that stay, and distributions of those that vary, by name; ``discovery.decay`` is one of a group."""

    where: Path
    base: dict[str, Any]
    search: dict[str, BaseDistribution]

    def config(self, proposed: Mapping[str, Any], seed: int, folder: Path) -> TrainConfig:
        """The configuration of a run, whose run folder will be in ``folder``."""
        read = {name: json.loads(v) if isinstance(v, str) else v for name, v in proposed.items()}
        own = {"seed": seed, "tensorboard_log": str(folder), "progress": False, "checkpoint_freq": 0}
        return configs.build({**self.base, **read, **own}, self.where)


def read_space(path: Path, trusted: Mapping[str, str | None]) -> SearchSpace:
    """A file with ``base`` and ``search``; ``trusted`` are settings of the command line that may import modules."""
    content = yaml_file.read_mapping(path)
    parts = [content.get("base", {}), content.get("search")]
    if not content.keys() <= {"base", "search"} or not all(isinstance(part, dict) and part for part in parts[1:]):
        raise ValueError(f"{path}: write `base:` and `search:`, each with `name: value` lines, and nothing else.")
    base, search = ({str(name).replace("-", "_"): value for name, value in part.items()} for part in parts)
    for name in search.keys() & {*IMPORTING, "seed", "tensorboard_log"}:
        raise ValueError(f"{path}: {name} cannot be varied.")
    distributions = {name: _distribution(path, name, of) for name, of in search.items()}
    space = SearchSpace(path, configs.with_trusted(base, trusted, path), distributions)
    for end in (0, -1):  # names and both ends are right
        proposed = {
            name: of.choices[end] if isinstance(of, CategoricalDistribution) else (of.low, of.high)[end]
            for name, of in distributions.items()
        }
        class_of(space.config(proposed, 0, Path("runs")).algo)
    return space


def _distribution(path: Path, name: str, of: Any) -> Any:
    try:
        if isinstance(of, list):
            return CategoricalDistribution([json.dumps(value) for value in of])  # Optuna hashes values
        whole = isinstance(of["low"], int) and isinstance(of["high"], int)
        return IntDistribution(**of) if whole else FloatDistribution(**of)
    except (TypeError, ValueError, KeyError) as error:
        example = "{low: 0.0001, high: 0.01, log: true} or a list of values"
        raise ValueError(f"{path}: {name} takes {example}, got {of!r}: {error}") from error


def tune(config: TuneConfig, console: Console) -> TrainConfig:
    """Search, and leave ``best.yml``; the best configuration is returned."""
    Goal.parsed(config.reach)
    space = read_space(config.space, config.trusted())
    config.out.mkdir(parents=True, exist_ok=True)
    study = _opened(config, 0)
    asked = [config.reach, config.seeds, str(space[1:])]
    if study.user_attrs.get("asked", asked) != asked:
        raise ValueError(f"{config.out} holds another search: its file, goal or seeds differ. Give another --out.")
    study.set_user_attr("asked", asked)
    for cut_off in study.get_trials(states=(TrialState.RUNNING,)):
        study.enqueue_trial(cut_off.params)
        study.tell(cut_off.number, state=TrialState.FAIL)
    Parallel(n_jobs=config.jobs)(delayed(_work)(config, space, job) for job in range(config.jobs))
    best = dataclasses.replace(space.config(study.best_params, 0, Path("runs")), progress=True)
    configs.save(best, config.out / BEST)
    states = [trial.state.name.lower() for trial in study.trials]
    found = ", ".join(f"{states.count(state)} {state}" for state in sorted(set(states)))
    console.print(
        f"Of {found} trials on {config.seeds} seeds trial {study.best_trial.number + 1} is the best, "
        f"{math.exp(study.best_value):,.0f} primitive steps. The best of many is better on these seeds than on others: "
        f"judge {escape(str(config.out / BEST))} with --config on --seed {config.seeds} and more."
    )
    return best


def _opened(config: TuneConfig, job: int) -> optuna.Study:
    """The search in the folder, or a new one; each job draws other settings, and so does a search that goes on."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        study = optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(config.out / JOURNAL))),
            study_name="settings",
            pruner=optuna.pruners.WilcoxonPruner(p_threshold=P_THRESHOLD, n_startup_steps=N_BEFORE),
            load_if_exists=True,
        )
        seed = len(study.trials) + 10_000 * job
        study.sampler = optuna.samplers.TPESampler(
            seed=seed, n_startup_trials=N_RANDOM, multivariate=True, constant_liar=True
        )
    return study


def _work(config: TuneConfig, space: SearchSpace, job: int) -> None:
    """Try one set of settings after another until there are enough; one of several processes may do so."""
    study = _opened(config, job)
    while len(study.get_trials(deepcopy=False, states=COUNTED)) < config.trials:
        trial = study.ask(space.search)
        try:
            value = _mean_score(trial, config, space)
        except Exception as error:
            study.tell(trial, state=TrialState.FAIL)
            states = [each.state for each in study.get_trials(deepcopy=False)]
            print(f"Trial {trial.number + 1} failed: {error}", flush=True)
            if states.count(TrialState.FAIL) >= (config.trials if TrialState.COMPLETE in states else N_FAILED):
                raise
            continue
        study.tell(trial, value, state=TrialState.PRUNED if value is None else TrialState.COMPLETE)
        print(f"Trial {trial.number + 1}: {'pruned' if value is None else value} ({trial.params})", flush=True)


def _mean_score(trial: optuna.Trial, config: TuneConfig, space: SearchSpace) -> float | None:
    """Over the seeds; None where the trial proves worse than the best before them all."""
    goal = Goal.parsed(config.reach)
    scores = []
    for seed in range(config.seeds):
        run = space.config(trial.params, seed, config.out / RUNS / f"{trial.number:04}" / str(seed))
        scores.append(score(run, goal))
        trial.report(scores[-1], len(scores))
        if trial.should_prune():
            return None
    return sum(scores) / len(scores)


def score(run: TrainConfig, goal: Goal) -> float:
    """Train once in a folder for this run alone, and say how good the run was, as `score_of` does."""
    run.tensorboard_log.mkdir(parents=True, exist_ok=True)
    log = (run.tensorboard_log / LOG).open("w", encoding="utf-8")
    with log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
        trained = train(run)
    if trained.signal is not None:
        raise KeyboardInterrupt
    return score_of(read_run(trained.folder), goal, run.n_timesteps)


def score_of(run: Run, goal: Goal, n_timesteps: int) -> float:
    """Logarithm of the primitive steps to the goal, by evaluations if the run made any; without it ``n_timesteps``."""
    curves = run.curves["eval"] or run.curves["rollout"]
    if goal.measure not in curves:
        raise ValueError(f"{run.folder} did not log {goal.measure}: choose --reach {', '.join(curves)}.")
    return math.log(max(1.0, goal.reached(curves[goal.measure]) or n_timesteps))
