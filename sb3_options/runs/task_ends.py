"""When a task of a series is learned, and which options go on to the next one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_options.discovery.subgoals import SubgoalDiscovery
from sb3_options.experience.trajectories import EpisodeRecord
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import SubgoalOption
from sb3_options.runs.closing import IN_A_ROW

PAYS = 0.5
"""An option is kept if the ways of this share of the last successes lead through its subgoal."""

KEPT = "kept_options.safetensors"
"""File in the run folder of a task: the options that the next one begins with."""


class StopWhenLearned(BaseCallback):
    """Ends training when a task is learned: after `IN_A_ROW` training episodes in a row that succeeded.

    Args:
        history: Of the training episodes so far; it grows.
    """

    def __init__(self, history: Sequence[EpisodeRecord]) -> None:
        super().__init__()
        self.history = history
        self._seen = self._in_a_row = 0

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint; the episodes are in that of whoever keeps them."""
        return {"seen": self._seen, "in_a_row": self._in_a_row}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._seen, self._in_a_row = state["seen"], state["in_a_row"]

    def _on_step(self) -> bool:
        for episode in self.history[self._seen :]:
            self._in_a_row = self._in_a_row + 1 if episode.success else 0
        self._seen = len(self.history)
        return self._in_a_row < IN_A_ROW


def free_slots(discovery: SubgoalDiscovery | None, bank: OptionBank) -> list[str]:
    """Take the options that no success needs out of their slots, after a training and before the next.

    Args:
        discovery: Of the training; None before it.
        bank: The slots. An option stays if `PAYS` of the last successes lead through its subgoal, and all stay if
            there was no success.

    Returns:
        Names of those that are gone.
    """
    if discovery is None or not any(each.success for each in discovery.database):
        return []
    gone = []
    for slot in bank.filled:
        option = bank[slot]
        if isinstance(option, SubgoalOption) and discovery.passing_share(option.subgoal) < PAYS:
            gone.append(bank.remove(slot).name)
    return gone
