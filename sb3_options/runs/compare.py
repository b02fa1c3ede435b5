"""Comparing runs by their TensorBoard logs: success, return and length over primitive steps."""

from __future__ import annotations

import glob
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_options.atomic import atomic_write
from sb3_options.checked import flat
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.success import learned_at
from sb3_options.runs import yaml_file
from sb3_options.runs.commands import CompareConfig
from sb3_options.runs.config import CONFIG, HOW_IT_RAN, OWN
from sb3_options.runs.intervals import Interval, band, iqm_interval, probability_of_improvement

Measure: TypeAlias = Literal["success", "return", "length"]

TAGS: dict[str, dict[Measure, str]] = {
    "eval": {"success": "eval/success_rate", "return": "eval/mean_reward", "length": "eval/mean_ep_length"},
    "rollout": {"success": "rollout/success_rate", "return": "rollout/ep_rew_mean", "length": "rollout/ep_len_mean"},
}
"""Tags under which SB3 logs a measure: in evaluations, and for the last 100 training episodes."""

NO_SETTING = HOW_IT_RAN | {"seed"}  # settings that may differ between runs of one group

EVENTS = "**/*tfevents*"

LONGEST_NAME = 40  # characters of a heading that fit two lines of a table with 80 columns
LINE = 72  # characters that fit on a line below the picture
N_POINTS = 200  # number of points at which curves are drawn
END = 0.1  # last share of training whose mean is the result at the end

CAPTION = (
    "Interquartile means with 95 % stratified bootstrap intervals. A run that never gets there counts with the whole "
    "budget, that of the shortest run."
)
Numbers: TypeAlias = dict[str, Interval | int | str]  # results of a group, by their names in the table

UNITS: dict[Measure, str] = {"success": "success rate", "return": "return", "length": "primitive steps of an episode"}


class Curve(NamedTuple):
    """A measure over training, (n,) each: primitive steps and values."""

    steps: FloatArray
    values: FloatArray


class Run(NamedTuple):
    """A run: its ``config.yml`` (empty without one), and curves by source (``eval``, ``rollout``) and measure."""

    folder: Path
    settings: dict[str, Any]
    curves: dict[str, dict[Measure, Curve]]


class Goal(NamedTuple):
    """A goal of learning: a minimum success rate or return, or a maximum length."""

    measure: Measure
    value: float

    @classmethod
    def parsed(cls, text: str) -> Goal:
        """Parse ``success=0.9``; raise `ValueError` for an unknown measure or an impossible number."""
        name, _, value = text.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        possible = math.isfinite(number) and (name != "success" or 0.0 < number <= 1.0)
        if name not in get_args(Measure) or not possible:
            raise ValueError(f"--reach takes success=0.9 (at most 1), return=1.5 or length=40, not {text!r}.")
        return cls(name, number)  # type: ignore[arg-type]  # checked

    def reached(self, curve: Curve) -> float | None:
        """Return primitive steps at the first of two successive entries that reach the goal, or None."""
        wanted = float(np.float32(self.value))  # TensorBoard keeps 32 bits: its 0.9 is a little less than 0.9
        at = learned_at(curve.values <= wanted if self.measure == "length" else curve.values >= wanted)
        return None if at is None else float(curve.steps[at])

    def __str__(self) -> str:
        sign = "≤" if self.measure == "length" else "≥"
        what = "episode length" if self.measure == "length" else UNITS[self.measure]
        return f"{what} {sign} {self.value:g}"


def show_comparison(config: CompareConfig, console: Console) -> None:
    """Print a table of runs side by side, and draw them."""
    goal = Goal.parsed(config.reach)
    groups = groups_of(config.runs)
    everything = [run for members in groups.values() for run in members]
    source = source_of(everything)
    for run in everything:
        if goal.measure not in run.curves[source]:
            raise ValueError(
                f"{run.folder} did not log {TAGS[source][goal.measure]}: leave it out, or say --reach with one of "
                f"{', '.join(run.curves[source])}."
            )
    console.print(table_of(compared(groups, goal, source)))
    with atomic_write(config.out) as temporary:
        figure_of(groups, source).savefig(temporary, dpi=110)
    console.print(f"Picture: {escape(str(config.out))}")


