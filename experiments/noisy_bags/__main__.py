"""What to do about negative bags that hold the concept: 0 to 40 % of them contaminated.

``python -m experiments.noisy_bags --out FOLDER`` plants a place in noise over a square. Every positive bag has an
instance near it, and so has a share of the negative bags, as when an unsuccessful trajectory passes the doorway. Each
way of computing diverse density searches the same bags; it succeeds if its best peak lies within half a width of
the place. Ways:

- plain: the noisy-or (Maron & Lozano-Pérez 1998), in which one such bag rules the place out;
- weak: negative instances at a tenth of their strength, log(1 − 0.1 p);
- em_dd: the most likely instance of each bag in place of the noisy-or (Zhang & Goldman 2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.stats import binomtest

from experiments.common.em_dd import ExpectationMaximisation
from experiments.common.seeds import write_json
from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import DiverseDensity

PLACE = np.array([3.0, -2.0])
REACH = 10.0
SPREAD = 0.2
NEAR = 0.5
WEAK = 0.1
WAYS = ("plain", "weak", "em_dd")


@dataclass(frozen=True)
class Study:
    """Contaminate negative bags, and see which way of computing diverse density still finds the place.

    Attributes:
        out: Folder for results.json and noisy_bags.png.
        runs: Sets of bags for each share.
        shares: Of the negative bags that are contaminated.
        bags: Positive bags, and as many negative ones.
        instances: Of noise in every bag.
    """

    out: Path
    runs: int = 30
    shares: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4)
    bags: int = 10
    instances: int = 30


class Task(NamedTuple):
    """Bags of a run."""

    positive: list[FloatArray]
    negative: list[FloatArray]


def make(seed: int, share: float, n_bags: int, n_instances: int) -> Task:
    """Bags of one run. The noise is the same for every share."""
    rng = np.random.default_rng(seed)

    def noise() -> list[FloatArray]:
        return [rng.uniform(-REACH, REACH, (n_instances, 2)) for _ in range(n_bags)]

    def near() -> FloatArray:
        return rng.normal(PLACE, SPREAD, (1, 2))

    positive = [np.vstack([bag, near()]) for bag in noise()]
    negative, extra = noise(), [near() for _ in range(n_bags)]
    contaminated = np.arange(n_bags) < round(share * n_bags)
    negative = [np.vstack([b, e]) if c else b for b, e, c in zip(negative, extra, contaminated, strict=True)]
    return Task(positive, negative)


def found(way: str, task: Task) -> float:
    """Distance of the best peak from the place, in widths."""
    bags = Bags.pack(task.positive, task.negative)
    search = DiverseDensity(
        method="thorough",
        max_starts=48,
        finalists=2,
        negative_strength=WEAK if way == "weak" else 1.0,
    )
    peaks = ExpectationMaximisation(search=search).fit(bags) if way == "em_dd" else search.search(bags)
    return float(np.linalg.norm(peaks[0].region().points[0] - PLACE))


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    torch.set_num_threads(1)
    results: dict[str, Any] = {"runs": study.runs, "shares": list(study.shares), "found": {way: {} for way in WAYS}}
    tasks = [(share, seed) for share in study.shares for seed in range(study.runs)]
    distances: dict[tuple[str, float], list[float]] = {(way, share): [] for way in WAYS for share in study.shares}
    for share, seed in track(tasks, description="Bags"):
        task = make(seed, share, study.bags, study.instances)
        for way in WAYS:
            distances[way, share].append(found(way, task))
    for (way, share), values in distances.items():
        hits = int(np.sum(np.array(values) <= NEAR))
        interval = binomtest(hits, len(values)).proportion_ci(method="wilson")
        results["found"][way][str(share)] = {
            "share": hits / len(values),
            "low": float(interval.low),
            "high": float(interval.high),
            "median_distance": float(np.median(values)),
        }
    command = f"python -m experiments.noisy_bags --runs {study.runs}"
    write_json(study.out / "results.json", {"command": command, **results})
    draw(results).savefig(study.out / "noisy_bags.png", dpi=110)
    table = Table("contaminated", *WAYS)
    for share in study.shares:
        table.add_row(f"{share:.0%}", *(f"{results['found'][way][str(share)]['share']:.2f}" for way in WAYS))
    console = Console(highlight=False, soft_wrap=True)
    console.print(table)
    console.print(f"Results: {study.out / 'results.json'}, {study.out / 'noisy_bags.png'}")


def draw(results: dict[str, Any]) -> Figure:
    """Share of runs that found the place, over the share of contaminated negative bags."""
    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.add_subplot()
    shares = np.array(results["shares"])
    for i, (way, by_share) in enumerate(results["found"].items()):
        parts = [by_share[str(share)] for share in results["shares"]]
        value = np.array([part["share"] for part in parts])
        errors = np.abs(np.array([[part["low"], part["high"]] for part in parts]).T - value)
        axes.errorbar(100 * shares + 0.4 * (i - 2), value, yerr=errors, marker="o", capsize=2, label=way)
    axes.set_xlabel("contaminated negative bags, %")
    axes.set_ylabel("share of runs that found the place")
    axes.set_ylim(-0.03, 1.03)
    axes.legend()
    return figure


if __name__ == "__main__":
    main(tyro.cli(Study))
