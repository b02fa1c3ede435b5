"""What runs wrote to TensorBoard, and which of them make a group."""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_options.experience.observations import FloatArray
from sb3_options.runs import yaml_file
from sb3_options.runs.config import CONFIG, HOW_IT_RAN

Measure: TypeAlias = Literal["success", "return", "length"]

TAGS: dict[str, dict[Measure, str]] = {
    "eval": {"success": "eval/success_rate", "return": "eval/mean_reward", "length": "eval/mean_ep_length"},
    "rollout": {
        "success": "rollout/success_rate",
        "return": "rollout/ep_rew_mean",
        "length": "rollout/ep_len_mean",
    },
}
"""Where SB3 logs a measure: in evaluations, and of the last 100 training episodes."""

NO_SETTING = HOW_IT_RAN | {"seed"}
"""What runs of one group may differ in."""

MOST_NAMED = 3
"""Settings that are named where groups differ in more."""

EVENTS = "**/*tfevents*"


class Curve(NamedTuple):
    """A measure over training, (n,) each: primitive steps, seconds since the first entry of the log, values."""

    steps: FloatArray
    seconds: FloatArray
    values: FloatArray


class Run(NamedTuple):
    """A run, its ``config.yml`` (empty without one), and curves by source (``eval``, ``rollout``) and measure."""

    folder: Path
    settings: dict[str, Any]
    curves: dict[str, dict[Measure, Curve]]


class NothingLoggedError(ValueError):
    """A run has logged neither evaluations nor training episodes."""


def read_run(folder: Path) -> Run:
    """Read what a run logged, of this library, of SB3 or of rl-zoo3."""
    files = sorted({file.parent for file in folder.glob(EVENTS)})
    if not files:
        raise FileNotFoundError(f"{folder} has no TensorBoard file, which is where runs are read from.")
    curves: dict[str, dict[Measure, Curve]] = {source: {} for source in TAGS}
    logs = [EventAccumulator(str(each), size_guidance={"scalars": 0}).Reload() for each in files]
    began = min((log.FirstEventTimestamp() for log in logs if log.Tags()["scalars"]), default=0.0)
    for source, tags in TAGS.items():
        for measure, tag in tags.items():
            events = [event for log in logs if tag in log.Tags()["scalars"] for event in log.Scalars(tag)]
            if events:
                columns = np.array([(e.step, e.wall_time - began, e.value) for e in events], dtype=np.float64)
                curves[source][measure] = Curve(*columns[np.argsort(columns[:, 0], kind="stable")].T)
    if not any(curves.values()):
        raise NothingLoggedError(
            f"{folder} logged no returns: it has neither an evaluation nor a training episode that ended."
        )
    config = folder / CONFIG
    return Run(folder, yaml_file.read_mapping(config) if config.is_file() else {}, curves)


def groups_of(words: Sequence[str]) -> dict[str, list[Run]]:
    """Runs by the name of their group, those with a name of their own last."""
    named: dict[str, list[Run]] = {}
    for word in words:
        name, equals, pattern = word.partition("=")
        if not equals or Path(word).exists():
            name, pattern = "", word
        for each in pattern.split(",") if name else [pattern]:
            found = [Path(each)] if Path(each).is_dir() else sorted(map(Path, glob.glob(each)))  # noqa: PTH207  # absolute patterns, too
            folders = [folder for folder in found if folder.is_dir()]
            if not folders:
                raise FileNotFoundError(f"There is no run folder {each}.")
            named.setdefault(name, []).extend(read_run(run) for folder in folders for run in runs_in(folder))
    return (grouped(named.pop("")) if "" in named else {}) | named


def runs_in(folder: Path) -> list[Path]:
    """The run folders in a folder; the folder itself if it is one, or holds no more than one log.

    A run folder has a ``config.yml``; a log that is in none is a run of its own.
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
    """Runs that differ only in their seed make a group, named by the settings that set it apart."""
    flat = [_flat({k: v for k, v in run.settings.items() if k not in NO_SETTING}) for run in runs]
    names = sorted({name for each in flat for name in each})
    values = {name: [json.dumps(each.get(name), default=str) for each in flat] for name in names}
    differing = [name for name in names if len(set(values[name])) > 1]
    groups: dict[tuple[str, ...], list[Run]] = {}
    for i, run in enumerate(runs):
        own = tuple(values[name][i] for name in differing)
        groups.setdefault(own if run.settings else (_unnumbered(run.folder),), []).append(run)
    named: dict[str, list[Run]] = {}
    for own, members in groups.items():
        name = _unnumbered(members[0].folder)
        if members[0].settings and differing:
            said = [f"{n} {v}".replace('"', "") for n, v in zip(differing, own, strict=True)]
            name = ", ".join(said[:MOST_NAMED])
        while name in named:  # they differ in what is not said
            name += "'"
        named[name] = members
    return named


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by their whole names, with dots."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def _unnumbered(folder: Path) -> str:
    """``ppo/CartPole-v1`` of ``ppo/CartPole-v1_3``."""
    folder = folder.resolve()
    return f"{folder.parent.name}/{re.sub(r'_[0-9]+$', '', folder.name)}"
