"""Numbers of the study: interquartile means, stratified bootstrap intervals, areas, probability of improvement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import mannwhitneyu, trim_mean

from experiments.common.seeds import Result
from experiments.deep.agents import reached_at
from sb3_options.experience.observations import FloatArray
from sb3_options.runs.intervals import CONFIDENCE, Interval, mean_interval, ratio_interval

N_RESAMPLES = 5000
GRID = 500
"""Curves are compared every so many primitive steps."""


def iqm(values: FloatArray, axis: int = -1) -> Any:
    """Interquartile mean: the mean without the lowest and the highest quarter (Agarwal et al. 2021, §4.3)."""
    return trim_mean(values, 0.25, axis=axis)


def resampled(values: FloatArray, seed: int) -> FloatArray:
    """Bootstrap resamples of the runs of one condition, (n_resamples, n)."""
    rng = np.random.default_rng(seed)
    drawn: FloatArray = values[rng.integers(len(values), size=(N_RESAMPLES, len(values)))]
    return drawn


def interval_of(statistic: float, resamples: FloatArray) -> Interval:
    """With the 95 % percentile interval of its resamples."""
    low, high = np.quantile(resamples, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(float(statistic), float(low), float(high))


def iqm_interval(values: FloatArray) -> Interval:
    """Interquartile mean of some runs with its interval."""
    return interval_of(iqm(values), iqm(resampled(values, 0)))


def iqm_ratio(ours: FloatArray, theirs: FloatArray) -> Interval:
    """Ratio of interquartile means; each side is resampled on its own (stratified bootstrap)."""
    return interval_of(iqm(ours) / iqm(theirs), iqm(resampled(ours, 0)) / iqm(resampled(theirs, 1)))


def iqm_difference(ours: FloatArray, theirs: FloatArray) -> Interval:
    """Difference of interquartile means; each side is resampled on its own."""
    return interval_of(iqm(ours) - iqm(theirs), iqm(resampled(ours, 0)) - iqm(resampled(theirs, 1)))


def probability_of_improvement(ours: FloatArray, theirs: FloatArray) -> Interval:
    """Pr(a run of ours takes fewer steps than one of theirs), ties counting half (Agarwal et al. 2021, §4.3)."""

    def share(a: FloatArray, b: FloatArray) -> Any:
        return 1.0 - mannwhitneyu(a, b, axis=-1).statistic / (a.shape[-1] * b.shape[-1])

    return interval_of(share(ours, theirs), share(resampled(ours, 0), resampled(theirs, 1)))


def steps_to_success(result: Result, n_timesteps: int) -> float:
    """Primitive steps until the success rate was `REACHED`; the length of training where it never was."""
    reached = reached_at(result["steps"], result["success"])
    return float(n_timesteps if reached is None else reached)


def curve(result: Result, n_timesteps: int) -> FloatArray:
    """Success rate on the grid, from the last evaluation before each point; a run that was stopped keeps its last."""
    return curve_at(result["steps"], result["success"], np.arange(0, n_timesteps + 1, GRID))


def curve_at(when: Sequence[float], success: Sequence[float], at: npt.NDArray[Any]) -> FloatArray:
    """Success rate at some points, from the last evaluation before each.

    Args:
        when: Of each evaluation, in primitive steps or seconds.
        success: Its success rate.
        at: The points, in the same unit.
    """
    last = np.searchsorted(when, at, side="right") - 1
    values: FloatArray = np.asarray(success)[np.maximum(last, 0)]
    return values


def summarise(runs: dict[str, Sequence[Result]], n_timesteps: int) -> dict[str, Any]:
    """All numbers of one task and algorithm.

    Args:
        runs: By arm; ``stock`` is what the others are compared with.
        n_timesteps: Longest training.

    Returns:
        By arm: ``n_runs``; ``steps_to_90`` and ``area`` (mean success rate over training), interquartile means;
        ``never`` (runs that never got there); ``final_steps``, ``final_success``; and, but for stock,
        ``steps_to_90_of_stock``, ``area_difference``, ``probability_of_improvement``, ``final_steps_of_stock``.
    """
    measured = {arm: _measures(results, n_timesteps) for arm, results in runs.items() if results}
    stock = measured.get("stock")
    summary: dict[str, Any] = {}
    for arm, of in measured.items():
        numbers: dict[str, Any] = {
            "n_runs": len(of["steps"]),
            "never": int((of["steps"] >= n_timesteps).sum()),
            "steps_to_90": iqm_interval(of["steps"])._asdict(),
            "mean_steps_to_90": mean_interval(of["steps"])._asdict(),
            "area": iqm_interval(of["area"])._asdict(),
            "final_steps": mean_interval(of["final"])._asdict(),
            "final_success": float(of["final_success"].mean()),
            "with_option": sum(bool(r["options"] or r.get("brought")) for r in runs[arm]),
        }
        if stock is not None and arm != "stock":
            paired = min(len(of["final"]), len(stock["final"]))
            numbers |= {
                "steps_to_90_of_stock": iqm_ratio(of["steps"], stock["steps"])._asdict(),
                "area_difference": iqm_difference(of["area"], stock["area"])._asdict(),
                "probability_of_improvement": probability_of_improvement(of["steps"], stock["steps"])._asdict(),
                "final_steps_of_stock": ratio_interval(of["final"][:paired], stock["final"][:paired])._asdict(),
            }
        summary[arm] = numbers
    return summary


def _measures(results: Sequence[Result], n_timesteps: int) -> dict[str, FloatArray]:
    measures: dict[str, Callable[[Result], float]] = {
        "steps": lambda r: steps_to_success(r, n_timesteps),
        "area": lambda r: float(curve(r, n_timesteps).mean()),
        "final": lambda r: r["final_length"],
        "final_success": lambda r: r["final_success"],
    }
    return {name: np.array([measure(r) for r in results]) for name, measure in measures.items()}
