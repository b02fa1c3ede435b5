"""What a training logs of discovery and its options, in numbers and pictures, and how it ended."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.logger import Figure, HParam, Logger, TensorBoardOutputFormat

from sb3_options.callbacks.keeper import OptionKeeper
from sb3_options.checked import is_number
from sb3_options.discovery.figures import map_figure
from sb3_options.experience.success import learned_at
from sb3_options.experience.trajectories import EpisodeRecord
from sb3_options.options.bank import OptionBank

logger = logging.getLogger("sb3_options")

NUMBERS_ONLY = ("stdout", "log", "json", "csv")  # SB3's outputs that take neither pictures nor settings

LAST = 100
"""Episodes that a success rate is of."""

LEARNED = 0.9
"""Success rate that `steps_to_learn` waits for."""

SUCCESS, RETURN, STEPS = "at_end/success_rate", "at_end/return", "at_end/steps_to_90_percent"
"""TensorBoard's HParams tab shows the first scalars by the alphabet as results: these come before all others."""


def takes_more_than_numbers(log: Logger) -> bool:
    """Whether one of its outputs takes pictures and settings: TensorBoard, or what says so of itself."""
    return any(
        isinstance(output, TensorBoardOutputFormat) or getattr(output, "takes_pictures", False)
        for output in log.output_formats
    )


def log_discovery(log: Logger, keeper: OptionKeeper, n_timesteps: int) -> None:
    """Log how discovery goes, after so many primitive steps."""
    search = keeper.search
    values: dict[str, float] = {
        "discovery/seconds": search.diary.seconds,
        "discovery/searches_left_out": search.diary.skipped,
        "options/count": len(keeper.options.bank),
        "options/closed": len(keeper.closed),
        "time/primitive_steps": n_timesteps,
        **search.method.values(),
        **keeper.statistics.values(),
    }
    for tag, value in values.items():
        log.record(tag, value)


def draw_discovery(log: Logger, keeper: OptionKeeper) -> None:
    """Draw discovery for TensorBoard, with the next dump of the log."""
    if takes_more_than_numbers(log) and (figure := map_figure(keeper.search, keeper.options.bank)) is not None:
        log.record("discovery/subgoals", Figure(figure, close=True), exclude=NUMBERS_ONLY)


def steps_to_learn(history: Sequence[EpisodeRecord]) -> int | None:
    """Primitive steps until `LEARNED` of the `LAST` episodes before had succeeded, twice in a row; None if never."""
    successes = np.cumsum([0, *(episode.success for episode in history)])
    rates = (successes[LAST:] - successes[:-LAST]) / LAST
    first = learned_at(rates >= LEARNED)
    return None if first is None else history[first + LAST - 1].timestep


def log_results(log: Logger, settings: Mapping[str, Any], history: Sequence[EpisodeRecord], n_timesteps: int) -> None:
    """Record settings, nested or flat, and how a run of so many primitive steps ended, for TensorBoard's HParams tab.

    Results are the success rate and mean return of the `LAST` episodes, and `steps_to_learn`, if the task was learned.
    """
    log.record("time/primitive_steps", n_timesteps)
    if not takes_more_than_numbers(log):
        return
    last, steps = history[-LAST:], steps_to_learn(history)
    if last:
        log.record(SUCCESS, float(np.mean([episode.success for episode in last])), exclude=NUMBERS_ONLY)
        log.record(RETURN, float(np.mean([episode.total_reward for episode in last])), exclude=NUMBERS_ONLY)
    if steps is not None:
        log.record(STEPS, steps, exclude=NUMBERS_ONLY)
    log.record("settings", HParam(flat(settings), dict.fromkeys((SUCCESS, RETURN, STEPS), 0.0)), NUMBERS_ONLY)


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, float | str]:
    """Nested settings by their whole names, with dots: numbers and texts; what is None is left out."""
    values: dict[str, float | str] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            values |= flat(value, f"{prefix}{name}.")
        elif value is not None:
            values[prefix + name] = value if is_number(value) else str(value)
    return values


def save_or_warn(bank: OptionBank, path: str | os.PathLike[str] | None) -> None:
    """Write an options file, unless there is to be none; where that fails, there is a warning."""
    try:
        if path is not None:
            bank.save(path)
    except OSError as error:
        logger.warning("The options could not be saved to %s, training goes on: %s", path, error)
