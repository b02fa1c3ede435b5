"""The numbers of the study, for results.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.common.seeds import Result
from experiments.random_walks.summary import summarise as summarise_subgoals


def summarise(results: Mapping[str, Sequence[Result]]) -> dict[str, dict[str, Any]]:
    """What `random_walks.summary` says of the subgoals, and how good the spaces are.

    Args:
        results: By "task: space".

    Returns:
        By the same names, beside ``first``, ``all`` and ``median_episode``: the median and the least
        ``rank_correlation`` (None for coordinates), and the median processor ``seconds`` of a run, learning and all.
    """
    summary = summarise_subgoals(results)
    for name, runs in results.items():
        correlations = [run["rank_correlation"] for run in runs if run["rank_correlation"] is not None]
        summary[name]["rank_correlation"] = (
            {"median": float(np.median(correlations)), "least": min(correlations)} if correlations else None
        )
        summary[name]["seconds"] = {
            part: float(np.median([run["seconds"][part] for run in runs])) for part in ("learning", "all")
        }
    return summary
