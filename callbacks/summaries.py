"""What a run says of itself in sums: a text for every option, and settings beside how the run ended."""

from __future__ import annotations

import dataclasses
import inspect
import logging
import os
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import HParam, Logger, TensorBoardOutputFormat
from stable_baselines3.common.type_aliases import TrainFreq

from sb3_options.callbacks.counting import SCHEDULES
from sb3_options.callbacks.records import DiscoveredOption
from sb3_options.callbacks.usefulness import WINDOW
from sb3_options.discovery.methods import DiscoveryMethod
from sb3_options.experience.success import learned_at
from sb3_options.experience.trajectories import EpisodeRecord
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option, SubgoalOption

logger = logging.getLogger("sb3_options")

Setting: TypeAlias = float | str

NUMBERS_ONLY = ("stdout", "log", "json", "csv")
"""SB3's outputs that take neither texts nor pictures nor settings."""

LAST = 100
"""Episodes that a success rate is of."""

LEARNED = 0.9
"""Success rate that `steps_to_learn` waits for."""

SUCCESS, RETURN, STEPS = "at_end/success_rate", "at_end/return", "at_end/steps_to_90_percent"
"""TensorBoard's HParams tab shows the first scalars by the alphabet as results: these come before all others."""

RESULTS = (SUCCESS, RETURN, STEPS)

NOT_TOLD = {"_init_setup_model", "device", "env", "policy", "supported_action_spaces", "tensorboard_log", "verbose"}
"""Arguments of SB3's algorithms that are no settings of learning."""

ENDINGS = {
    "subgoal": "the subgoal was reached",
    "left_initiation": "the initiation set was left",
    "max_duration": "it had taken its longest",
    "interrupted": "another action was worth more",
    "terminated": "the episode ended",
    "truncated": "the episode was cut off",
}
"""How a run of an option ends, for people."""


def takes_more_than_numbers(log: Logger) -> bool:
    """Whether one of its outputs takes pictures, texts and settings: TensorBoard, or what says so of itself."""
    return any(
        isinstance(output, TensorBoardOutputFormat) or getattr(output, "takes_pictures", False)
        for output in log.output_formats
    )


def steps_to_learn(history: Sequence[EpisodeRecord]) -> int | None:
    """Primitive steps until `LEARNED` of the `LAST` episodes before had succeeded, twice in a row; None if never."""
    successes = np.cumsum([0, *(episode.success for episode in history)])
    rates = (successes[LAST:] - successes[:-LAST]) / LAST
    first = learned_at(rates >= LEARNED)
    return None if first is None else history[first + LAST - 1].timestep


def results_of(history: Sequence[EpisodeRecord]) -> dict[str, float]:
    """How a run ended, by tag.

    Args:
        history: Its training episodes, in the order in which they ended.

    Returns:
        Success rate and mean return of the `LAST` episodes, exploration included, and `steps_to_learn`. What there is
        not is left out: everything before the first episode has ended, the steps where they never came.
    """
    last, steps = history[-LAST:], steps_to_learn(history)
    results: dict[str, float] = {}
    if last:
        results[SUCCESS] = float(np.mean([episode.success for episode in last]))
        results[RETURN] = float(np.mean([episode.total_reward for episode in last]))
    return results | ({} if steps is None else {STEPS: steps})


def flat_settings(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Setting]:
    """Nested settings by their whole names, with dots, as TensorBoard's HParams tab takes them.

    Args:
        settings: By name.
        prefix: Before each name.

    Returns:
        Numbers and texts. A sequence is a text, and so is a truth value, which the tab would show as 0.0. What is
        None, or anything else, is left out: a column holds values of one kind.
    """
    flat: dict[str, Setting] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat |= flat_settings(value, f"{prefix}{name}.")
        elif isinstance(value, bool):
            flat[prefix + name] = str(value)
        elif isinstance(value, int | float | str):
            flat[prefix + name] = value
        elif isinstance(value, list | tuple):
            flat[prefix + name] = ", ".join(map(str, value))
    return flat


def settings_of(model: BaseAlgorithm, method: DiscoveryMethod | None = None, **others: Any) -> dict[str, Setting]:
    """Settings of a model, and of dataclasses, whose names have theirs before them.

    Args:
        model: What its class takes and it has under the same name.
        method: A user's own method of discovery, whose class takes the place of the name in ``discovery.method``.
        **others: Dataclasses by name.
    """
    arguments = {name for of in type(model).__mro__ for name in inspect.signature(of).parameters} - NOT_TOLD
    own: dict[str, Any] = {name: getattr(model, name) for name in sorted(arguments) if hasattr(model, name)}
    for name, value in own.items():
        if name in ("learning_rate", *SCHEDULES) and callable(value):
            own[name] = float(value(1.0))  # at the start of training
        elif isinstance(value, TrainFreq):
            own[name] = value.frequency
    nested = {name: dataclasses.asdict(other) for name, other in others.items()}
    if method is not None:
        nested["discovery"]["method"] = type(method).__name__
    return flat_settings({"algo": type(model).__name__, "n_envs": model.n_envs, **own, **nested})


