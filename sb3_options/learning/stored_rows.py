"""`StoredRows`: what an `OptionReplayBuffer` holds, row by row, and how a checkpoint takes it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy.typing as npt

from sb3_options.learning.bonus_replay import RowBonuses
from sb3_options.learning.intra_option import ConsistencyTable
from sb3_options.learning.n_step import Successors

Rows = dict[str, npt.NDArray[Any]]


class Growing(NamedTuple):
    """How far an array has come that is written row by row, and over its oldest rows once it is full.

    Attributes:
        array: All of it.
        written: Rows written so far.
        at: The row that is written next.
        changes: How often rows were changed in another way.
    """

    array: npt.NDArray[Any]
    written: int
    at: int
    changes: int


class StoredRows:
    """The part of an `OptionReplayBuffer` that knows all its columns. It comes before the SB3 buffer in the bases."""

    pos: int
    full: bool
    written: int
    copies: int
    heads_are_closed: bool
    consistency: ConsistencyTable | None
    row_bonuses: RowBonuses | None
    _successors: Successors | None
    _observations: Rows
    _next_observations: Rows
    actions: npt.NDArray[Any]
    rewards: npt.NDArray[Any]
    dones: npt.NDArray[Any]
    timeouts: npt.NDArray[Any]
    discounts: npt.NDArray[Any]
    next_available: npt.NDArray[Any]

    def _columns(self) -> list[npt.NDArray[Any]]:
        """Every array with one row per transition."""
        columns = [self.actions, self.rewards, self.dones, self.timeouts, self.discounts, self.next_available]
        columns += [] if self.row_bonuses is None else [self.row_bonuses.inner_steps]
        return [*columns, *self._observations.values(), *self._next_observations.values()]

    def _checkpointed(self) -> list[npt.NDArray[Any]]:
        return [*self._columns(), *(() if self.consistency is None else self.consistency.columns())]

    def growing(self) -> list[Growing]:
        """The observations, of which a checkpoint need not read again what it has: they are most of the memory."""
        return [
            Growing(array, self.written, self.pos, self.copies)
            for array in (*self._observations.values(), *self._next_observations.values())
        ]

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint: the stored rows, which are not copied, and the counters."""
        size: int = self.size()  # type: ignore[attr-defined]  # the SB3 buffer's
        return {
            "counters": (self.pos, self.full, self.written, self.heads_are_closed),
            "slots": self.next_available.shape[1],
            "columns": [column[:size] for column in self._checkpointed()],
            "successors": None if self._successors is None else self._successors.get_state(size),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Hold what `get_state` gave, in the arrays that there are.

        Raises:
            ValueError: The rows have another shape, or there are more of them.
        """
        self.pos, self.full, self.written, self.heads_are_closed = state["counters"]
        self.track_availability(state["slots"])  # type: ignore[attr-defined]  # the buffer's
        for column, rows in zip(self._checkpointed(), state["columns"], strict=True):
            column[: len(rows)] = rows
        if self._successors is not None:
            self._successors.set_state(state["successors"])
