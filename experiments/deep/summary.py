"""Numbers of the study: steps to success, areas, final steps, and how they compare with stock's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.common.intervals import iqm_difference, iqm_ratio, ratio_interval
from experiments.common.seeds import Result
from experiments.deep.agents import reached_at
from sb3_options.experience.observations import FloatArray
from sb3_options.runs.intervals import iqm_interval, mean_interval, probability_of_improvement

GRID = 500
"""Curves are compared every so many primitive steps."""


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
        runs: By arm; ``stock`` is what the others are compared with, or ``n-step`` where only that was run.
        n_timesteps: Longest training.

    Returns:
        By arm: ``n_runs``; ``steps_to_90`` and ``area`` (mean success rate over training), interquartile means;
        ``never`` (runs that never got there); ``final_steps``, ``final_success``; and, but for stock,
        ``steps_to_90_of_stock``, ``area_difference``, ``probability_of_improvement``, ``final_steps_of_stock``.
    """
    measured = {arm: _measures(results, n_timesteps) for arm, results in runs.items() if results}
    of_stock = next((arm for arm in ("stock", "n-step") if arm in measured), "")
    stock = measured.get(of_stock)
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
        if stock is not None and arm != of_stock:
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
