"""``python -m experiments.minigrid.ratios``: fills the table of ratios into docs/studies/minigrid.md."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro

from experiments.common.documents import fill
from experiments.minigrid.settings import Arm
from sb3_options.experience.observations import FloatArray

RESAMPLES, SEED = 10_000, 0


class Of(NamedTuple):
    """Runs of an agent: in which file of results, without its beginning ``minigrid-``, and which agent."""

    file: str
    arm: Arm


class Row(NamedTuple):
    """A task, the agent with options, and its rivals: without a bonus, and with one."""

    task: str
    options: Of
    ppo: Of
    bonus: Of


PPO: Arm = "stock, curriculum"
AT_FIRST: Arm = "stock, RND at first"
ROWS = (
    Row("four rooms", Of("four-rooms", "discovered, RND at first"), Of("four-rooms", PPO), Of("four-rooms", AT_FIRST)),
    Row("four rooms, no RND", Of("four-rooms", "discovered"), Of("four-rooms", PPO), Of("four-rooms", AT_FIRST)),
    Row("six rooms", Of("six-rooms", "discovered, RND at first"), Of("six-rooms", PPO), Of("six-rooms", AT_FIRST)),
    Row("six rooms, no RND", Of("six-rooms", "discovered"), Of("six-rooms", PPO), Of("six-rooms", AT_FIRST)),
    Row(
        "six large rooms, no RND",
        Of("six-large-rooms", "discovered"),
        Of("six-large-rooms", PPO),
        Of("six-large-rooms-rnd", AT_FIRST),
    ),
    Row(
        "key corridors",
        Of("key-corridor", "discovered, RND before the last"),
        Of("key-corridor", PPO),
        Of("key-corridor", "stock, RND before the last"),
    ),
    Row("DoorKey 8x8", Of("door-key", "discovered, RND at first"), Of("door-key", PPO), Of("door-key", AT_FIRST)),
    Row("DoorKey 8x8, no RND", Of("door-key", "discovered"), Of("door-key", PPO), Of("door-key", AT_FIRST)),
    Row(
        "DoorKey 16x16",
        Of("door-key-16", "discovered, RND at first"),
        Of("door-key-16", PPO),
        Of("door-key-16", AT_FIRST),
    ),
    Row("DoorKey 16x16, no RND", Of("door-key-16", "discovered"), Of("door-key-16", PPO), Of("door-key-16", AT_FIRST)),
)


@dataclass(frozen=True)
class Ratios:
    """Fill in the table.

    Attributes:
        results: Folder of the results.
        document: The page.
    """

    results: Path = Path("docs/results")
    document: Path = Path("docs/studies/minigrid.md")


def main(of: Ratios) -> None:
    """Read, and fill in."""
    fill(of.document, {"ratios": table(of.results)})


def table(results: Path) -> str:
    """Frames to 0.8 of agents with options as a share of each rival's, and the processor seconds of both."""
    rows = [
        "| | of PPO's frames | of those of PPO and RND | seconds, options | seconds, PPO |",
        "|---|---|---|---|---|",
    ]
    for row in ROWS:
        frames = frames_of(results, row.options)
        cells = [_text(frames, frames_of(results, rival)) for rival in (row.ppo, row.bonus)]
        cells += [f"{seconds_of(results, of):.0f}" for of in (row.options, row.ppo)]
        rows.append(f"| {row.task} | {' | '.join(cells)} |")
    return "\n".join(rows)


def frames_of(results: Path, of: Of) -> FloatArray:
    """Frames to 0.8 of each run, infinite where it never gets there."""
    arm = json.loads((results / f"minigrid-{of.file}.json").read_text(encoding="utf-8"))["summary"]["arms"][of.arm]
    return np.array([np.inf if frames is None else frames for frames in arm["frames_to"]["0.8"]])


def seconds_of(results: Path, of: Of) -> float:
    """Mean processor time of a run."""
    arm = json.loads((results / f"minigrid-{of.file}.json").read_text(encoding="utf-8"))["summary"]["arms"][of.arm]
    return float(arm["seconds"]["mean"])


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
    ratio, low, high = ratio_of_medians(frames, rival)
    return f"{ratio:.2f} ({low:.2f} to {high:.2f})"


if __name__ == "__main__":
    main(tyro.cli(Ratios))