def log_results(log: Logger, settings: Mapping[str, Any], history: Sequence[EpisodeRecord], n_timesteps: int) -> None:
    """Record settings and how the run ended for TensorBoard's HParams tab, with the next dump of the log.

    Args:
        log: SB3's. Without an output that takes them, nothing is recorded.
        settings: By name, flat or nested.
        history: As for `results_of`.
        n_timesteps: Primitive steps of the whole run; the last episode that ended did not know all.
    """
    log.record("time/primitive_steps", n_timesteps)
    if not takes_more_than_numbers(log):
        return
    for tag, value in results_of(history).items():
        log.record(tag, value, exclude=NUMBERS_ONLY)
    flat = flat_settings(settings)
    for output in log.output_formats:
        if isinstance(output, TensorBoardOutputFormat) and output.writer.file_writer is not None:
            from torch.utils.tensorboard.summary import hparams

            # SB3 would also write which columns there are, and TensorBoard shows those of one run for all. Without them
            # it compares the runs, and shows first in what they differ.
            _, start, end = hparams(flat, metric_dict={})
            for summary in (start, end):
                output.writer.file_writer.add_summary(summary)
    log.record("settings", HParam(flat, dict.fromkeys(RESULTS, 0.0)), (*NUMBERS_ONLY, "tensorboard"))


def save_or_warn(bank: OptionBank, path: str | os.PathLike[str] | None) -> None:
    """Write an options file, unless there is to be none; where that fails, there is a warning."""
    try:
        if path is not None:
            bank.save(path)
    except OSError as error:
        logger.warning("The options could not be saved to %s, training goes on: %s", path, error)


def describe_options(
    log: Logger,
    options: Sequence[Option | None],
    found: Sequence[DiscoveredOption],
    statistics: Mapping[str, float],
) -> None:
    """Record a text for every option, with the next dump of the log.

    Args:
        log: SB3's. Without an output that takes texts, nothing is recorded.
        options: By slot.
        found: All that were discovered, in order; of a slot that was filled again the last one counts.
        statistics: By tag, as `OptionStatistics.values` gives them.
    """
    if not takes_more_than_numbers(log):
        return
    made = {each.slot: each for each in found}
    for slot, option in enumerate(options):
        if option is not None:
            text = text_of(
                option, made.get(slot), {tag: value for tag, value in statistics.items() if _is_of(slot, tag)}
            )
            log.record(f"options/slot_{slot}", text, NUMBERS_ONLY)


def _is_of(slot: int, tag: str) -> bool:
    return tag.startswith(f"options/slot_{slot}/")


def text_of(option: Option, found: DiscoveredOption | None, statistics: Mapping[str, float]) -> str:
    """An option as a table in Markdown.

    Args:
        option: As it is now.
        found: When and where it was discovered; None if it was there at the start.
        statistics: Of its slot, by tag.
    """
    rows: list[tuple[str, str]] = []
    if found is None:
        rows.append(("discovered", "no: it was there when training started"))
    else:
        rows.append(("discovered", f"after {found.episode:,} episodes, {found.timestep:,} primitive steps"))
        rows.append(("learned from", f"{found.saved:,} saved episodes, of which {found.visiting:,} visit the subgoal"))
        if np.isfinite(found.log_density):
            rows.append(("log diverse density", f"{found.log_density:.2f} nats"))
    if isinstance(option, SubgoalOption):
        rows.append(("may begin in", f"{len(option.initiation_set.points):,} places"))
    rows.append(("ends after", f"{option.max_duration:,} primitive steps at most"))
    about = {tag.rpartition("/")[2]: value for tag, value in statistics.items()}
    ends = {ENDINGS[name.removeprefix("ended_")]: share for name, share in about.items() if name.startswith("ended_")}
    if ends:
        reached = ends.pop(ENDINGS["subgoal"], 0.0)
        rows.append(("success rate", f"{reached:.0%} of the last runs, {WINDOW} at most: the subgoal was reached"))
        rows += [("", f"{share:.0%}: {why}") for why, share in ends.items() if share > 0.0]
        rows.append(("duration", f"{about['mean_duration']:.1f} primitive steps on average"))
    rows.append(("runs", f"{about.get('runs', 0):,.0f}"))
    lines = "\n".join(f"| {what} | {said.replace('|', '/')} |" for what, said in rows)
    return f"| option | {option.name} |\n|---|---|\n{lines}"
