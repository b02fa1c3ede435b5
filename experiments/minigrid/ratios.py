"""``python -m experiments.minigrid.ratios``: fills the table of ratios into docs/studies/minigrid.md, and draws it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments.common.documents import fill
from experiments.common.intervals import iqm_ratio
from experiments.minigrid.settings import Arm
from experiments.minigrid.summary import REACH
from sb3_options.experience.observations import FloatArray
from sb3_options.runs.intervals import iqm, probability_of_improvement

RESAMPLES, SEED = 10_000, 0


class Of(NamedTuple):
    """Runs of an agent: in which file of results, without its beginning ``minigrid-``, and which agent."""

    file: str
    arm: Arm


PPO: Arm = "stock, curriculum"
AT_FIRST: Arm = "stock, RND at first"
THROUGHOUT: Arm = "stock, RND"


def _all(file: str, contrasting: str | None = None) -> dict[str, Of]:
    drawn = {} if contrasting is None else {"contrasting": Of(contrasting, "contrasting subgoals, RND at first")}
    return {
        "options, RND": Of(file, "discovered, RND at first"),
        "options": Of(file, "discovered"),
        **drawn,
        "random": Of(file, "random subgoals, RND at first"),
        "PPO": Of(file, PPO),
        "PPO, RND": Of(file, AT_FIRST),
        "PPO, RND in all": Of(f"{file}-throughout", THROUGHOUT),
        "by hand": Of(file, "hand-made"),
    }


AGENTS: dict[str, dict[str, Of]] = {
    "four rooms": _all("four-rooms", "four-rooms"),
    "six rooms": _all("six-rooms", "six-rooms-contrasting"),
    "six large rooms": {
        "options": Of("six-large-rooms-decisions", "discovered"),
        "random": Of("six-large-rooms-random", "random subgoals"),
        "PPO": Of("six-large-rooms", PPO),
        "PPO, RND": Of("six-large-rooms-rnd", AT_FIRST),
        "PPO, RND in all": Of("six-large-rooms-throughout", THROUGHOUT),
        "by hand": Of("six-large-rooms-by-hand", "hand-made"),
    },
    "key corridors": {
        "options, RND": Of("key-corridor", "discovered, RND before the last"),
        "random": Of("key-corridor-random", "random subgoals, RND before the last"),
        "PPO": Of("key-corridor", PPO),
        "PPO, RND": Of("key-corridor", "stock, RND before the last"),
        "PPO, RND in all": Of("key-corridor-throughout", THROUGHOUT),
        "by hand": Of("key-corridor-by-hand", "hand-made"),
    },
    "DoorKey 8x8": _all("door-key", "door-key-contrasting"),
    "DoorKey 16x16": _all("door-key-16"),
}
"""Who is compared, by task. ``random`` and ``contrasting``: with options to subgoals that are drawn, and RND where
discovered options have it."""

FRESH = {
    "four rooms": ("four-rooms", "four-rooms"),
    "six rooms": ("six-rooms", "six-rooms"),
    "six large rooms": ("six-large-rooms-decisions", "six-large-rooms"),
    "key corridors": ("key-corridor", "key-corridor"),
    "DoorKey 8x8": ("door-key", "door-key"),
    "DoorKey 16x16": ("door-key-16", "door-key-16"),
}
"""Tasks that were run again on seeds which nothing had been chosen or seen on, and the files of agents with options and
of their rivals, which end in -fresh."""

THREE = {"four rooms": "four-rooms", "six rooms": "six-rooms", "key corridors": "key-corridor"}
PAIRED = {
    "features": {**THREE, "DoorKey 8x8": "door-key", "DoorKey 16x16": "door-key-16"},
    "proposed": THREE,
    "bonuses": {"four rooms": "four-rooms", "key corridors": "key-corridor"},
    "twenty": {"four rooms": "four-rooms"},
    "tuned": {"four rooms": "four-rooms"},
}
"""Tasks where agents see φ beside the observation, options have proposed groups, rivals have other bonuses, seeds are
twenty, or every agent's settings were tuned, and the files of these agents, by the ending of their names."""

