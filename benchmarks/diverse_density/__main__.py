"""How fast, how exact and how good diverse density is.

``python -m benchmarks.diverse_density --out FOLDER`` measures with one thread, contestants taking turns: the search on
Musk1 against scipy and against a search compiled by numba, from the same starts; what the number of finalists is
worth; nanoseconds per (start, instance) beside two bare kernels; and cross-validation on Musk1. It writes
``results.json`` and ``diverse_density.png``. Without the Musk1 data it says so and does the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from benchmarks.diverse_density.data import musk1
from benchmarks.diverse_density.parts import against_references, cross_validation, kernel, quality
from experiments.common.seeds import write_json


@dataclass(frozen=True)
class Benchmark:
    """Measure diverse density: speed, share of two bare kernels, and accuracy on Musk1.

    Attributes:
        out: Folder for results.json and diverse_density.png.
        parts: What is measured, by default all. The picture shows the kernel.
        musk1: The Musk1 data, an .npz with X, y and bag.
        rounds: Turns of the contest on Musk1, each with a share of the references' starts.
        loop_starts: Starts of the bag-by-bag reference in each turn.
        kernel_rounds: Turns of the kernel and the two bare ones.
        runs: Searches from jittered starts, for each number of finalists.
        repetitions: Of ten-fold cross-validation.
        nested: Repetitions in which settings are chosen within every fold.
        seed: Of synthetic data.
    """

    out: Path
    parts: tuple[Literal["kernel", "musk1"], ...] = ("kernel", "musk1")
    musk1: Path = Path("../shared/data/musk1.npz")
    rounds: int = 9
    loop_starts: int = 3
    kernel_rounds: int = 20
    runs: int = 20
    repetitions: int = 10
    nested: int = 3
    seed: int = 0


def main(benchmark: Benchmark) -> None:
    """Run the benchmark, and write and print what it found."""
    torch.set_num_threads(1)
    console = Console(highlight=False, soft_wrap=True)
    results: dict[str, Any] = {}
    if "kernel" in benchmark.parts:
        results["kernel"] = kernel(benchmark.kernel_rounds, benchmark.seed)
    if "musk1" in benchmark.parts and benchmark.musk1.is_file():
        data = musk1(benchmark.musk1)
        results["musk1_speed"] = against_references(data, benchmark.rounds, benchmark.loop_starts)
        results["musk1_quality"] = quality(data, benchmark.runs)
        results["musk1_classifier"] = cross_validation(data, benchmark.repetitions, benchmark.nested)
    elif "musk1" in benchmark.parts:
        console.print(f"There are no Musk1 data at {benchmark.musk1}: pass their place with --musk1. Skipped.")
    counts = {name: getattr(benchmark, name) for name in ("rounds", "runs", "repetitions", "nested")}
    flags = [f"--parts {' '.join(benchmark.parts)}", *(f"--{name} {n}" for name, n in counts.items())]
    command = " ".join(["python -m benchmarks.diverse_density", *flags])
    write_json(benchmark.out / "results.json", {"command": command, **results})
    if "kernel" in results:
        draw(results).savefig(benchmark.out / "diverse_density.png", dpi=110)
    table = Table("", "value", "interval or SD", "bar", "reached")
    for row in rows(results):
        table.add_row(*row)
    console.print(table)
    console.print(f"Results: {', '.join(str(file) for file in sorted(benchmark.out.iterdir()))}")


def rows(results: dict[str, Any]) -> list[tuple[str, str, str, str, str]]:
    """What the results say, a line for each bar."""
    out = []

    def line(name: str, part: dict[str, Any], sign: str = "≥") -> None:
        value = part.get("mean", part.get("value"))
        spread = (
            f"{part['low']:.3g} to {part['high']:.3g}"
            if "low" in part
            else f"± {part['sd']:.3g}"
            if "sd" in part
            else ""
        )
        out.append((name, f"{value:.6g}", spread, f"{sign} {part['bar']:g}", "yes" if part["reached"] else "no"))

    for d, part in results.get("kernel", {}).items():
        line(f"{d} features: {part['nanoseconds']:.2f} ns, share of two kernels", part["two_kernels_share"])
    if "musk1_speed" in results:
        for name in ("compiled", "pruned", "vectorised", "bag_by_bag"):
            line(f"times faster than {name}", results["musk1_speed"][f"times_faster_than_{name}"])
        line("Musk1 best negative log likelihood", results["musk1_speed"]["best_nll_at_one_scale"], "≤")
        for name in ("accuracy", "auc"):
            line(f"Musk1 {name}", results["musk1_classifier"][name])
    return out


def draw(results: dict[str, Any]) -> Figure:
    """Nanoseconds per (start, instance) over the number of features, and how many times faster."""
    figure = Figure(figsize=(9, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    dimensions = [int(d) for d in results["kernel"]]
    parts = list(results["kernel"].values())
    left.loglog(dimensions, [p["nanoseconds"] for p in parts], marker="o", label="value and gradient")
    left.loglog(
        dimensions, [p["two_kernels_nanoseconds"] for p in parts], marker="o", label="product and exponential alone"
    )
    left.set_xlabel("features")
    left.set_ylabel("ns per (start, instance)")
    left.set_xticks(dimensions, [str(d) for d in dimensions])
    left.minorticks_off()
    left.legend()
    if "musk1_speed" in results:
        names = ("compiled", "pruned", "vectorised", "bag_by_bag")
        ratios = [results["musk1_speed"][f"times_faster_than_{name}"] for name in names]
        errors = [[r["mean"] - r["low"] for r in ratios], [r["high"] - r["mean"] for r in ratios]]
        right.bar(
            ["numba", "scipy, pruned", "scipy", "scipy by bag"], [r["mean"] for r in ratios], yerr=errors, capsize=4
        )
        for place, ratio in enumerate(ratios):
            right.hlines(ratio["bar"], place - 0.4, place + 0.4, color="black", label="" if place else "bar")
        right.set_yscale("log")
        right.set_ylabel("times faster on Musk1")
        right.legend(loc="upper left")
    return figure


if __name__ == "__main__":
    main(tyro.cli(Benchmark))
