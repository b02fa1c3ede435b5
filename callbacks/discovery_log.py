"""What a run logs of discovery, and how much of its time discovery takes."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Figure, Logger

from sb3_options.callbacks.keeper import OptionKeeper
from sb3_options.callbacks.summaries import NUMBERS_ONLY, describe_options, takes_more_than_numbers
from sb3_options.discovery.budget import STEP_SECONDS, TABLE_STEP_SECONDS
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.figures import discovery_figures, options_figure
from sb3_options.learning.families import Table, family_of

logger = logging.getLogger("sb3_options")

LONG_ENOUGH = 60.0
"""Seconds of training after which a share of time is one to speak of."""

FAR_BEYOND = 3.0
"""Times `DiscoverySettings.max_share`: there is a warning when discovery takes more."""


def step_seconds_of(model: BaseAlgorithm) -> float:
    """What training takes for a primitive step, in nominal seconds (`budget`)."""
    return TABLE_STEP_SECONDS if isinstance(family_of(model), Table) else STEP_SECONDS


class DiscoveryClock:
    """Measures by the clock what share of training goes into discovery. It decides nothing.

    Args:
        before: Seconds that discovery took in an earlier training.
        clock: Seconds.
    """

    def __init__(self, before: float = 0.0, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock, self._began, self._before, self._told = clock, clock(), before, False

    def share(self, search: Discovery) -> float:
        """The share of the time since training started; warns once where it is far beyond what was asked for."""
        trained = self._clock() - self._began
        share = (search.diary.seconds - self._before) / trained if trained > 0 else 0.0
        most = search.diary.max_share
        if most is not None and not self._told and trained > LONG_ENOUGH and share > FAR_BEYOND * most:
            self._told = True
            logger.warning(
                "Discovery takes %.0f %% of the time, %.0f %% were asked for: that share is counted in work, and here "
                "training is faster, or searches slower, than is assumed. DiscoverySettings(max_share=...) of less, a "
                "smaller capacity or fewer features make searches rarer or cheaper.",
                100 * share,
                100 * most,
            )
        return share


def log_discovery(
    record: Callable[[str, Any], None], keeper: OptionKeeper, clock: DiscoveryClock, n_timesteps: int
) -> None:
    """Log how discovery goes.

    Args:
        record: Of SB3's logger.
        keeper: Of the options.
        clock: Measures discovery's share of the time.
        n_timesteps: Primitive steps so far.
    """
    search = keeper.search
    values: dict[str, float] = {
        "discovery/seconds": search.diary.seconds,
        "discovery/share": clock.share(search),
        "discovery/searches_left_out": search.diary.skipped,
        "options/count": len(keeper.options.bank),
        "options/closed": len(keeper.closed),
        "time/primitive_steps": n_timesteps,
    }
    for tag, value in {
        **values,
        **search.method.values(),
        **keeper.statistics.values(),
        **keeper.features.values(),
    }.items():
        record(tag, value)


def draw_discovery(log: Logger, keeper: OptionKeeper) -> None:
    """Draw discovery for TensorBoard, and describe the options, with the next dump of the log."""
    if not takes_more_than_numbers(log):
        return
    search, bank, made = keeper.search, keeper.options.bank, keeper.discoveries
    figures = discovery_figures(search, bank)
    options = options_figure(search, bank, made[-1].slot if made else None)
    for name, figure in (figures if options is None else {**figures, "options": options}).items():
        log.record(f"discovery/{name}", Figure(figure, close=True), exclude=NUMBERS_ONLY)
    describe_options(log, bank.slots, made, keeper.statistics.values())
