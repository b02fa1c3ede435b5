"""The numbers of the study, for results.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import ks_2samp, ttest_ind

from experiments.common.seeds import Result
from sb3_options.runs.intervals import mean_interval

Summary = dict[str, dict[str, Any]]


def summarise(results: Mapping[str, Sequence[Result]]) -> Summary:
    """Each arm's final return, and how it differs from stock's.

    Args:
        results: By "algorithm, arm".

    Returns:
        By the same names: ``final_return`` with its 95 % interval; but for stock also ``difference`` of the means with
        Welch's 95 % interval, and ``p_same`` of the Kolmogorov-Smirnov test that both have the same distribution.
    """
    summary: Summary = {}
    for name, runs in results.items():
        algorithm, arm = name.split(", ")
        final = _final(runs)
        summary[name] = {"n_runs": len(runs), "final_return": mean_interval(final)._asdict()}
        if arm == "stock":
            continue
        stock = _final(results[f"{algorithm}, stock"])
        interval = ttest_ind(final, stock, equal_var=False).confidence_interval()
        difference = {"mean": final.mean() - stock.mean(), "low": interval.low, "high": interval.high}
        summary[name]["difference"] = {key: float(value) for key, value in difference.items()}
        summary[name]["p_same"] = float(ks_2samp(final, stock).pvalue)
    return summary


def _final(runs: Sequence[Result]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([run["final_return"] for run in runs])
