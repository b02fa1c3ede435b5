"""Comparing runs: success, return and length over primitive steps and wall time, one picture and one table."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, get_args

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_options.experience.observations import FloatArray
from sb3_options.experience.success import learned_at
from sb3_options.runs.commands import AUTO, CompareConfig
from sb3_options.runs.intervals import Interval, band, iqm_interval, probability_of_improvement
from sb3_options.runs.logged import TAGS, Curve, Measure, Run, groups_of
from sb3_options.runs.pictures import format_of, save_picture

N_POINTS = 200
"""At which curves are drawn."""

END = 0.1
"""Share of training whose mean is what an agent has learned at the end."""

USUAL = "success=0.9"
"""What `AUTO` takes first, and what a search waits for."""

LONGER = 1.25
"""A length that is waited for, as a multiple of the shortest that a group has at the end."""

CAPTION = (
    "Interquartile means with 95 % stratified bootstrap intervals. A run that never gets there counts with the whole "
    "budget, that of the shortest run."
)
UNITS: dict[Measure, str] = {"success": "success rate", "return": "return", "length": "primitive steps of an episode"}


def show_comparison(config: CompareConfig, console: Console) -> None:
    """Print a table of runs side by side, and draw them."""
    if not config.runs:
        raise ValueError("Name the run folders that are to be compared.")
    asked = None if config.reach == AUTO else Goal.parsed(config.reach)
    format_of(config.out)  # before runs are read
    groups = groups_of(config.runs)
    source = source_of([run for members in groups.values() for run in members], config.source)
    goal, said = goal_of(asked, groups, source)
    console.print(table_of(compared(groups, goal, source), goal))
    if said:
        console.print(escape(said))
    save_picture(figure_of(groups, source), config.out)
    console.print(f"Picture: {escape(str(config.out))}")


class Goal(NamedTuple):
    """What is waited for: at least a success rate or a return, at most a length."""

    measure: Measure
    value: float

    @classmethod
    def parsed(cls, text: str) -> Goal:
        """Of ``success=0.9``; `ValueError` where it names no measure, or a number that the measure cannot have."""
        name, _, value = text.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if name not in get_args(Measure) or not math.isfinite(number):
            raise ValueError(f"--reach takes success=0.9, return=1.5 or length=40, not {text!r}.")
        if name == "success" and not 0.0 < number <= 1.0:
            raise ValueError(f"--reach {text}: a success rate is more than 0 and at most 1, as in success=0.9.")
        return cls(name, number)  # type: ignore[arg-type]  # checked

    def reached(self, curve: Curve) -> int | None:
        """Number of the first of two entries in a row that have it; None if there is none."""
        wanted = float(np.float32(self.value))  # as TensorBoard keeps numbers: its 0.9 is a little less than 0.9
        there = curve.values <= wanted if self.measure == "length" else curve.values >= wanted
        return learned_at(there)

    def __str__(self) -> str:
        sign = "≤" if self.measure == "length" else "≥"
        what = "episode length" if self.measure == "length" else UNITS[self.measure]
        return f"{what} {sign} {self.value:g}"


def learned_after(curve: Curve | None, goal: Goal) -> float | None:
    """Primitive steps at the first of two entries in a row that reach the goal; None if a run never did."""
    at = None if curve is None else goal.reached(curve)
    return None if curve is None or at is None else float(curve.steps[at])


def goal_of(asked: Goal | None, groups: Mapping[str, Sequence[Run]], source: str) -> tuple[Goal, str]:
    """What is waited for, and what is to be said of it.

    That is ``asked``, or success, or a length where most runs have success from their first entry on.
    """
    goal = asked or Goal.parsed(USUAL)
    if asked is not None or not at_once(goal, [run for runs in groups.values() for run in runs], source):
        return goal, ""
    length = short_enough(groups, source)
    if length is None:
        return goal, "Most runs succeed from their first entry on, so that tells nothing: choose another --reach."
    what = f"a quarter more than the shortest at the end. Say --reach {USUAL} to wait for success all the same."
    return length, f"Most runs succeed from their first entry on, so {length} is waited for: {what}"


def at_once(goal: Goal, runs: Sequence[Run], source: str) -> bool:
    """Whether more than half of the runs have it at their first entry, so that it tells nothing apart."""
    curves = [run.curves[source].get(goal.measure) for run in runs]
    return 2 * sum(curve is not None and goal.reached(curve) == 0 for curve in curves) > len(curves)


def short_enough(groups: Mapping[str, Sequence[Run]], source: str) -> Goal | None:
    """A quarter more than the least mean length that a group has over the last tenth; None if none was logged."""
    everything = [run for runs in groups.values() for run in runs]
    if not all("length" in run.curves[source] for run in everything):
        return None
    limit = budget(everything, source)
    ends = [
        np.mean([at_the_end(cut(run.curves[source]["length"], limit), limit) for run in g]) for g in groups.values()
    ]
    return Goal("length", float(f"{LONGER * min(ends):.2g}"))


class Compared(NamedTuple):
    """Numbers of one group; a single run has points for intervals.

    A run that never reaches the goal counts with the budget, and with its whole length in seconds. ``sooner`` is the
    probability that a run takes fewer steps than one of the first group.
    """

    runs: int
    never: int
    steps: Interval
    seconds: Interval
    end: dict[Measure, Interval]
    sooner: Interval | None


def source_of(runs: Sequence[Run], wanted: str) -> str:
    """``eval`` or ``rollout``: where all runs have measures."""
    for source in TAGS if wanted == "auto" else (wanted,):
        if all(run.curves[source] for run in runs):
            return source
    lacking = "; ".join(f"{run.folder} has {', '.join(s for s in TAGS if run.curves[s])} only" for run in runs)
    raise ValueError(f"--source {wanted}: not all runs logged the same. {lacking}. Leave some out.")


def compared(groups: Mapping[str, Sequence[Run]], goal: Goal, source: str) -> dict[str, Compared]:
    """The numbers of every group, compared with the first one; all are cut to the shortest run."""
    everything = [run for runs in groups.values() for run in runs]
    for run in everything:
        if goal.measure not in run.curves[source]:
            raise ValueError(
                f"{run.folder} did not log {TAGS[source][goal.measure]}: say --reach with one of "
                f"{', '.join(run.curves[source])}."
            )
    limit = budget(everything, source)
    measures = [m for m in UNITS if all(m in run.curves[source] for run in everything)]
    first: FloatArray | None = None
    numbers: dict[str, Compared] = {}
    for name, runs in groups.items():
        curves = [cut(run.curves[source][goal.measure], limit) for run in runs]
        at = [goal.reached(curve) for curve in curves]
        steps = np.array([limit if i is None else c.steps[i] for i, c in zip(at, curves, strict=True)])
        seconds = np.array([c.seconds[-1 if i is None else i] for i, c in zip(at, curves, strict=True)])
        ends = {m: np.array([at_the_end(cut(run.curves[source][m], limit), limit) for run in runs]) for m in measures}
        numbers[name] = Compared(
            len(runs),
            sum(i is None for i in at),
            iqm_interval(steps),
            iqm_interval(seconds),
            {m: iqm_interval(values) for m, values in ends.items()},
            None if first is None else probability_of_improvement(steps, first),
        )
        first = steps if first is None else first
    return numbers


def budget(runs: Sequence[Run], source: str) -> float:
    """Primitive steps of the shortest run."""
    return min(float(curve.steps[-1]) for run in runs for curve in run.curves[source].values())


def cut(curve: Curve, limit: float) -> Curve:
    """A curve up to some primitive steps, with its first entry in any case."""
    n = max(1, int(np.searchsorted(curve.steps, limit, side="right")))
    return Curve(*(column[:n] for column in curve))


def at_the_end(curve: Curve, limit: float) -> float:
    """The mean over the last tenth of ``limit`` primitive steps."""
    last = curve.values[curve.steps >= (1.0 - END) * limit]
    return float(last.mean() if len(last) else curve.values[-1])


def table_of(numbers: Mapping[str, Compared], goal: Goal) -> Table:
    """A column for every group."""
    first = next(iter(numbers))
    table = Table("", *numbers, caption=CAPTION)
    rows: dict[str, Callable[[Compared], str]] = {
        "runs": lambda of: str(of.runs),
        f"primitive steps to {goal}": lambda of: _text(of.steps, of.runs),
        "runs that never get there": lambda of: str(of.never),
        "seconds until then": lambda of: _text(of.seconds, of.runs),
        f"Pr(sooner than {first})": lambda of: "" if of.sooner is None else _text(of.sooner, of.runs),
    }
    for measure in numbers[first].end:
        rows[f"{UNITS[measure]}, at the end"] = lambda of, m=measure: _text(of.end[m], of.runs)  # type: ignore[misc]  # bound now
    for name, text in rows.items():
        table.add_row(name, *map(text, numbers.values()))
    return table


def _text(interval: Interval, runs: int) -> str:
    mean, low, high = (f"{x:,.0f}" if abs(interval.mean) >= 100 else f"{x:.3g}" for x in interval)
    return mean if runs == 1 else f"{mean} ({low} to {high})"


def figure_of(groups: Mapping[str, Sequence[Run]], source: str) -> Figure:
    """Each measure over primitive steps and over seconds: interquartile means with 95 % bootstrap bands."""
    everything = [run for runs in groups.values() for run in runs]
    limit = budget(everything, source)
    measures = [m for m in UNITS if all(m in run.curves[source] for run in everything)]
    figure = Figure(figsize=(9.5, 2.6 * len(measures) + 0.6), layout="constrained")
    panels = figure.subplots(len(measures), 2, squeeze=False, sharey="row")
    for row, measure in zip(panels, measures, strict=True):
        for number, (name, runs) in enumerate(groups.items()):
            colour = f"C{number}"
            curves = [cut(run.curves[source][measure], limit) for run in runs]
            for axes, over in zip(row, ("steps", "seconds"), strict=True):
                when = [getattr(curve, over) for curve in curves]
                at = np.linspace(max(w[0] for w in when), min(w[-1] for w in when), N_POINTS)
                values = np.array(
                    [c.values[np.searchsorted(w, at, "right") - 1] for c, w in zip(curves, when, strict=True)]
                )
                middle, low, high = band(values)
                axes.plot(at, middle, color=colour, linewidth=1.3, label=f"{name} ({len(runs)})")
                if len(runs) > 1:
                    axes.fill_between(at, low, high, color=colour, alpha=0.2, linewidth=0)
        row[0].set_ylabel(UNITS[measure])
        for axes in row:
            axes.grid(alpha=0.25)
    panels[-1, 0].set_xlabel("primitive steps")
    panels[-1, 1].set_xlabel("seconds since the first entry")
    marks, names = panels[0, 0].get_legend_handles_labels()
    figure.legend(marks, names, loc="outside lower center", ncols=min(3, len(names)), fontsize=9)
    return figure