OURS = {"options": "discovered, "}
COMPARED = {
    "features": {**OURS, "options and φ": "discovered with φ"},
    "proposed": {"proposed groups": "proposed"},
}
"""How the names of agents begin that each of these tables compares with all others; elsewhere `OURS`."""

REACHING = {
    **{task: (file, f"{file}-fresh") for task, (file, _) in FRESH.items()},
    "`FourRooms`": ("four-large-rooms",),
    "`LockedRoom`": ("locked-room",),
}
"""Files of agents whose options are counted."""

OPTIONS = {"options, RND": "", "options": ", no RND"}
"""Agents with options, and what the table says of them beside the task."""

RIVALS = {
    "PPO": "PPO", "PPO, RND": "PPO, RND", "PPO, RND in all": "PPO, RND in all tasks",
    "random": "random subgoals", "contrasting": "contrasting subgoals",
}  # fmt: skip
"""Whose frames the table compares theirs with, and what it says of them."""

PLAIN = ("PPO", "PPO, RND", "PPO, RND in all")
"""Rivals without options."""

COLOURS = {
    "options, RND": "#d62728", "options": "#ff7f0e", "contrasting": "#9467bd", "random": "#c49c94", "PPO": "#1f77b4",
    "PPO, RND": "#17becf", "PPO, RND in all": "#2ca02c", "by hand": "0.55",
}  # fmt: skip
FRAMES = {
    "four rooms": 120_000, "six rooms": 200_000, "six large rooms": 1_980_000, "key corridors": 1_050_000,
    "DoorKey 8x8": 150_000, "DoorKey 16x16": 300_000,
}  # fmt: skip
"""Frames of all stages at most: what a run that never gets there counts in a capped mean."""

NEVER = 1e7
"""Where agents are drawn that never get there, in frames."""


@dataclass(frozen=True)
class Ratios:
    """Fill in the table, and draw the frames of all agents.

    Attributes:
        results: Folder of the results.
        document: The page.
        picture: What is drawn.
    """

    results: Path = Path("docs/results")
    document: Path = Path("docs/studies/minigrid.md")
    picture: Path = Path("docs/images/minigrid.png")


def main(of: Ratios) -> None:
    """Read, fill in and draw."""
    parts: dict[str, Callable[[Path], str]] = {
        "capped": capped_table,
        "ratios": table,
        "fresh": fresh_table,
        **{ending: partial(paired_table, ending=ending) for ending in PAIRED},
        "reach": reach_table,
    }
    fill(of.document, {name: draw_up(of.results) for name, draw_up in parts.items()})
    draw(of.results).savefig(of.picture, dpi=110)
    draw_profile(of.results).savefig(of.picture.with_stem(f"{of.picture.stem}-profile"), dpi=110)


def draw_profile(results: Path) -> Figure:
    """Performance profile of the twenty seeds (Agarwal et al. 2021, §4.2): the share of runs at 0.8 by frames."""
    figure = Figure(figsize=(6, 3.2), layout="constrained")
    axes = figure.subplots()
    most = FRAMES["four rooms"]
    for arm in _summary_of(results, "four-rooms-twenty")["arms"]:
        frames = frames_of(results, Of("four-rooms-twenty", arm))
        axes.ecdf(np.minimum(frames, 2 * most), label=arm)  # beyond the edge: never
    axes.set(xlabel="frames of both tasks", ylabel="share of runs at 0.8", xlim=(0, most), ylim=(0, 1.03))
    axes.xaxis.set_major_formatter(lambda n, _: f"{n / 1000:.0f}k" if n else "0")
    axes.legend(frameon=False, loc="lower right")
    return figure


