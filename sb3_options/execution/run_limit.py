"""How often one option may run in an episode."""

from __future__ import annotations

import numpy as np

from sb3_options.checked import is_number
from sb3_options.experience.observations import BoolArray


class RunLimit:
    """Counts the runs of every option in the episode.

    Args:
        max_options: Number of slots.
        max_runs: Most runs of one option in an episode, at least 1; None for any number.

    Raises:
        ValueError: ``max_runs`` is out of its range.
    """

    def __init__(self, max_options: int, max_runs: int | None) -> None:
        if max_runs is not None and not (is_number(max_runs) and max_runs >= 1 and max_runs % 1 == 0):
            raise ValueError(f"max_runs must be a whole number, at least 1, or None for no limit, got {max_runs!r}.")
        self.max_runs = max_runs
        self.runs = np.zeros(max_options, dtype=np.int64)

    def is_reached(self, slot: int) -> bool:
        """Whether the option in ``slot`` may not run again in this episode."""
        return self.max_runs is not None and bool(self.runs[slot] >= self.max_runs)

    def forbid(self, slots: BoolArray) -> None:
        """Clear, in place, those of the slots that may start, (max_options,), which may not run again."""
        if self.max_runs is not None:
            slots[self.runs >= self.max_runs] = False
