"""The numbers of the study, for results.json."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.common.gridworlds import NEAR
from experiments.common.seeds import Result
from sb3_options.runs.intervals import mean_interval, share_interval

EARLY = 60
"""An option that comes after this many episodes comes late."""


def summarise(results: list[Result]) -> dict[str, Any]:
    """How many of the runs made their first option near the doorway, and early."""
    good = [r["distance"] is not None and r["distance"] <= NEAR and r["episode"] < EARLY for r in results]
    found = [r for r in results if r["episode"] is not None]
    summary: dict[str, Any] = {
        "n_runs": len(results),
        "n_near_and_early": sum(good),
        "share_near_and_early": share_interval(sum(good), len(results))._asdict(),
        "n_with_option": len(found),
    }
    if found:
        summary["median_episode"] = float(np.median([r["episode"] for r in found]))
        summary["median_primitive_step"] = float(np.median([r["primitive_step"] for r in found]))
    final = np.array([r["final_steps"] for r in results if r["final_steps"] is not None])
    if len(final):
        summary["final_steps"] = mean_interval(final)._asdict()
    return summary
