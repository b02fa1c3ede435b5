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
from sb3_options.runs.intervals import Interval, band, interval_of, iqm_interval, probability_of_improvement
from sb3_options.runs.logged import TAGS, Curve, Measure, Run, groups_of, lacking_of
from sb3_options.runs.pictures import format_of, save_picture

N_POINTS = 200
"""At which curves are drawn."""

END = 0.1
"""Share of training whose mean is what an agent has learned at the end."""

USUAL = "success=0.9"
"""What `AUTO` takes first, and what a search waits for."""

LONGER = 1.25
"""A length that is waited for, as a multiple of the shortest that a group has at the end."""

COLOURS = ("#d62728", "0.45", "#1f77b4", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#8c564b")
CAPTION = (
    "Interquartile means with 95 % stratified bootstrap intervals. A run that never gets there counts with the whole "
    "budget, that of the shortest run."
)
UNITS: dict[Measure, str] = {"success": "success rate", "return": "return", "length": "primitive steps of an episode"}


def show_comparison(config: CompareConfig, console: Console) -> None:
    """Print a table of runs side by side, and draw them.

    Args:
        config: Which, and how.
        console: For the table.

    Raises:
        ValueError: They cannot be compared.
        OSError: A file is missing or cannot be written.
    """
    if not config.runs:
        raise ValueError("Name the run folders that are to be compared.")
    asked = None if config.reach == AUTO else Goal.parsed(config.reach)
    format_of(config.out)  # before runs are read
    groups = groups_of(config.runs, lambda text: console.print(escape(text)))
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
        """Of ``success=0.9``.

        Raises:
            ValueError: It names no measure, or no number that the measure can have.
        """
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
    """Primitive steps after which a run has learned: the first of two entries in a row that reach the goal.

    Args:
        curve: Of the goal's measure; None where the run did not log it.
        goal: What is waited for.

    Returns:
        None if the run never did.
    """
    at = None if curve is None else goal.reached(curve)
    return None if curve is None or at is None else float(curve.steps[at])


def goal_of(asked: Goal | None, groups: Mapping[str, Sequence[Run]], source: str) -> tuple[Goal, str]:
    """What is waited for, and what is to be said of it.

    Args:
        asked: By the user; None for success, or for a length where most runs have success from their first entry on.
        groups: Runs by the name of their group.
        source: ``eval`` or ``rollout``.
    """
    everything = [run for runs in groups.values() for run in runs]
    goal = asked or Goal.parsed(USUAL)
    if not at_once(goal, everything, source):
        return goal, ""
    length = short_enough(groups, source)
    said = f"Most runs have {goal} at their first entry already, so it does not tell them apart"
    if asked is None and length is not None:
        goal = length
        if not at_once(goal, everything, source):
            what = f"a quarter more than the shortest at the end. Say --reach {USUAL} to wait for success all the same."
            return goal, f"Most runs succeed from their first entry on, so {goal} is waited for: {what}"
        said = f"Most runs have {goal} and success at their first entry already, so it does not tell them apart"
    other = "" if length in (None, goal) else f", {length.measure}={length.value:g} say"
    return goal, f"{said}: choose another --reach{other}."


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

    Attributes:
        runs: How many.
        never: Of them, those that did not reach the goal.
        steps: Primitive steps until it was reached, interquartile mean; a run that never did counts with the budget.
        seconds: The same in wall time; a run that never did counts with its whole length.
        end: The measures over the last tenth of training.
        sooner: Pr(a run of the first group takes more steps than one of this one); None for the first group.
    """

    runs: int
    never: int
    steps: Interval
    seconds: Interval
    end: dict[Measure, Interval]
    sooner: Interval | None


def source_of(runs: Sequence[Run], wanted: str) -> str:
    """Where all runs have the same measures.

    Raises:
        ValueError: There is no such place.
    """
    for source in TAGS if wanted == "auto" else (wanted,):
        if all(run.curves[source] for run in runs):
            return source
    sources = tuple(TAGS) if wanted == "auto" else (wanted,)
    without = [(run, [source for source in sources if not run.curves[source]]) for run in runs]
    said = "; ".join(f"{run.folder} has {lacking_of(run.folder, lacks)}" for run, lacks in without if lacks)
    if wanted == "auto":
        raise ValueError(f"Not all runs logged the same: {said}. Compare those that have the same.")
    raise ValueError(f"--source {wanted} is not in all runs: {said}. Leave these out, or choose another --source.")


def compared(groups: Mapping[str, Sequence[Run]], goal: Goal, source: str) -> dict[str, Compared]:
    """The numbers of every group; all are cut to the shortest run.

    Args:
        groups: Runs by the name of their group; the others are compared with the first.
        goal: What is waited for.
        source: ``eval`` or ``rollout``.

    Raises:
        ValueError: A run did not log what is waited for.
    """
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
            None if first is None else _sooner(steps, first),
        )
        first = steps if first is None else first
    return numbers


def _sooner(ours: FloatArray, theirs: FloatArray) -> Interval:
    probability = probability_of_improvement(ours, theirs)
    if min(len(ours), len(theirs)) > 1:
        return probability
    return interval_of(probability.mean, np.array([0.0, 1.0]))  # one run says nothing of others


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
    """Each measure over primitive steps and over seconds: interquartile means with 95 % bootstrap bands.

    Args:
        groups: As for `compared`.
        source: Likewise.
    """
    everything = [run for runs in groups.values() for run in runs]
    limit = budget(everything, source)
    measures = [m for m in UNITS if all(m in run.curves[source] for run in everything)]
    figure = Figure(figsize=(9.5, 2.6 * len(measures) + 0.6), layout="constrained")
    panels = figure.subplots(len(measures), 2, squeeze=False, sharey="row")
    for row, measure in zip(panels, measures, strict=True):
        for number, (name, runs) in enumerate(groups.items()):
            curves = [cut(run.curves[source][measure], limit) for run in runs]
            for axes, over in zip(row, ("steps", "seconds"), strict=True):
                when = [getattr(curve, over) for curve in curves]
                at = np.linspace(max(w[0] for w in when), min(w[-1] for w in when), N_POINTS)
                values = np.array(
                    [c.values[np.searchsorted(w, at, "right") - 1] for c, w in zip(curves, when, strict=True)]
                )
                middle, low, high = band(values)
                colour = COLOURS[number % len(COLOURS)]
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
