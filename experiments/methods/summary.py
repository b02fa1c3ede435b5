"""The numbers of the race, for results.json."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.common.intervals import iqm_ratio, ratio_interval
from experiments.common.seeds import Result
from experiments.methods.entrants import NONE
from sb3_options.experience.observations import FloatArray
from sb3_options.runs.intervals import (
    Interval,
    interval_of,
    iqm,
    iqm_interval,
    mean_interval,
    resampled,
    share_interval,
)

PHASES = ("same", "moved")

RIVALS = {"of_primitives": NONE, "of_random": "random", "of_diverse_density": "diverse-density"}
"""Whose steps others' are divided by: no options, the control that others have to be better than, and the default."""


def summarise(runs: Mapping[str, Sequence[Result]], n_timesteps: int) -> dict[str, dict[str, Any]]:
    """All numbers of one task and learner.

    Args:
        runs: By entrant, the same seeds in the same order; `NONE` is what the others are compared with, if it is there.
        n_timesteps: Longest training, which counts where the criterion was never met.

    Returns:
        By entrant: ``n_runs``; ``found``, subgoals a run; ``near``, the share of them at a bottleneck; ``reached``, the
        share of option runs that reach their subgoal; ``same`` and ``moved``, each with ``steps`` to the criterion and
        to the ``first_success`` and ``second_success`` in training (interquartile means), ``never``, how many runs did
        not meet the criterion, ``of_primitives``, the ratio to the steps of `NONE`, and the ratios to the other
        `RIVALS`;
        ``discovery_seconds`` and ``discovery_share`` of training in the same task, in processor time. Each with its 95
        % interval; None where there is nothing to estimate.
    """
    steps = {
        entrant: {phase: np.array([steps_of(run[phase], n_timesteps) for run in of]) for phase in PHASES}
        for entrant, of in runs.items()
    }
    summary: dict[str, dict[str, Any]] = {}
    for entrant, of in runs.items():
        found = _column(of, lambda run: len(run["found"]))
        judged = _column(of, lambda run: sum(each["near"] is not None for each in run["found"]))
        summary[entrant] = {
            "n_runs": len(of),
            "found": mean_interval(found)._asdict(),
            "near": _share(_column(of, lambda run: sum(bool(each["near"]) for each in run["found"])), judged),
            "reached": _share(
                _column(of, lambda run: _both(run, "reached")), _column(of, lambda run: _both(run, "decided"))
            ),
            "discovery_seconds": mean_interval(_column(of, lambda run: run["same"]["discovery"]))._asdict(),
            "discovery_share": _share(
                _column(of, lambda run: run["same"]["discovery"]), _column(of, lambda run: run["same"]["seconds"])
            ),
        }
        for phase in PHASES:
            taken = steps[entrant][phase]
            summary[entrant][phase] = {
                "steps": iqm_interval(taken)._asdict(),
                **_successes([run[phase] for run in of], n_timesteps),
                "never": sum(run[phase]["steps"] is None for run in of),
                **{name: _ratio(steps, phase, entrant, rival) for name, rival in RIVALS.items()},
            }
    return summary


def over_tasks(runs: Mapping[str, Sequence[Result]], lengths: Mapping[str, int]) -> dict[str, dict[str, Any]]:
    """One number for each phase: the ratio of steps to those of others, the geometric mean over all tasks.

    Args:
        runs: By "task, learner, entrant", as ``results.json`` has them.
        lengths: Of the longest training, by "task, learner".

    Returns:
        By learner that ran with `NONE`, then by entrant that ran in all its tasks, fewest steps in the same task first:
        ``n_runs``, and of each phase ``of_primitives`` and likewise the other `RIVALS`, whose 95 % intervals resample
        runs within tasks, and ``never``, how many runs did not meet the criterion.
    """
    tasks: dict[str, list[str]] = {}
    for name in lengths:
        task, learner = name.rsplit(", ", 1)
        tasks.setdefault(learner, []).append(task)
    found: dict[str, dict[str, Any]] = {}
    for learner, of in tasks.items():
        entrants = list(dict.fromkeys(name.rsplit(", ", 1)[1] for name in runs))
        everywhere = [e for e in entrants if all(f"{task}, {learner}, {e}" in runs for task in of)]
        if NONE in everywhere:
            cells = {e: [runs[f"{task}, {learner}, {e}"] for task in of] for e in everywhere}
            longest = [lengths[f"{task}, {learner}"] for task in of]
            means = {e: _over_tasks(e, cells, longest) for e in everywhere}
            found[learner] = dict(sorted(means.items(), key=lambda each: each[1]["same"]["of_primitives"]["mean"]))
    return found


