"""A search with Optuna whose trials are the same runs with other settings; interrupted, it goes on where it was.

Trials are in a journal file. TPE proposes, and Wilcoxon's test stops a trial whose runs so far are worse, run by run,
than those of the best one.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from rich.console import Console
from rich.markup import escape

JOURNAL = "trials.log"
NAME = "settings"
"""Of the study in the journal."""

N_RANDOM = 8
"""Trials that are drawn at random before Optuna's TPE proposes."""

P_THRESHOLD = 0.1
"""A trial stops where its runs are worse than those of the best one with this p-value (Wilcoxon's test, paired)."""

N_BEFORE = 4
"""Runs of a trial before it may be stopped: with fewer the test says nothing."""

N_FAILED = 3
"""Trials that end a search where no other was completed."""

Scores: TypeAlias = Callable[[str, dict[str, Any]], Iterator[float]]
"""The name of a trial, for its files, and the proposed settings → the score of one run after the other."""


def choices(values: Sequence[Any]) -> CategoricalDistribution:
    """A few values, which have no order. Optuna stores them as JSON, for lists have no hash."""
    return CategoricalDistribution([json.dumps(value) for value in values])


@dataclass(frozen=True)
class Search:
    """What is searched for, and how long.

    Attributes:
        out: Folder for the journal.
        space: Optuna's distributions by the name of the setting; of `choices`, where they are categorical.
        scores: Runs of a trial. Those of all trials have the same order, for they are compared one by one.
        trials: How many are wanted, earlier ones included.
        minimise: Whether a lower score is better.
        seed: Of what is proposed.
        asked: What tells this search from another one, by its name on the command line.
        shown: How a mean score is written.
    """

    out: Path
    space: Mapping[str, BaseDistribution]
    scores: Scores
    trials: int
    minimise: bool = True
    seed: int = 0
    asked: dict[str, Any] = field(default_factory=dict)
    shown: Callable[[float], str] = "{:.3g}".format


def opened(search: Search, job: int = 0) -> optuna.Study:
    """The search that is in the folder, or a new one.

    Args:
        search: Which.
        job: Number of the process. Only the first gives trials back that an earlier command did not end.

    Raises:
        ValueError: The folder holds another search.
        OSError: The journal cannot be written.
    """
    search.out.mkdir(parents=True, exist_ok=True)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        study = optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(search.out / JOURNAL))),
            study_name=NAME,
            pruner=optuna.pruners.WilcoxonPruner(p_threshold=P_THRESHOLD, n_startup_steps=N_BEFORE),
            direction="minimize" if search.minimise else "maximize",
            load_if_exists=True,
        )
        # A search that goes on draws other settings than it began with, and so do processes that work at the same time.
        seed = search.seed + len(study.trials) + 10_000 * job
        study.sampler = optuna.samplers.TPESampler(
            seed=seed, n_startup_trials=N_RANDOM, multivariate=True, constant_liar=True
        )
    if job > 0:
        return study
    for name, value in study.user_attrs.get("asked", search.asked).items():
        if value != search.asked[name]:
            raise ValueError(
                f"{search.out} holds a search with {name} {value!r}, not {search.asked[name]!r}. Give another --out."
            )
    study.set_user_attr("asked", search.asked)
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        study.enqueue_trial(trial.params)
        study.tell(trial.number, state=TrialState.FAIL)
    return study


def work(study: optuna.Study, search: Search, console: Console) -> None:
    """Try one set of settings after another until there are enough.

    Raises:
        ValueError: The first trials failed, or as many as are wanted.
    """
    counted = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.RUNNING)
    while len(study.get_trials(deepcopy=False, states=counted)) < search.trials:
        trial = study.ask(dict(search.space))
        state = TrialState.COMPLETE
        value = None
        try:
            value = _mean_score(trial, search)
            text = search.shown(value)
        except optuna.TrialPruned:
            state = TrialState.PRUNED
            text = "stopped, for it is worse than the best"
        except Exception as error:
            state = TrialState.FAIL
            text = f"failed: {error}"
            trial.set_user_attr("failed", str(error))
        study.tell(trial, value, state=state)
        settings = ", ".join(f"{name} {short(of)}" for name, of in trial.params.items())
        console.print(escape(f"Trial {trial.number + 1}: {text} ({settings})"))
        _check_failures(study, search)


def _mean_score(trial: optuna.Trial, search: Search) -> float:
    scores: list[float] = []
    for score in search.scores(place_of(trial), values_of(trial, search)):
        scores.append(score)
        trial.report(score, len(scores))
        if trial.should_prune():
            raise optuna.TrialPruned
    return sum(scores) / len(scores)


def _check_failures(study: optuna.Study, search: Search) -> None:
    """End a search that leads nowhere."""
    trials = study.get_trials(deepcopy=False)
    failures = [trial.user_attrs["failed"] for trial in trials if "failed" in trial.user_attrs]
    completed = any(trial.state in (TrialState.COMPLETE, TrialState.PRUNED) for trial in trials)
    if len(failures) >= (max(N_RANDOM, search.trials) if completed else N_FAILED):
        raise ValueError(f"{len(failures)} trials failed. The last one: {failures[-1]}")


def best_of(study: optuna.Study, search: Search) -> tuple[str, dict[str, Any]]:
    """The name of the best trial, and its settings.

    Raises:
        ValueError: None was completed.
    """
    if not study.get_trials(states=(TrialState.COMPLETE,)):
        raise ValueError("No trial was completed.")
    return place_of(study.best_trial), values_of(study.best_trial, search)


def values_of(trial: optuna.Trial | FrozenTrial, search: Search) -> dict[str, Any]:
    """What Optuna stored, as settings."""
    categorical = {name for name, of in search.space.items() if isinstance(of, CategoricalDistribution)}
    return {name: json.loads(value) if name in categorical else value for name, value in trial.params.items()}


def place_of(trial: optuna.Trial | FrozenTrial) -> str:
    """The name of a trial, for its files."""
    return f"{trial.number:04}"


def short(value: Any) -> str:
    """A setting, to be read."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)
