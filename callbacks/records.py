"""Records of the options that `SubgoalDiscoveryCallback` made and closed, and statistics of their use."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from sb3_options.callbacks.usefulness import WINDOW, Verdict
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.option_run import OptionRun
from sb3_options.state import storable


@storable
@dataclass(frozen=True)
class DiscoveredOption:
    """When and where an option was made.

    Attributes:
        slot: Its slot.
        episode: Number of episodes, or of segments between peaks of reward, that had ended.
        timestep: Primitive steps taken.
        subgoal: The subgoal's centre in concept space, shape (d,).
        where: The same for people: ``state 57`` of a discrete space, else coordinates.
        log_density: Best log diverse density of the search that completed it; NaN where another method found it.
        initiation_states: Size of its initiation set.
    """

    slot: int
    episode: int
    timestep: int
    subgoal: FloatArray
    where: str
    log_density: float
    initiation_states: int


@storable
@dataclass(frozen=True)
class ClosedOption:
    """When and why an option was closed.

    Attributes:
        slot: Its slot, which another may fill.
        episode: Number of episodes that had ended.
        timestep: Primitive steps taken.
        why: What it does.
    """

    slot: int
    episode: int
    timestep: int
    why: Verdict


class OptionStatistics:
    """For TensorBoard, of each slot: runs, single steps outside the initiation set, and how the last runs ended."""

    STATE = ("_runs", "_outside", "_last", "_endings")

    def __init__(self) -> None:
        self._runs: Counter[int] = Counter()
        self._outside: Counter[int] = Counter()
        self._last: dict[int, deque[tuple[int, str]]] = {}
        self._endings: dict[int, set[str]] = {}

    def add(self, run: OptionRun) -> None:
        """Count one choice of a slot that holds an option."""
        if run.inside is False:
            self._outside[run.index] += 1
            return
        self._runs[run.index] += 1
        self._last.setdefault(run.index, deque(maxlen=WINDOW)).append((run.duration, run.termination))
        self._endings.setdefault(run.index, set()).add(run.termination)

    def forget(self, slot: int) -> None:
        """Forget the last runs of an option that is closed."""
        self._last.pop(slot, None)

    def values(self) -> dict[str, float]:
        """What is logged, by tag."""
        values: dict[str, float] = {}
        for slot in sorted({*self._runs, *self._outside}):
            values[f"options/slot_{slot}/runs"] = self._runs[slot]
            values[f"options/slot_{slot}/steps_outside"] = self._outside[slot]
        for slot, last in self._last.items():
            values[f"options/slot_{slot}/mean_duration"] = float(np.mean([duration for duration, _ in last]))
            count = Counter(why for _, why in last)
            # A termination that has left the window is logged as 0, so that TensorBoard does not keep its last share.
            for ending in sorted(self._endings[slot]):
                values[f"options/slot_{slot}/ended_{ending}"] = count[ending] / len(last)
        return values
