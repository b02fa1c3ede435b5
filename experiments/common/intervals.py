"""Intervals of ratios and differences, which studies report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import bootstrap

from experiments.common.seeds import Result
from sb3_options.experience.observations import FloatArray
from sb3_options.runs.intervals import N_RESAMPLES, Interval, interval_of, iqm, iqm_interval, resampled


def steps_until(runs: Sequence[Result], key: str, most: int) -> dict[str, float]:
    """Interquartile mean of the steps under ``key`` with its interval; a run with None counts ``most``."""
    until = iqm_interval(capped(runs, key, most))
    n_reached = sum(run[key] is not None for run in runs)
    return {"n_runs": len(runs), "n_reached": n_reached, "mean": until.mean, "low": until.low, "high": until.high}


def capped(runs: Sequence[Result], key: str, most: float) -> FloatArray:
    """The steps under ``key``, (n,), ``most`` in the place of None."""
    return np.array([most if run[key] is None else run[key] for run in runs], dtype=np.float64)


def ratio_interval(ours: FloatArray, theirs: FloatArray) -> Interval:
    """Ratio of the means of paired values, with a bootstrap interval over the pairs."""
    ratio = float(ours.mean() / theirs.mean())
    if len(ours) < 2 or np.ptp(ours / theirs) == 0:
        return Interval(ratio, ratio, ratio)
    result = bootstrap(
        (ours, theirs),
        lambda a, b, axis: a.mean(axis=axis) / b.mean(axis=axis),
        paired=True,
        vectorized=True,
        n_resamples=N_RESAMPLES,
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(ratio, float(result.low), float(result.high))


def iqm_ratio(ours: FloatArray, theirs: FloatArray, *, paired: bool = False) -> Interval:
    """Ratio of interquartile means; each side is resampled on its own (stratified bootstrap), or both as pairs."""
    drawn = resampled(ours, 0), resampled(theirs, 0 if paired else 1)  # equal seeds draw equal rows
    return interval_of(iqm(ours) / iqm(theirs), iqm(drawn[0]) / iqm(drawn[1]))


def iqm_difference(ours: FloatArray, theirs: FloatArray) -> Interval:
    """Difference of interquartile means; each side is resampled on its own."""
    return interval_of(iqm(ours) - iqm(theirs), iqm(resampled(ours, 0)) - iqm(resampled(theirs, 1)))