def read_run(folder: Path) -> Run:
    """Read the logs of a run of this library, SB3 or rl-zoo3."""
    files = sorted({file.parent for file in folder.glob(EVENTS)})
    curves: dict[str, dict[Measure, Curve]] = {source: {} for source in TAGS}
    logs = [EventAccumulator(str(each), size_guidance={"scalars": 0}).Reload() for each in files]
    for source, tags in TAGS.items():
        for measure, tag in tags.items():
            events = [event for log in logs if tag in log.Tags()["scalars"] for event in log.Scalars(tag)]
            if events:
                columns = np.array([(event.step, event.value) for event in events], dtype=np.float64)
                curves[source][measure] = Curve(*columns[np.argsort(columns[:, 0], kind="stable")].T)
    if not any(curves.values()):
        raise ValueError(f"{folder} has no TensorBoard file with an evaluation or a training episode that ended.")
    config = folder / CONFIG
    return Run(folder, yaml_file.read_mapping(config) if config.is_file() else {}, curves)


def groups_of(words: Sequence[str]) -> dict[str, list[Run]]:
    """Return runs by group name; groups that the user named come last."""
    named: dict[str, list[Run]] = {}
    for word in words:
        name, equals, pattern = word.partition("=")
        if not equals or Path(word).exists():
            name, pattern = "", word
        found = [] if Path(pattern).is_dir() else sorted(map(Path, glob.glob(pattern)))  # noqa: PTH207  # absolute patterns, too
        folders = [folder for folder in found if folder.is_dir()] or [Path(pattern)]
        named.setdefault(name, []).extend(read_run(run) for folder in folders for run in runs_in(folder))
    return (grouped(named.pop("")) if "" in named else {}) | named


def runs_in(folder: Path) -> list[Path]:
    """Return the run folders in a folder, or the folder itself if it is one, or holds at most one log.

    A run folder has a ``config.yml``. A log outside such folders is a run of its own.
    """
    if (folder / CONFIG).is_file():
        return [folder]
    runs = set()
    for log in {file.parent for file in folder.glob(EVENTS)}:
        above = [log, *log.parents]
        within = above[: above.index(folder)]
        runs.add(next((each for each in within if (each / CONFIG).is_file()), log))
    return sorted(runs) if len(runs) > 1 else [folder]