def draw(results: Path) -> Figure:
    """Frames to 0.8 of every run, a panel for each task and a row for each agent, with the medians."""
    figure = Figure(figsize=(10, 6), layout="constrained")
    grid = figure.subplots(2, 3, sharex=True)
    for axes, (task, agents) in zip(grid.flat, AGENTS.items(), strict=True):
        for row, (agent, of) in enumerate(agents.items()):
            frames = frames_of(results, of)
            axes.plot(
                np.minimum(frames, NEVER),
                np.full(len(frames), row),
                "o",
                color=COLOURS[agent],
                alpha=0.55,
                markersize=5,
            )
            axes.plot(
                [min(np.median(frames), NEVER)] * 2, [row - 0.35, row + 0.35], color=COLOURS[agent], linewidth=2.5
            )
        axes.set_title(task, fontsize=10)
        axes.set_yticks(range(len(agents)), list(agents), fontsize=9)
        axes.set_ylim(len(agents) - 0.5, -0.5)
        axes.set_xscale("log")
        axes.set_xticks([1e4, 1e5, 1e6, NEVER], ["10,000", "100,000", "1 million", "never"], fontsize=8)
        axes.minorticks_off()
        axes.grid(axis="x", alpha=0.25)
    figure.supxlabel(
        "frames of all tasks until training success stays at 0.8 (dots: agents; bars: medians)", fontsize=9
    )
    return figure


def capped_table(results: Path) -> str:
    """Mean frames to 0.8 of every agent; a run that never gets there counts the frames of its task."""
    rows = [f"| | {' | '.join(COLOURS)} |", "|---" * (len(COLOURS) + 1) + "|"]
    for task, agents in AGENTS.items():
        means = {name: np.minimum(frames_of(results, of), FRAMES[task]).mean() for name, of in agents.items()}
        cells = [f"{means[name]:,.0f}" if name in means else "–" for name in COLOURS]
        rows.append(f"| {task} | {' | '.join(cells)} |")
    return "\n".join(rows)


def table(results: Path) -> str:
    """Frames to 0.8 of agents with options as a share of each rival's, and the seconds of both by the clock."""
    heads = [f"to {whose}" for whose in RIVALS.values()]
    rows = [f"| | {' | '.join(heads)} | seconds, options | seconds, PPO |", "|---" * (len(heads) + 3) + "|"]
    for task, agents in AGENTS.items():
        for name, said in OPTIONS.items():
            if name in agents:
                frames = frames_of(results, agents[name])
                fair = {rival: of for rival, of in agents.items() if rival in PLAIN or _alike(of, agents[name])}
                cells = [_text(frames, frames_of(results, fair[rival])) if rival in fair else "–" for rival in RIVALS]
                cells += [f"{_summary(results, agents[of])['seconds']['mean']:.0f}" for of in (name, "PPO")]
                rows.append(f"| {task}{said} | {' | '.join(cells)} |")
    return "\n".join(rows)


def fresh_table(results: Path) -> str:
    """Frames of agents with options and of rivals on fresh seeds; the ratios there and with all seeds.

    With RND where there are such agents.
    """
    heads = [f"to {RIVALS[rival]}{where}" for rival in ("PPO", "PPO, RND") for where in ("", ", all seeds")]
    rows = [f"| | options | PPO | PPO, RND | {' | '.join(heads)} |", "|---" * (len(heads) + 4) + "|"]
    for task, (with_options, rivals) in FRESH.items():
        ours = next(name for name in OPTIONS if name in AGENTS[task])
        both = {
            name: (of, Of(f"{with_options if name == ours else rivals}-fresh", of.arm))
            for name, of in AGENTS[task].items()
        }
        frames = {name: frames_of(results, both[name][1]) for name in (ours, "PPO", "PPO, RND")}
        every = {name: np.concatenate([frames_of(results, both[name][0]), fresh]) for name, fresh in frames.items()}
        medians = [np.median(of) for of in frames.values()]
        cells = [f"{median:,.0f}" if np.isfinite(median) else "never" for median in medians]
        cells += [_text(of[ours], of[rival]) for rival in ("PPO", "PPO, RND") for of in (frames, every)]
        rows.append(f"| {task} | {' | '.join(cells)} |")
    return "\n".join(rows)


