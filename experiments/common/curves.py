"""Curves over trials: windows, means and ratios, with bootstrap intervals over runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from experiments.common.seeds import Result
from sb3_options.experience.observations import FloatArray
from sb3_options.runs.intervals import CONFIDENCE, Band, mean_interval

N_CURVE_RESAMPLES = 2000


def curves_of(results: Sequence[Result], column: str) -> FloatArray:
    """A column of every trial, shape (runs, trials)."""
    return np.array([r[column] for r in results], dtype=np.float64)


def window(curves: FloatArray, first: int, last: int) -> FloatArray:
    """Mean over trials first … last of each run, (runs, trials) → (runs,); over the last trial if there are fewer."""
    chosen = curves[:, first : last + 1]
    means: FloatArray = (chosen if chosen.shape[1] else curves[:, -1:]).mean(axis=1)
    return means


def curve_interval(curves: FloatArray) -> Band:
    """Mean of (runs, trials) for each trial, and its 95 % percentile bootstrap interval."""
    n = len(curves)
    weights = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), size=N_CURVE_RESAMPLES) / n
    low, high = np.quantile(weights @ curves, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], axis=0)
    return curves.mean(axis=0), low, high


def draw_band(axes: Axes, x: npt.ArrayLike, band: Band, colour: str, label: str) -> None:
    """A curve with its interval."""
    middle, low, high = band
    axes.plot(x, middle, color=colour, linewidth=1.2, label=label)
    axes.fill_between(x, low, high, color=colour, alpha=0.25, linewidth=0)


def by_ten(curves: FloatArray) -> list[dict[str, float]]:
    """Mean steps of trials 0–9, 10–19, …, each with its interval over runs."""
    means = []
    for first in range(0, curves.shape[1], 10):
        interval = mean_interval(window(curves, first, first + 9))
        means.append({"first_trial": first, **interval._asdict()})
    return means