def grouped(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Group runs that differ only in their seed, and name each group by the settings that set it apart.

    If these exceed `LONGEST_NAME` characters, the group is named after its first run folder.
    """
    settings = [flat({k: v for k, v in run.settings.items() if k not in NO_SETTING}) for run in runs]
    texts = [{name: json.dumps(value, default=str).replace('"', "") for name, value in of.items()} for of in settings]
    names = sorted({name for each in texts for name in each})
    differing = [name for name in names if _sets_apart(name, texts)]
    groups: dict[str, list[Run]] = {}
    short: dict[str, str] = {}
    for run, each in zip(runs, texts, strict=True):
        name = ", ".join(f"{name} {each.get(name)}" for name in differing)
        if len(name) > LONGEST_NAME:
            folder = run.folder.resolve()
            name = short.setdefault(name, f"{folder.parent.name}/{folder.name}")
        groups.setdefault(name if run.settings and name else _unnumbered(run.folder), []).append(run)
    return groups


def _sets_apart(name: str, texts: Sequence[Mapping[str, str]]) -> bool:
    """Whether runs differ in a setting; for settings of an algorithm, whether runs of one algorithm do."""
    own = name != "algo" and name.partition(".")[0] in OWN
    algos = [each.get("algo") if own else None for each in texts]
    return len({(algo, each.get(name)) for algo, each in zip(algos, texts, strict=True)}) > len(set(algos))


def _unnumbered(folder: Path) -> str:
    """Turn ``ppo/CartPole-v1_3`` into ``ppo/CartPole-v1``."""
    folder = folder.resolve()
    return f"{folder.parent.name}/{re.sub(r'_[0-9]+$', '', folder.name)}"


def source_of(runs: Sequence[Run]) -> str:
    """Choose evaluations if all runs have them, else training episodes."""
    return "eval" if all(run.curves["eval"] for run in runs) else "rollout"


def compared(groups: Mapping[str, Sequence[Run]], goal: Goal | None, source: str) -> dict[str, Numbers]:
    """Return the results of every group, compared with the first. All runs are cut to the shortest."""
    everything = [run for runs in groups.values() for run in runs]
    limit = budget(everything, source)
    first: FloatArray | None = None
    numbers: dict[str, Numbers] = {}
    for name, runs in groups.items():
        numbers[name] = {"runs": len(runs)}
        if goal is not None:
            reached = [goal.reached(cut(run.curves[source][goal.measure], limit)) for run in runs]
            steps = np.array([limit if at is None else at for at in reached])
            numbers[name] |= {
                f"primitive steps to {goal}": iqm_interval(steps),
                "runs that never get there": reached.count(None),
            }
            if len(groups) > 1:
                sooner = "" if first is None else probability_of_improvement(steps, first)
                numbers[name][f"Pr(sooner than {next(iter(groups))})"] = sooner
            first = steps if first is None else first
        for measure in measures_of(everything, source):
            ends = [at_the_end(cut(run.curves[source][measure], limit), limit) for run in runs]
            numbers[name][f"{UNITS[measure]}, at the end"] = iqm_interval(np.array(ends))
    return numbers


def measures_of(runs: Sequence[Run], source: str) -> list[Measure]:
    """Return the measures that all runs logged."""
    return [m for m in UNITS if all(m in run.curves[source] for run in runs)]


def budget(runs: Sequence[Run], source: str) -> float:
    """Return the primitive steps of the shortest run."""
    return min(float(curve.steps[-1]) for run in runs for curve in run.curves[source].values())


def cut(curve: Curve, limit: float) -> Curve:
    """Cut a curve at ``limit`` primitive steps, but keep at least its first entry."""
    n = max(1, int(np.searchsorted(curve.steps, limit, side="right")))
    return Curve(*(column[:n] for column in curve))


def at_the_end(curve: Curve, limit: float) -> float:
    """Return the mean over the last tenth of ``limit`` primitive steps."""
    last = curve.values[curve.steps >= (1.0 - END) * limit]
    return float(last.mean() if len(last) else curve.values[-1])


def table_of(numbers: Mapping[str, Numbers]) -> Table:
    """Make a table with a column for every group; a single run has no intervals."""
    table = Table(caption=CAPTION if any(of["runs"] != 1 for of in numbers.values()) else None)
    for name in ("", *numbers):
        table.add_column(name, overflow="fold")  # names differ at their ends
    for row in next(iter(numbers.values())):
        cells = []
        for of in numbers.values():
            number = of[row]
            if isinstance(number, Interval):
                mean, low, high = (f"{x:,.0f}" if abs(number.mean) >= 100 else f"{x:.3g}" for x in number)
                number = mean if of["runs"] == 1 else f"{mean} ({low} to {high})"
            cells.append(str(number))
        table.add_row(row, *cells)
    return table


def figure_of(groups: Mapping[str, Sequence[Run]], source: str) -> Figure:
    """Draw each measure over primitive steps: interquartile means with 95 % bootstrap bands."""
    everything = [run for runs in groups.values() for run in runs]
    limit = budget(everything, source)
    measures = measures_of(everything, source)
    figure = Figure(figsize=(6.0, 2.6 * len(measures) + 0.6), layout="constrained")
    panels = figure.subplots(len(measures), squeeze=False, sharex=True)[:, 0]
    for axes, measure in zip(panels, measures, strict=True):
        for number, (name, runs) in enumerate(groups.items()):
            curves = [cut(run.curves[source][measure], limit) for run in runs]
            at = np.linspace(max(c.steps[0] for c in curves), min(c.steps[-1] for c in curves), N_POINTS)
            values = np.array([c.values[np.searchsorted(c.steps, at, "right") - 1] for c in curves])
            middle, low, high = band(values)
            axes.plot(at, middle, color=f"C{number}", linewidth=1.3, label=f"{name} ({len(runs)})")
            if len(runs) > 1:
                axes.fill_between(at, low, high, color=f"C{number}", alpha=0.2, linewidth=0)
        axes.set_ylabel(UNITS[measure])
        axes.grid(alpha=0.25)
    panels[-1].set_xlabel("primitive steps")
    marks, names = panels[0].get_legend_handles_labels()
    columns = LINE // (max(map(len, names)) + len("----- "))
    figure.legend(marks, names, loc="outside lower center", ncols=min(max(columns, 1), len(names)), fontsize=9)
    return figure
