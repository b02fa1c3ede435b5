"""Estimates with 95 % confidence intervals."""

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.stats import binomtest, bootstrap, mannwhitneyu, trim_mean

from sb3_options.experience.observations import FloatArray

CONFIDENCE = 0.95
N_RESAMPLES = 9999  # number of bootstrap resamples. A fixed seed gives the same values the same interval.
N_STRATIFIED = 5000  # number of resamples of a stratified bootstrap
N_BANDS = 500  # number of resamples of a curve


class Interval(NamedTuple):
    """An estimate, ``mean``, and the ends of its 95 % confidence interval."""

    mean: float
    low: float
    high: float


Band: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""An estimate at each point, and the ends of its interval, (points,) each."""


def mean_interval(values: FloatArray) -> Interval:
    """Return the mean with a bootstrap interval (bias-corrected and accelerated); a point if all values are equal."""
    mean = float(np.mean(values))
    if len(values) < 2 or np.ptp(values) == 0:
        return Interval(mean, mean, mean)
    result = bootstrap((values,), np.mean, n_resamples=N_RESAMPLES, rng=np.random.default_rng(0)).confidence_interval
    return Interval(mean, float(result.low), float(result.high))


def share_interval(successes: int, n: int) -> Interval:
    """Return a share with its Wilson interval."""
    ci = binomtest(successes, n).proportion_ci(CONFIDENCE, method="wilson")
    return Interval(successes / n, float(ci.low), float(ci.high))


def iqm(values: FloatArray, axis: int = -1) -> Any:
    """Return the interquartile mean, without lowest and highest quarter (Agarwal et al. 2021, §4.3)."""
    return trim_mean(values, 0.25, axis=axis)


def resampled(values: FloatArray, seed: int) -> FloatArray:
    """Draw bootstrap resamples of the runs of one condition, (n_resamples, n)."""
    return values[np.random.default_rng(seed).integers(len(values), size=(N_STRATIFIED, len(values)))]


def interval_of(statistic: float, resamples: FloatArray) -> Interval:
    """Return a statistic with the 95 % percentile interval of its resamples."""
    low, high = np.quantile(resamples, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(float(statistic), float(low), float(high))


def iqm_interval(values: FloatArray) -> Interval:
    """Return the interquartile mean of runs with its interval."""
    return interval_of(iqm(values), iqm(resampled(values, 0)))


def probability_of_improvement(ours: FloatArray, theirs: FloatArray) -> Interval:
    """Return Pr(our run takes fewer steps than theirs), ties counting half (Agarwal et al. 2021, §4.3)."""

    def share(a: FloatArray, b: FloatArray) -> Any:
        return 1.0 - mannwhitneyu(a, b, axis=-1).statistic / (a.shape[-1] * b.shape[-1])

    if min(len(ours), len(theirs)) == 1:
        return Interval(float(share(ours, theirs)), 0.0, 1.0)  # one run says nothing about others
    return interval_of(share(ours, theirs), share(resampled(ours, 0), resampled(theirs, 1)))


def band(curves: FloatArray) -> Band:
    """Return the interquartile mean of (runs, points) at each point, and its 95 % percentile bootstrap interval."""
    drawn = curves[np.random.default_rng(0).integers(len(curves), size=(N_BANDS, len(curves)))]
    low, high = np.quantile(iqm(drawn, axis=1), [0.025, 0.975], axis=0)
    return iqm(curves, axis=0), low, high
