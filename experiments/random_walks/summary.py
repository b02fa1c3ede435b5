"""The numbers of the study, for results.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.common.seeds import Result
from sb3_options.runs.intervals import share_interval

Summary = dict[str, dict[str, Any]]


def summarise(results: Mapping[str, Sequence[Result]]) -> Summary:
    """How many first subgoals, and how many of all, are bottlenecks.

    Args:
        results: By "task: arm".

    Returns:
        By the same names: ``first`` and ``all`` with ``n_bottlenecks``, ``n`` and the 95 % interval of the share.
        A run that found nothing counts against ``first``. ``median_episode`` of the first subgoals. ``instances``,
        where the results have them: likewise of those in positive bags, over which diverse density is searched.
    """
    summary: Summary = {}
    for name, runs in results.items():
        firsts = [run["found"][0] for run in runs if run["found"]]
        every = [found for run in runs for found in run["found"]]
        summary[name] = {
            "first": _share(sum(f["bottleneck"] for f in firsts), len(runs)),
            "all": _share(sum(f["bottleneck"] for f in every), len(every)),
            "median_episode": float(np.median([f["episode"] for f in firsts])) if firsts else None,
        }
        if all("instances" in run for run in runs):
            n_good, n = (sum(run["instances"][key] for run in runs) for key in ("n_bottlenecks", "n"))
            summary[name]["instances"] = _share(n_good, n)
    return summary


def _share(good: int, n: int) -> dict[str, Any]:
    return {"n_bottlenecks": good, "n": n} | (share_interval(good, n)._asdict() if n else {})
