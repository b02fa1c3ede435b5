"""What runs wrote to TensorBoard, and which of them make a group."""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Callable, Sequence
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

MONITOR = "monitor"
EVENTS = "**/*tfevents*"
MONITOR_HEADING = 2
"""Lines of a monitor's file before its episodes."""


class Curve(NamedTuple):
    """A measure over a training run, (n,) each.

    Attributes:
        steps: Primitive steps, as far as the run counted them (`PrimitiveStepsCallback`).
        seconds: Since the first entry of the log.
        values: Of the measure.
    """

    steps: FloatArray
    seconds: FloatArray
    values: FloatArray


class Run(NamedTuple):
    """A run and what it logged.

    Attributes:
        folder: Of the run.
        settings: Of its ``config.yml``; empty where there is none.
        curves: By where they were measured, ``eval`` or ``rollout``, and by measure.
    """

    folder: Path
    settings: dict[str, Any]
    curves: dict[str, dict[Measure, Curve]]


class NothingLoggedError(ValueError):
    """A run has logged neither evaluations nor training episodes."""


def read_run(folder: Path) -> Run:
    """Read what a run logged, of this library, of SB3 or of rl-zoo3.

    Raises:
        FileNotFoundError: There is no such folder, or no TensorBoard file in it.
        NothingLoggedError: Nothing was logged that can be compared.
        ValueError: The configuration is damaged.
    """
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
            f"{folder} logged no returns, so there is nothing to compare: it has {lacking_of(folder)}."
        )
    config = folder / CONFIG
    return Run(folder, yaml_file.read_mapping(config) if config.is_file() else {}, curves)


def lacking_of(folder: Path, sources: Sequence[str] = tuple(TAGS)) -> str:
    """What a run has not logged, for people.

    Args:
        folder: Of the run.
        sources: ``eval`` and ``rollout``, or one of them.
    """
    episodes = "no training episode that ended" if no_episode_ended(folder) else "no training episodes in its log"
    said = {"eval": "no evaluations", "rollout": episodes}
    return " and ".join(said[source] for source in sources)


def no_episode_ended(folder: Path) -> bool:
    """Whether a run has monitors, which have seen no episode end."""
    files = list((folder / MONITOR).glob("*.csv"))
    return bool(files) and not any(len(file.read_bytes().splitlines()) > MONITOR_HEADING for file in files)


def groups_of(words: Sequence[str], said: Callable[[str], object] = lambda _: None) -> dict[str, list[Run]]:
    """Runs by the name of their group, those with a name of their own last.

    Args:
        words: As `named_groups` takes them.
        said: Likewise, and takes a line for runs that are one run made twice.

    Raises:
        As `named_groups` and `read_run`.
    """
    named = {name: [read_run(folder) for folder in folders] for name, folders in named_groups(words, said).items()}
    groups = (grouped(named.pop("")) if "" in named else {}) | named
    for name, runs in groups.items():
        for seed, folders in run_twice(runs):
            said(
                f"{name}: {' and '.join(map(str, folders))} have the same settings and seed {seed}. They are one run "
                "made twice, but count as two."
            )
    return groups


def run_twice(runs: Sequence[Run]) -> list[tuple[Any, list[Path]]]:
    """Seeds and folders of runs that have all settings and the seed in common, as far as a ``config.yml`` says."""
    alike: dict[str, tuple[Any, list[Path]]] = {}
    for run in runs:
        if "seed" in run.settings:
            seed = run.settings["seed"]
            settings = {name: value for name, value in run.settings.items() if name not in NO_SETTING}
            alike.setdefault(json.dumps([seed, settings], default=str), (seed, []))[1].append(run.folder)
    return [(seed, folders) for seed, folders in alike.values() if len(folders) > 1]


def named_groups(words: Sequence[str], said: Callable[[str], object] = lambda _: None) -> dict[str, list[Path]]:
    """Folders by the name of their group; one that holds run folders stands for these.

    Args:
        words: ``NAME=PATTERN``, or a pattern without a name, whose group is still to be found.
        said: Takes a line for every folder that holds run folders.

    Returns:
        Folders by name; those without one under "".

    Raises:
        FileNotFoundError: A pattern fits no folder.
    """
    groups: dict[str, list[Path]] = {}
    for word in words:
        name, equals, pattern = word.partition("=")
        if not equals or Path(word).exists():
            name, pattern = "", word
        for each in pattern.split(",") if name else [pattern]:
            folders = [Path(each)] if Path(each).is_dir() else sorted(map(Path, glob.glob(each)))  # noqa: PTH207  # absolute patterns, too
            folders = [folder for folder in folders if folder.is_dir()]
            if not folders:
                raise FileNotFoundError(f"There is no run folder {each}.")
            for folder in folders:
                runs = runs_in(folder)
                if runs != [folder]:
                    said(f"{folder} holds {len(runs)} runs.")
                groups.setdefault(name, []).extend(runs)
    return groups


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
    """Runs that differ in nothing but their seed make a group, named by what it has and others have not.

    Args:
        runs: At least one. Those without a ``config.yml`` are grouped by their folder's name without its number.
    """
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
