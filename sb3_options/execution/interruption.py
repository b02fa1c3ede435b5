"""Interruption: an option ends where another action is worth more than going on.

In s', o ends when Q(s', o) < max Q(s', a) over the available actions (Sutton, Precup & Singh 1999, §4). With exact
values the policy that interrupts is as good in every state as the one that does not, and better in some. So the agent
leaves a detour that an option has learned, once its values are known.

An option that was chosen to explore was below the best from its first state on. Interrupting it would undo the choice
after one step, and with it all temporally extended exploration. So while an agent learns, an option is interrupted only
if it was the best choice where it began. In evaluation every choice is greedy, and every option is interrupted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_options.experience.observations import BoolArray, FloatArray


@dataclass(frozen=True)
class Interruption:
    """When a running option ends, by action values as they were at some time.

    Attributes:
        values: One observation, as `OptionsWrapper` sees it → Q, (n_actions,). It is pickled for worker processes.
        masks: Whether the agent chooses among available actions only; else it chooses among all.
        every_choice: Whether options that were not the best choice where they began are interrupted as well.
    """

    values: Callable[[Any], FloatArray]
    masks: bool = False
    every_choice: bool = False

    def watch(self, action: int, observation: Any, available: Callable[[], BoolArray]) -> Callable[[Any], bool] | None:
        """What says of each state that an option arrives in whether to end it there."""
        if not self.every_choice and self.falls_behind(action, observation, available):
            return None
        return lambda arrived_in: self.falls_behind(action, arrived_in, available)

    def falls_behind(self, action: int, observation: Any, available: Callable[[], BoolArray]) -> bool:
        """Whether Q(s, action) < max Q(s, a) over the actions that may be chosen in s."""
        values = self.values(observation)
        best = np.where(available(), values, -np.inf).max() if self.masks else values.max()
        return bool(values[action] < best)
