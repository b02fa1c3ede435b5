"""Estimates with 95 % confidence intervals."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binomtest, bootstrap

from sb3_options.experience.observations import FloatArray

CONFIDENCE = 0.95
N_RESAMPLES = 9999
"""Bootstrap resamples; their generator is seeded, so that the same values have the same interval."""


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