def _over_tasks(entrant: str, cells: Mapping[str, Sequence[Sequence[Result]]], longest: Sequence[int]) -> Any:
    """What `over_tasks` has of one entrant; ``cells`` are the runs of all by entrant and task, the same seeds."""
    means: dict[str, Any] = {"n_runs": sum(map(len, cells[entrant]))}
    for phase in PHASES:
        steps = {
            e: [np.array([steps_of(run[phase], n) for run in of]) for of, n in zip(tasks, longest, strict=True)]
            for e, tasks in cells.items()
        }
        means[phase] = {
            **{
                name: None if rival not in cells else _geometric(steps[entrant], steps[rival])._asdict()
                for name, rival in RIVALS.items()
            },
            "never": sum(run[phase]["steps"] is None for of in cells[entrant] for run in of),
        }
    return means


def _geometric(ours: Sequence[FloatArray], theirs: Sequence[FloatArray]) -> Interval:
    """Geometric mean over tasks of the ratios of interquartile means; runs with the same seed are pairs."""
    logs = [np.log(iqm(our) / iqm(their)) for our, their in zip(ours, theirs, strict=True)]
    drawn = [  # with the same seed, which is another for each task, the same rows of both are drawn
        np.log(iqm(resampled(our, i)) / iqm(resampled(their, i)))
        for i, (our, their) in enumerate(zip(ours, theirs, strict=True))
    ]
    return interval_of(np.exp(np.mean(logs)), np.exp(np.mean(drawn, axis=0)))


def _ratio(
    steps: Mapping[str, Mapping[str, FloatArray]], phase: str, entrant: str, other: str
) -> dict[str, float] | None:
    """Of the steps of an entrant to those of another in the same runs."""
    if other not in steps or entrant == other:
        return None
    return iqm_ratio(steps[entrant][phase], steps[other][phase], paired=True)._asdict()


def steps_of(trained: Result, n_timesteps: int) -> float:
    """Primitive steps to the criterion; the length of training where it was not met."""
    return float(n_timesteps if trained["steps"] is None else trained["steps"])


def _successes(trained: Sequence[Result], n_timesteps: int) -> dict[str, dict[str, float] | None]:
    """Primitive steps to the first two successes in training, or to the criterion where it was met before.

    None of results from before these were noted.
    """
    found: dict[str, dict[str, float] | None] = {"first_success": None, "second_success": None}
    if all("successes" in each for each in trained):
        for i, name in enumerate(found):
            steps = [min([steps_of(each, n_timesteps), *each["successes"][i : i + 1]]) for each in trained]
            found[name] = iqm_interval(np.array(steps, dtype=np.float64))._asdict()
    return found


def _both(run: Result, what: str) -> float:
    return float(sum(run[phase][what] for phase in PHASES))


def _column(runs: Sequence[Result], value: Callable[[Result], float]) -> FloatArray:
    return np.array([value(run) for run in runs], dtype=np.float64)


def _share(part: FloatArray, whole: FloatArray) -> dict[str, float] | None:
    """Σ part / Σ whole with its interval over runs; None where there is nothing to share.

    Where the share is 0 or 1 in all runs, it is Wilson's of so many runs: resamples of them would all be the same.
    """
    there = whole > 0
    if not there.any():
        return None
    if (part[there] == whole[there]).all() or not part[there].any():
        return share_interval(int(there.sum()) if part[there].any() else 0, int(there.sum()))._asdict()
    return ratio_interval(part[there], whole[there])._asdict()
