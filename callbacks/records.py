"""What `SubgoalDiscoveryCallback` remembers of the options it made and closed."""

from __future__ import annotations

from dataclasses import dataclass

from sb3_options.execution.trials import Verdict
from sb3_options.experience.observations import FloatArray


@dataclass(frozen=True)
class DiscoveredOption:
    """When and where an option was made.

    Attributes:
        slot: Its slot.
        episode: Number of episodes, or of segments between peaks of reward, that had ended.
        timestep: Primitive steps taken.
        subgoal: The subgoal's centre in concept space, shape (d,).
        log_density: Best log diverse density of the search that completed it.
        initiation_states: Size of its initiation set.
    """

    slot: int
    episode: int
    timestep: int
    subgoal: FloatArray
    log_density: float
    initiation_states: int


@dataclass(frozen=True)
class ClosedOption:
    """When and why an option was closed.

    Attributes:
        slot: Its slot, which another may fill.
        episode: Number of episodes that had ended.
        timestep: Primitive steps taken.
        why: What its trial showed.
    """

    slot: int
    episode: int
    timestep: int
    why: Verdict
