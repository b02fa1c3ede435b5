"""What replay buffers hold, for checkpoints: the stored rows, and the counters."""

from __future__ import annotations

from typing import Any

import numpy.typing as npt
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_options.learning.bonus_replay import WITH_BONUS
from sb3_options.learning.replay_buffer import OptionReplayBuffer

KNOWN = (*WITH_BONUS, *WITH_BONUS.values())
COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
"""What SB3's buffers store, (steps, environments, ...), or a dictionary of such arrays."""

Rows = npt.NDArray[Any]


def get_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """The stored rows, which are not copied.

    Raises:
        ValueError: It is a buffer of a class that is not known.
    """
    if isinstance(buffer, OptionReplayBuffer):
        return buffer.get_state()
    _check(buffer)
    n = buffer.size() + (buffer.optimize_memory_usage and not buffer.full)  # the last one's next observation
    columns = {name: _first(getattr(buffer, name), n) for name in COLUMNS if hasattr(buffer, name)}
    return {"pos": buffer.pos, "full": buffer.full, "columns": columns}


def set_state(buffer: ReplayBuffer, state: dict[str, Any]) -> None:
    """Hold what `get_state` gave, in the same arrays.

    Raises:
        ValueError: It is a buffer of a class that is not known, or rows do not fit.
    """
    if isinstance(buffer, OptionReplayBuffer):
        buffer.set_state(state)
        return
    _check(buffer)
    buffer.pos, buffer.full = state["pos"], state["full"]
    for name, rows in state["columns"].items():
        column = getattr(buffer, name)
        for key, part in rows.items() if isinstance(rows, dict) else [(None, rows)]:
            (column if key is None else column[key])[: len(part)] = part


def _check(buffer: ReplayBuffer) -> None:
    if type(buffer) not in KNOWN:
        raise ValueError(
            f"Checkpoints of {type(buffer).__name__} are not supported yet: use OptionReplayBuffer, or SB3's "
            "ReplayBuffer, DictReplayBuffer or NStepReplayBuffer."
        )


def _first(column: Rows | dict[str, Rows], n: int) -> Rows | dict[str, Rows]:
    return {key: part[:n] for key, part in column.items()} if isinstance(column, dict) else column[:n]
