"""Logs discovery, options and settings of a training, in numbers and pictures."""

import logging
import os
from collections.abc import Mapping
from typing import Any, get_args

from stable_baselines3.common.logger import Figure, HParam, Logger, TensorBoardOutputFormat

from sb3_options.callbacks.keeper import OptionKeeper
from sb3_options.checked import flat, is_number
from sb3_options.experience.option_run import OptionRun, Termination
from sb3_options.options.bank import OptionBank

logger = logging.getLogger("sb3_options")

NUMBERS_ONLY = ("stdout", "log", "json", "csv")  # SB3's outputs that take neither pictures nor settings

RESULTS = ("rollout/success_rate", "rollout/ep_rew_mean")  # scalars of SB3 that the HParams tab shows beside settings


def takes_more_than_numbers(log: Logger) -> bool:
    """Return whether an output takes pictures and settings: TensorBoard, or one that declares it."""
    return any(
        isinstance(output, TensorBoardOutputFormat) or getattr(output, "takes_pictures", False)
        for output in log.output_formats
    )


def log_run(log: Logger, run: OptionRun) -> None:
    """Log how the option of a slot ran; SB3 logs the means since the last entry.

    TensorBoard opens the alphabetically first groups, so ``slots`` and ``search`` come after ``rollout``.
    """
    slot = f"slots/{run.index}"
    log.record_mean(f"{slot}/inside", float(bool(run.inside)), exclude="stdout")
    if run.inside:
        log.record_mean(f"{slot}/duration", run.duration, exclude="stdout")
        for ending in get_args(Termination):
            if ending not in ("primitive", "running"):
                log.record_mean(f"{slot}/ended_{ending}", float(run.termination == ending), exclude="stdout")


def log_discovery(log: Logger, keeper: OptionKeeper, n_timesteps: int) -> None:
    """Log the progress of discovery after ``n_timesteps`` primitive steps."""
    search = keeper.search
    log.record("search/seconds", search.diary.seconds)
    log.record("search/left_out", search.diary.skipped)
    log.record("slots/filled", len(keeper.options.bank))
    log.record("slots/closed", len(keeper.closed))
    log.record("time/primitive_steps", n_timesteps)
    for tag, value in search.method.values().items():
        log.record(tag, value)


def draw_discovery(log: Logger, keeper: OptionKeeper) -> None:
    """Draw discovery for TensorBoard, with the next dump of the log."""
    if not takes_more_than_numbers(log):
        return
    from sb3_options.discovery.figures import map_figure  # here, because Matplotlib takes a second to import

    if (figure := map_figure(keeper.search, keeper.options.bank)) is not None:
        log.record("search/subgoals", Figure(figure, close=True), exclude=NUMBERS_ONLY)


def log_settings(log: Logger, settings: Mapping[str, Any]) -> None:
    """Record settings, nested or flat, for TensorBoard's HParams tab."""
    if takes_more_than_numbers(log):
        given = {name: value for name, value in flat(settings).items() if value is not None}
        values = {name: value if is_number(value) else str(value) for name, value in given.items()}
        log.record("settings", HParam(values, dict.fromkeys(RESULTS, 0.0)), NUMBERS_ONLY)


def save_or_warn(bank: OptionBank, path: str | os.PathLike[str] | None) -> None:
    """Save the options if a path is given, and log a warning if that fails."""
    try:
        if path is not None:
            bank.save(path)
    except OSError as error:
        logger.warning("The options could not be saved to %s, training goes on: %s", path, error)
