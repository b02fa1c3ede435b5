"""The picture of the study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from experiments.common.seeds import Result
from experiments.empty_slots.conditions import ARMS, LAST_EPISODES, TASKS


def draw(results: Mapping[str, Sequence[Result]]) -> Figure:
    """Final returns of every run, sorted, an axes for each algorithm."""
    algorithms = list(dict.fromkeys(name.split(", ")[0] for name in results))
    figure = Figure(figsize=(4.2 * len(algorithms), 3.4), layout="constrained")
    for axes, algorithm in zip(
        figure.subplots(1, len(algorithms), sharey=True, squeeze=False)[0], algorithms, strict=True
    ):
        for arm in ARMS:
            if f"{algorithm}, {arm}" not in results:
                continue
            final = np.sort([run["final_return"] for run in results[f"{algorithm}, {arm}"]])
            axes.step(final, (np.arange(len(final)) + 1) / len(final), where="post", label=arm)
        axes.set_title(f"{algorithm}, {TASKS[algorithm]}", fontsize=9)
        axes.set_xlabel(f"mean return of the last {LAST_EPISODES} episodes")
        axes.set_xlim(-0.03, 1.03)
    figure.axes[0].set_ylabel("share of runs at most this good")
    figure.axes[0].legend(title="four empty slots", fontsize=8)
    return figure
