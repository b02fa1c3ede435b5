"""A search with Optuna whose trials are the same runs with other settings; interrupted, it goes on where it was.

Trials are in a journal file, which several commands may share; what ends early is tried again. TPE proposes, and
Wilcoxon's test stops a trial whose runs so far are worse, run by run, than those of the best one.
"""

from __future__ import annotations

import json
import os
import re
import socket
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from rich.console import Console
from rich.markup import escape

from sb3_options.runs.scored import RunFailedError
from sb3_options.runs.search_space import Choices, Range, Value

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
"""Trials that end a search where there are no others: all of them failed, for the same reason."""

Scores: TypeAlias = Callable[[str, dict[str, Value]], Iterator[float]]
"""The name of a trial, for its files, and the proposed settings → the score of one run after the other."""


@dataclass(frozen=True)
class Search:
    """What is searched for, and how long.

    Attributes:
        out: Folder for the journal.
        space: Ranges and choices by the name of the setting.
        scores: Runs of a trial. Those of all trials have the same order, for they are compared one by one. May raise
            ValueError or RunFailedError, where the settings are at fault.
        trials: How many are wanted, those that are there included.
        minimise: Whether a lower score is better.
        seed: Of what is proposed.
        asked: What tells this search from another one, by its name on the command line.
        shown: How a mean score is written.
    """

    out: Path
    space: Mapping[str, Range | Choices]
    scores: Scores
    trials: int
    minimise: bool = True
    seed: int = 0
    asked: dict[str, Any] = field(default_factory=dict)
    shown: Callable[[float], str] = "{:.3g}".format


def opened(search: Search) -> optuna.Study:
    """The search that is in the folder, or a new one.

    Raises:
        ValueError: There is another one.
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
        # A search that goes on draws other settings than it began with.
        study.sampler = optuna.samplers.TPESampler(
            seed=search.seed + len(study.trials), n_startup_trials=N_RANDOM, multivariate=True, constant_liar=True
        )
    for name, value in study.user_attrs.get("asked", search.asked).items():
        if value != search.asked[name]:
            raise ValueError(
                f"{search.out} holds a search with {name} {value!r}, not {search.asked[name]!r}. Give another --out."
            )
    study.set_user_attr("asked", search.asked)
    _try_again(study)
    return study


class FirstTrialsFailedError(ValueError):
    """The first trials failed for the same reason, as others would."""


def work(study: optuna.Study, search: Search, console: Console) -> None:
    """Try one set of settings after another until there are enough.

    Raises:
        FirstTrialsFailedError: The first trials failed for the same reason.
        ValueError: Time and again a trial failed.
    """
    counted = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.RUNNING)
    while len(study.get_trials(deepcopy=False, states=counted)) < search.trials:
        trial = study.ask()
        trial.set_user_attr("by", [socket.gethostname(), os.getpid()])
        params = {name: suggested(trial, name, of) for name, of in search.space.items()}
        state, value, said = TrialState.COMPLETE, None, ""
        try:
            value = _mean_score(trial, search, params)
            said = search.shown(value)
        except optuna.TrialPruned:
            state, said = TrialState.PRUNED, "stopped, for it is worse than the best"
        except (ValueError, RunFailedError) as error:
            state, said = TrialState.FAIL, f"failed: {error}"
            trial.set_user_attr("failed", str(error))
        study.tell(trial, value, state=state)
        number = f"Trial {trial.number + 1}"
        if trial.number < search.trials:  # others are in place of what failed
            number += f" of {search.trials}"
        console.print(escape(f"{number}: {said} ({', '.join(f'{name} {short(of)}' for name, of in params.items())})"))
        _check_failures(study, search)


def _check_failures(study: optuna.Study, search: Search) -> None:
    """End a search that leads nowhere.

    Raises:
        ValueError: It does.
    """
    trials = study.get_trials(deepcopy=False)
    failures = [trial for trial in trials if "failed" in trial.user_attrs]
    last = failures[-N_FAILED:]
    if len(last) < N_FAILED:
        return
    why = last[-1].user_attrs["failed"]
    came_to_an_end = any(trial.state in (TrialState.COMPLETE, TrialState.PRUNED) for trial in trials)
    if not came_to_an_end and len({_reason(trial) for trial in last}) == 1:
        raise FirstTrialsFailedError(f"The first {len(failures)} trials all failed, and for the same reason: {why}")
    if len(failures) >= (max(N_RANDOM, search.trials) if came_to_an_end else search.trials):
        raise ValueError(f"{len(failures)} trials failed. The last one: {why}")


def _reason(trial: FrozenTrial) -> str:
    """Why a trial failed, without the files that are its own."""
    return re.sub(rf"{re.escape(_place(trial))}\S*", "", trial.user_attrs["failed"])


def best_of(study: optuna.Study, search: Search) -> tuple[str, dict[str, Value]]:
    """The name of the best trial, and its settings.

    Raises:
        ValueError: None was completed.
    """
    if not study.get_trials(states=(TrialState.COMPLETE,)):
        failed = [trial.user_attrs["failed"] for trial in study.trials if "failed" in trial.user_attrs]
        raise ValueError(" ".join(["No trial was completed.", *failed[-1:]]))
    return _place(study.best_trial), _values(search, study.best_params)


def suggested(trial: optuna.Trial, name: str, of: Range | Choices) -> Any:
    """What Optuna proposes for a setting, as it stores it."""
    if isinstance(of, Choices):
        return trial.suggest_categorical(name, of.names)
    if of.whole:
        return trial.suggest_int(name, int(of.low), int(of.high), step=int(of.step or 1), log=of.log)
    return trial.suggest_float(name, of.low, of.high, step=of.step, log=of.log)


def short(value: Any) -> str:
    """A setting, to be read."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _mean_score(trial: optuna.Trial, search: Search, params: dict[str, Any]) -> float:
    scores: list[float] = []
    for score in search.scores(_place(trial), _values(search, params)):
        scores.append(score)
        trial.report(score, len(scores))
        if trial.should_prune():
            raise optuna.TrialPruned
    return sum(scores) / len(scores)


def _values(search: Search, params: dict[str, Any]) -> dict[str, Value]:
    """What Optuna stored, as settings."""
    return {name: json.loads(v) if isinstance(search.space[name], Choices) else v for name, v in params.items()}


def _try_again(study: optuna.Study) -> None:
    """Give back what commands on this machine were at when they ended, with the runs that they had finished."""
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        host, pid = trial.user_attrs.get("by", (socket.gethostname(), 0))
        if host == socket.gethostname() and pid != os.getpid() and not _is_there(pid):
            study.enqueue_trial(trial.params, user_attrs={"place": _place(trial)})
            study.tell(trial.number, state=TrialState.FAIL)


def _is_there(pid: int) -> bool:
    if pid == 0:
        return False
    if os.name != "posix":
        return True  # there a signal of 0 would end it
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _place(trial: optuna.Trial | FrozenTrial) -> str:
    return str(trial.user_attrs.get("place", f"{trial.number:04}"))
