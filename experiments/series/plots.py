"""The picture of the study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from experiments.common.seeds import Result
from experiments.series.tasks import Chain

COLOURS = ("#d62728", "#2ca02c", "#ff7f0e", "0.45", "#9467bd")


def draw(results: Mapping[str, Sequence[Result]], chain: Chain) -> Figure:
    """The rooms whose task each run had solved, over primitive steps of the whole series."""
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    axes = figure.add_subplot()
    for (arm, runs), colour in zip(results.items(), COLOURS, strict=False):
        for i, result in enumerate(runs):
            steps, rooms = [0], [1]
            for k, task in enumerate(result["tasks"]):
                steps.append(steps[-1] + task["steps"])
                done = k + 1 < len(result["tasks"]) or result["solved"]
                rooms.append(task["rooms"] if done else rooms[-1])
            n = sum(r["solved"] for r in runs)
            label = f"{arm} ({n} of {len(runs)} solve the last)" if i == 0 else None
            axes.step(steps, rooms, where="post", color=colour, alpha=0.8, linewidth=1.3, label=label)
            if result["solved"]:
                axes.plot(steps[-1], rooms[-1], "o", color=colour, markersize=5)
    axes.set_xlim(0, chain.n_timesteps)
    axes.set_xlabel("primitive steps of all tasks")
    axes.set_ylabel("rooms to the goal, solved")
    axes.set_yticks(range(1, chain.n_rooms + 1))
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8, loc="lower right")
    axes.set_title(f"A chain of {chain.n_rooms} rooms, episodes of at most {chain.max_steps} steps", fontsize=10)
    return figure