def paired_table(results: Path, ending: str) -> str:
    """Frames of agents with options, φ or proposed groups as a share of those of others, of equal seeds."""
    compared = COMPARED.get(ending, OURS)
    heads = [f"frames with {what}, of these | Pr(faster)" for what in compared]
    rows = [
        f"| | arrive | frames | {' | '.join(heads)} | processor seconds |",
        "|---" * (2 * len(compared) + 4) + "|",
    ]
    for task, file in PAIRED[ending].items():
        arms = _summary_of(results, f"{file}-{ending}")["arms"]
        frames = {
            arm: np.minimum(frames_of(results, Of(f"{file}-{ending}", arm)), FRAMES[task]) for arm in sorted(arms)
        }
        ours = [frames[next(arm for arm in arms if arm.startswith(prefix))] for prefix in compared.values()]
        for arm, of in frames.items():
            arrived = f"{(of < FRAMES[task]).sum()} of {len(of)}"
            cells = [cell for each in ours for cell in (("", "") if of is each else _paired(each, of))]
            seconds = arms[arm]["processor_seconds"]["mean"]
            rows.append(f"| {task}: {arm} | {arrived} | {iqm(of):,.0f} | {' | '.join(cells)} | {seconds:.0f} |")
    return "\n".join(rows)


def _paired(ours: FloatArray, rival: FloatArray) -> tuple[str, str]:
    """The ratio of frames, and the probability that ours are fewer."""
    text = "{:.2f} ({:.2f} to {:.2f})"
    return text.format(*iqm_ratio(ours, rival, paired=True)), text.format(*probability_of_improvement(ours, rival))


def reach_table(results: Path) -> str:
    """How many options reach their subgoals often enough, each agent's on its own; then those on fresh seeds."""
    heads = [f"{where}, {REACH[stage]}" for stage, where in (("source", "where found"), ("target", "target task"))]
    rows = [f"| | {' | '.join(heads)} | {' | '.join(f'{head}, fresh seeds' for head in heads)} |", "|---" * 5 + "|"]
    for task, files in REACHING.items():
        counts = [_summary_of(results, file)["reach"] for file in files]
        cells = [f"{of[at]['options'] - of[at]['below']} of {of[at]['options']}" for of in counts for at in REACH]
        rows.append(f"| {task} | {' | '.join([*cells, '–', '–'][:4])} |")
    return "\n".join(rows)


def _alike(one: Of, other: Of) -> bool:
    """Whether both have the bonus in the same tasks, or both do without."""
    return one.arm.partition(", ")[2] == other.arm.partition(", ")[2]


def frames_of(results: Path, of: Of) -> FloatArray:
    """Frames to 0.8 of each run, infinite where it never gets there."""
    return np.array([np.inf if frames is None else frames for frames in _summary(results, of)["frames_to"]["0.8"]])


def _summary(results: Path, of: Of) -> Any:
    """What results.json has of an agent."""
    return _summary_of(results, of.file)["arms"][of.arm]


def _summary_of(results: Path, file: str) -> Any:
    """What a file of results says of all its agents."""
    return json.loads((results / f"minigrid-{file}.json").read_text(encoding="utf-8"))["summary"]


def ratio_of_medians(frames: Sequence[float] | FloatArray, rival: Sequence[float] | FloatArray) -> tuple[float, ...]:
    """The ratio of two medians, and the ends of its 95 % percentile bootstrap interval.

    A median that is infinite makes 0 of the ratio to it, and infinity of that of it.
    """
    random = np.random.default_rng(SEED)
    medians = [
        np.median(random.choice(np.asarray(of, dtype=np.float64), (RESAMPLES, len(of))), axis=1)
        for of in (frames, rival)
    ]
    with np.errstate(invalid="ignore"):
        ratios = np.nan_to_num(medians[0] / medians[1], nan=np.inf, posinf=np.inf)
    low, high = np.quantile(ratios, (0.025, 0.975), method="inverted_cdf")
    return float(np.median(frames) / np.median(rival)), float(low), float(high)


def _text(frames: FloatArray, rival: FloatArray) -> str:
    """A ratio of 0 is one to a rival whose median run never gets there."""
    ratio, low, high = ratio_of_medians(frames, rival)
    interval = f"{low:.2f} to {high:.2f}" if low else f"below {high:.2f}"
    return f"{ratio:.2f} ({interval})" if ratio else f"rival never ({interval})"


if __name__ == "__main__":
    main(tyro.cli(Ratios))
