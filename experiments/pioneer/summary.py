"""The numbers of the robot's figures, for results.json."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.common.curves import by_ten, curves_of, window
from experiments.common.intervals import ratio_interval
from experiments.common.seeds import Result
from experiments.pioneer.settings import TASKS
from sb3_options.envs.pioneer.senses import MAX_WIDTH
from sb3_options.experience.observations import FloatArray
from sb3_options.runs.intervals import mean_interval, share_interval

Groups = Mapping[str, list[Result]]
"""The results of every run, by group."""

DEAD_AHEAD = math.radians(10)
"""A ball this far from the middle is dead ahead, rad."""

NEAR = MAX_WIDTH * 2 / 3
"""A ball this wide is near, rad: the upper third of the range of widths."""

SUCCESS_BAR = 0.9
SUBGOAL_BAR = 0.9

WINDOWS = {"0_19": (0, 19), "20_49": (20, 49), "50_99": (50, 99), "100_199": (100, 199)}
"""Trials, counted from 0, both included."""


def numbers_of(figure: str, groups: Groups) -> dict[str, Any]:
    """Everything that is said of one figure."""
    return {"figure8": _figure8, "learning": _learning, "transfer": _transfer, "dqn": _dqn}[figure](groups)


def is_near_and_ahead(option: Result) -> bool:
    """Whether a subgoal is the paper's: the ball dead ahead and near."""
    found = option["width"] is not None
    return found and abs(option["displacement"]) <= DEAD_AHEAD and option["width"] >= NEAR


def _figure8(groups: Groups) -> dict[str, Any]:
    options = [r["option"] for r in groups["learning"]]
    trials = [o["trial"] for o in options if o["trial"] is not None]
    n = sum(map(is_near_and_ahead, options))
    return {
        "n_runs": len(options),
        "n_found": len(trials),
        "n_near_and_ahead": n,
        "share_near_and_ahead": {
            **share_interval(n, len(options))._asdict(),
            "bar": SUBGOAL_BAR,
            "reached": n >= SUBGOAL_BAR * len(options),
        },
        "median_trial": float(np.median(trials)) if trials else None,
        "subgoals": [{key: o[key] for key in ("displacement", "width")} for o in options],
    }


def _learning(groups: Groups) -> dict[str, Any]:
    runs = groups["learning"]
    columns = {name: [r[name] for r in runs] for name in ("primitive", "discovery")}
    numbers: dict[str, Any] = {"ratios": ratios_of(columns["discovery"], columns["primitive"])}
    for name, results in columns.items():
        played = [r[f"{name}_evaluation"] for r in runs]
        found = [curves_of(played, column).mean(axis=1) for column in ("successes", "steps", "touches")]
        numbers[name] = {**_by_ten(results), "evaluation": _evaluation(*found)}
    return numbers


def _transfer(groups: Groups) -> dict[str, Any]:
    numbers: dict[str, Any] = {"n_runs": len(groups["transfer"])}
    for task in TASKS:
        columns = {name: [r[task][name] for r in groups["transfer"]] for name in ("primitive", "option")}
        numbers[task] = {"ratios": ratios_of(columns["option"], columns["primitive"])}
        numbers[task] |= {name: _by_ten(results) for name, results in columns.items()}
    return numbers


def _dqn(groups: Groups) -> dict[str, Any]:
    """Ratios are of the primitive steps that the first trials took together, as many as every run has."""
    runs = groups["dqn"]
    columns = {name: [r[name] for r in runs] for name in ("primitive", "discovery")}
    ours, theirs = _equally_long([c["steps"] for c in columns["discovery"]], [c["steps"] for c in columns["primitive"]])
    n = ours.shape[1]
    windows = {f"0_{last}": (0, last) for last in (49, 99, 199, 499) if last < n}
    numbers: dict[str, Any] = {
        "n_runs": len(runs),
        "ratios": {
            f"steps_trials_{name}": ratio_interval(window(ours, *w), window(theirs, *w))._asdict()
            for name, w in windows.items()
        },
    }
    for name, results in columns.items():
        found = [np.array([r[k] for r in results]) for k in ("success_rate", "evaluation_steps", "evaluation_touches")]
        numbers[name] = {"evaluation": _evaluation(*found)}
    return numbers


def _equally_long(*groups: list[list[int]]) -> tuple[FloatArray, ...]:
    """Lists of different lengths as arrays, cut to the shortest of all."""
    n = min(len(steps) for group in groups for steps in group)
    return tuple(np.array([steps[:n] for steps in group], dtype=np.float64) for group in groups)


def ratios_of(ours: list[Result], theirs: list[Result]) -> dict[str, Any]:
    """Of primitive steps in windows of trials, and in all of them."""
    steps, base = curves_of(ours, "steps"), curves_of(theirs, "steps")
    n = base.shape[1]
    windows = {name: w for name, w in WINDOWS.items() if w[1] < n} | {"all": (0, n - 1)}
    return {
        f"steps_trials_{name}": ratio_interval(window(steps, *w), window(base, *w))._asdict()
        for name, w in windows.items()
    }


def _by_ten(results: list[Result]) -> dict[str, Any]:
    return {f"{column}_by_ten_trials": by_ten(curves_of(results, column)) for column in ("steps", "returns", "touches")}


def _evaluation(success: FloatArray, steps: FloatArray, touches: FloatArray) -> dict[str, Any]:
    """From the means of every run, shapes (runs,)."""
    return {
        "success_rate": {
            **mean_interval(success)._asdict(),
            "worst_run": float(success.min()),
            "bar": SUCCESS_BAR,
            "reached": bool(success.mean() >= SUCCESS_BAR),
        },
        "steps": mean_interval(steps)._asdict(),
        "touches": mean_interval(touches)._asdict(),
    }
