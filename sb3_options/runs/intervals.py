"""Estimates with 95 % confidence intervals."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.stats import binomtest, bootstrap, mannwhitneyu, trim_mean

from sb3_options.experience.observations import FloatArray

CONFIDENCE = 0.95
N_RESAMPLES = 9999
"""Bootstrap resamples; their generator is seeded, so that the same values have the same interval."""


N_STRATIFIED = 5000
"""Resamples of a stratified bootstrap."""

N_BANDS = 500
"""Resamples of a curve."""


class Interval(NamedTuple):
    """An estimate with its confidence interval.

    Attributes:
        mean: The estimate.
        low: Lower end of the 95 % interval.
        high: Upper end.
    """

    mean: float
    low: float
    high: float


Band: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""An estimate at each point, and the ends of its interval, (points,) each."""


def mean_interval(values: FloatArray) -> Interval:
    """Mean with a bootstrap interval (bias-corrected and accelerated); a point where all values are equal."""
    mean = float(np.mean(values))
    if len(values) < 2 or np.ptp(values) == 0:
        return Interval(mean, mean, mean)
    return _bootstrapped(mean, (values,), np.mean)


def ratio_interval(ours: FloatArray, theirs: FloatArray) -> Interval:
    """Ratio of the means of paired values, with a bootstrap interval over the pairs."""
    ratio = float(ours.mean() / theirs.mean())
    if len(ours) < 2 or np.ptp(ours / theirs) == 0:
        return Interval(ratio, ratio, ratio)
    return _bootstrapped(
        ratio, (ours, theirs), lambda a, b, axis: a.mean(axis=axis) / b.mean(axis=axis), paired=True, vectorized=True
    )


def share_interval(successes: int, n: int) -> Interval:
    """Share with a Wilson interval."""
    ci = binomtest(successes, n).proportion_ci(CONFIDENCE, method="wilson")
    return Interval(successes / n, float(ci.low), float(ci.high))


def iqm(values: FloatArray, axis: int = -1) -> Any:
    """Interquartile mean: the mean without the lowest and the highest quarter (Agarwal et al. 2021, §4.3)."""
    return trim_mean(values, 0.25, axis=axis)


def resampled(values: FloatArray, seed: int) -> FloatArray:
    """Bootstrap resamples of the runs of one condition, (n_resamples, n)."""
    rng = np.random.default_rng(seed)
    drawn: FloatArray = values[rng.integers(len(values), size=(N_STRATIFIED, len(values)))]
    return drawn


def interval_of(statistic: float, resamples: FloatArray) -> Interval:
    """With the 95 % percentile interval of its resamples."""
    low, high = np.quantile(resamples, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(float(statistic), float(low), float(high))


def iqm_interval(values: FloatArray) -> Interval:
    """Interquartile mean of some runs with its interval."""
    return interval_of(iqm(values), iqm(resampled(values, 0)))


def iqm_ratio(ours: FloatArray, theirs: FloatArray, *, paired: bool = False) -> Interval:
    """Ratio of interquartile means; each side is resampled on its own (stratified bootstrap), or both as pairs."""
    drawn = resampled(ours, 0), resampled(theirs, 0 if paired else 1)  # equal seeds draw equal rows
    return interval_of(iqm(ours) / iqm(theirs), iqm(drawn[0]) / iqm(drawn[1]))


def iqm_difference(ours: FloatArray, theirs: FloatArray) -> Interval:
    """Difference of interquartile means; each side is resampled on its own."""
    return interval_of(iqm(ours) - iqm(theirs), iqm(resampled(ours, 0)) - iqm(resampled(theirs, 1)))


def probability_of_improvement(ours: FloatArray, theirs: FloatArray) -> Interval:
    """Pr(a run of ours takes fewer steps than one of theirs), ties counting half (Agarwal et al. 2021, §4.3)."""

    def share(a: FloatArray, b: FloatArray) -> Any:
        return 1.0 - mannwhitneyu(a, b, axis=-1).statistic / (a.shape[-1] * b.shape[-1])

    return interval_of(share(ours, theirs), share(resampled(ours, 0), resampled(theirs, 1)))


def band(curves: FloatArray) -> Band:
    """Interquartile mean of (runs, points) at each point, and its 95 % percentile bootstrap interval."""
    rng = np.random.default_rng(0)
    drawn = curves[rng.integers(len(curves), size=(N_BANDS, len(curves)))]
    low, high = np.quantile(iqm(drawn, axis=1), [0.025, 0.975], axis=0)
    return iqm(curves, axis=0), low, high


def _bootstrapped(estimate: float, samples: tuple[FloatArray, ...], statistic: Any, **kwargs: Any) -> Interval:
    result = bootstrap(
        samples,
        statistic,
        confidence_level=CONFIDENCE,
        n_resamples=N_RESAMPLES,
        rng=np.random.default_rng(0),
        **kwargs,
    )
    return Interval(estimate, float(result.confidence_interval.low), float(result.confidence_interval.high))
