"""How the options are used, for TensorBoard."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np

from sb3_options.experience.option_run import OptionRun

WINDOW = 100
"""Durations and endings are averaged over this many last uses of a slot."""


class OptionStatistics:
    """Uses of each slot, and how long the last of them took and why they ended."""

    def __init__(self) -> None:
        self._uses: Counter[int] = Counter()
        self._last: dict[int, deque[tuple[int, str]]] = {}
        self._endings: dict[int, set[str]] = {}

    def add(self, run: OptionRun) -> None:
        """Count one run of an option."""
        self._uses[run.index] += 1
        self._last.setdefault(run.index, deque(maxlen=WINDOW)).append((run.duration, run.termination))
        self._endings.setdefault(run.index, set()).add(run.termination)

    def values(self) -> dict[str, float]:
        """By TensorBoard tag: uses so far; mean duration and the share of each ending over the last uses."""
        values: dict[str, float] = {}
        for slot, last in self._last.items():
            values[f"options/slot_{slot}/uses"] = self._uses[slot]
            values[f"options/slot_{slot}/mean_duration"] = float(np.mean([duration for duration, _ in last]))
            count = Counter(why for _, why in last)
            # An ending that has left the window is 0 from then on, and not what it last was.
            for ending in sorted(self._endings[slot]):
                values[f"options/slot_{slot}/ended_{ending}"] = count[ending] / len(last)
        return values
