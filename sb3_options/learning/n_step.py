"""n-step returns over options (Watkins 1989; Sutton, Precup & Singh 1999, §2)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Indices = npt.NDArray[np.int64]

Column = npt.NDArray[np.float32]
"""A number for each row of a replay buffer."""

END = -1  # nothing is stored that follows: the episode ended, or the newest decision


class Successors:
    """Which row of a replay buffer holds the decision that followed each row's.

    The steps inside an option are rows too: each is followed by the next one inside, the last by the next decision.
    """

    def __init__(self, buffer_size: int, n_envs: int) -> None:
        self.following: Indices = np.full(buffer_size, END, dtype=np.int64)
        self.begin(n_envs)

    def begin(self, n_envs: int) -> None:
        """Let nothing that is stored be followed by a new decision, of so many environments."""
        self._newest = [np.zeros(0, dtype=np.int64)] * n_envs

    def newest(self, env: int) -> Indices:
        """The newest decision of an environment whose episode goes on, (1,); or nothing, (0,)."""
        return self._newest[env][-1:]

    def add(self, env: int, decision: int, inner: Indices, *, follows: bool, done: bool) -> None:
        """Enter the newest decision of an environment, and the steps inside it, in order, (k,) or empty.

        ``follows``: it began where the `newest` one ended. A reset in mid-episode comes between them otherwise.
        """
        size = len(self.following)
        inner = inner[-size:]  # a longer run has overwritten its own first rows, and its decision's
        written = inner if len(inner) == size else np.append(inner, decision)
        if follows:
            self.following[self._newest[env]] = decision
        self.following[written] = END
        self.following[inner[:-1]] = inner[1:]
        self._newest = [rows[~np.isin(rows, written)] for rows in self._newest]
        self._newest[env] = written[:0] if done else written[max(len(inner) - 1, 0) :]

    def cut(self, rows: Indices) -> None:
        """End every return before and after rows that now hold other transitions."""
        self.following[np.isin(self.following, rows)] = END
        self.following[rows] = END
        self._newest = [newest[~np.isin(newest, rows)] for newest in self._newest]

    def get_state(self, size: int) -> dict[str, Any]:
        """For a checkpoint: that of the first ``size`` rows."""
        return {"following": self.following[:size], "newest": list(self._newest)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Hold what `get_state` gave."""
        self.following[: len(state["following"])] = state["following"]
        self._newest = state["newest"]

    def returns(self, rows: Indices, n: int, rewards: Column, discounts: Column) -> tuple[Indices, Column, Column]:
        """Returns from some rows over the next n decisions, or fewer where the episode ends or nothing more is stored.

        They are R₁ + γ^k₁ R₂ + γ^(k₁+k₂) R₃ + …, each Rᵢ over the kᵢ primitive steps of its decision.

        Args:
            rows: Where they begin, (batch,).
            n: Decisions.
            rewards: Of all rows of the buffer.
            discounts: The γᵏ of all rows.

        Returns:
            The row of the last decision, in whose next observation the value is bootstrapped; the returns; and γ to the
            power of all their primitive steps. (batch,) each.
        """
        last = rows
        total = rewards[rows]
        discount = discounts[rows]
        for _ in range(n - 1):
            following = self.following[last]
            goes_on = following != END
            last = np.where(goes_on, following, last)
            total = total + np.where(goes_on, discount * rewards[last], np.float32(0))
            discount = np.where(goes_on, discount * discounts[last], discount)
        return last, total, discount
