"""n-step returns over options (Watkins 1989; Sutton, Precup & Singh 1999, §2)."""

from typing import Any

import numpy as np
import numpy.typing as npt

Indices = npt.NDArray[np.int64]

Column = npt.NDArray[np.float32]  # a number for each row of a replay buffer
END = -1  # no stored row follows: the episode ended, or this is the newest decision


class Successors:
    """Links each row of a replay buffer to the row of the decision that followed.

    The steps inside an option are rows too. The next step inside follows each of them, and the next decision the last.
    """

    def __init__(self, buffer_size: int, n_envs: int) -> None:
        self.following: Indices = np.full(buffer_size, END, dtype=np.int64)
        self.begin(n_envs)

    def begin(self, n_envs: int) -> None:
        """Start new sequences for ``n_envs`` environments: no new decision follows a stored one."""
        self._newest: list[list[int]] = [[] for _ in range(n_envs)]

    @property
    def n_envs(self) -> int:
        """Number of environments whose decisions are linked."""
        return len(self._newest)

    def newest(self, env: int) -> int | None:
        """Return the newest decision of an environment whose episode goes on, or None."""
        return self._newest[env][-1] if self._newest[env] else None

    def add(self, env: int, decision: int, inner: Indices, *, follows: bool, done: bool) -> None:
        """Enter the newest decision of an environment, and the steps inside it, in order, (k,) or empty.

        ``follows``: it began where the `newest` one ended, without a reset in mid-episode between them.
        """
        size = len(self.following)
        inner = inner[-size:]  # a longer run has overwritten its own first rows, and its decision's
        written = inner.tolist() if len(inner) == size else [*inner.tolist(), decision]
        if follows:
            self.following[self._newest[env]] = decision
        self.following[written] = END
        self.following[inner[:-1]] = inner[1:]
        self._forget(set(written))
        self._newest[env] = [] if done else written[max(len(inner) - 1, 0) :]

    def _forget(self, rows: set[int]) -> None:
        """Let no decision follow these rows: they hold other transitions."""
        self._newest = [
            newest if rows.isdisjoint(newest) else [row for row in newest if row not in rows] for newest in self._newest
        ]

    def cut(self, rows: Indices) -> None:
        """End every return before and after rows that now hold other transitions."""
        self.following[np.isin(self.following, rows)] = END
        self.following[rows] = END
        self._forget(set(rows.tolist()))

    def get_state(self, size: int) -> dict[str, Any]:
        """Return the state of the first ``size`` rows, for a checkpoint."""
        return {"following": self.following[:size], "newest": list(self._newest)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore the state from `get_state`."""
        self.following[: len(state["following"])] = state["following"]
        self._newest = state["newest"]

    def returns(self, rows: Indices, n: int, rewards: Column, discounts: Column) -> tuple[Indices, Column, Column]:
        """Compute returns over the next n decisions, or fewer if the episode ends or no more are stored.

        They begin in ``rows``, (batch,), and are R₁ + γ^k₁ R₂ + γ^(k₁+k₂) R₃ + …, each Rᵢ over the kᵢ primitive steps
        of its decision. ``rewards`` and ``discounts`` γᵏ are those of the whole buffer.

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
