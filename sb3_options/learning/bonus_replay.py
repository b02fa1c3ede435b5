"""Replay buffers whose rewards get a bonus when they are sampled: the one that what happened is worth by then."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_options.experience.observations import FloatArray, Observations
from sb3_options.learning.n_step import Successors

Bonus: TypeAlias = Callable[[Observations], FloatArray]
"""Observations as the VecEnv gave them, (batch, ...) → the present bonus of having arrived there, (batch,)."""

Rows = npt.NDArray[np.int64]


class RowBonuses:
    """The bonuses of the rows of an `OptionReplayBuffer`.

    A row that holds an option's run of k primitive steps is worth Σ γⁱ bᵢ over them. They are the k rows behind it,
    which Macro-Q stores.

    Args:
        size: Rows of the buffer.

    Attributes:
        bonus: As long as there is one; not pickled.
        inner_steps: How many rows behind each are the steps inside it, (size,).
    """

    def __init__(self, size: int) -> None:
        self.bonus: Bonus | None = None
        self.inner_steps: Rows = np.zeros(size, dtype=np.int64)

    def sampled(
        self,
        drawn: Rows,
        arrived_in: Callable[[Rows], Observations],
        discounts: npt.NDArray[np.float32],
        successors: Successors | None,
        n_steps: int,
    ) -> npt.NDArray[np.float32]:
        """What is added to the rewards of a batch.

        Args:
            drawn: Its rows.
            arrived_in: The next observations of some rows.
            discounts: Of all rows.
            successors: Which row follows each; None for single decisions.
            n_steps: Decisions of a return.

        Returns:
            (batch, 1).
        """
        column = _OptionBonusColumn(self, arrived_in, discounts)
        bonuses = column[drawn] if successors is None else successors.returns(drawn, n_steps, column, discounts).rewards
        return bonuses[:, None]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "bonus": None}


class _OptionBonusColumn:
    """The bonus of each row: Σ γⁱ bᵢ over the primitive steps of what it holds."""

    def __init__(
        self, rows: RowBonuses, arrived_in: Callable[[Rows], Observations], discounts: npt.NDArray[np.float32]
    ) -> None:
        assert rows.bonus is not None  # or it is not asked
        self._inner_steps, self._bonus, self._arrived_in = rows.inner_steps, rows.bonus, arrived_in
        self._discounts = discounts  # of a step inside an option γ

    def __getitem__(self, rows: Rows, /) -> npt.NDArray[np.float32]:
        inner_steps = self._inner_steps[rows]
        steps = np.maximum(inner_steps, 1)
        which = np.repeat(np.arange(len(rows)), steps)
        i = np.arange(len(which)) - np.repeat(np.cumsum(steps) - steps, steps)
        primitive = (np.repeat(rows + (inner_steps > 0), steps) + i) % len(self._inner_steps)
        discounted = self._discounts[primitive].astype(np.float64) ** i * self._bonus(self._arrived_in(primitive))
        return np.bincount(which, weights=discounted, minlength=len(rows)).astype(np.float32)


class _BonusColumn:
    """Stands for the ``rewards`` of a buffer of SB3 while a batch is drawn: each is the row's bonus."""

    def __init__(self, buffer: Any) -> None:
        self._buffer = buffer

    def __getitem__(self, index: tuple[Rows, Rows]) -> npt.NDArray[np.float32]:
        """The bonuses of some rows of some environments, in the shape of the two together."""
        rows, envs = np.broadcast_arrays(*index)
        stored = self._buffer.next_observations
        parts = stored if isinstance(stored, dict) else {"": stored}
        space = self._buffer.observation_space
        given = {
            key: part[rows.ravel(), envs.ravel()].reshape(rows.size, *(space[key] if key else space).shape)
            for key, part in parts.items()
        }
        bonuses: FloatArray = self._buffer.bonus(given.get("", given))
        return bonuses.reshape(rows.shape).astype(np.float32)


def _with_bonuses(buffer: Any, stock: type[ReplayBuffer], rows: Rows, env: VecNormalize | None) -> Any:
    """The batch that SB3 makes of some rows, with the sum of bonuses that it makes of them instead of rewards."""
    if buffer.bonus is None:
        return stock._get_samples(buffer, rows, env)
    # SB3 draws the environments in here, from numpy's global generator: the same ones twice.
    drawn = np.random.get_state()  # noqa: NPY002  # SB3's own
    samples: Any = stock._get_samples(buffer, rows, env)
    np.random.set_state(drawn)  # noqa: NPY002  # SB3's own
    rewards = buffer.rewards
    try:
        buffer.rewards = _BonusColumn(buffer)
        bonuses = stock._get_samples(buffer, rows, None).rewards  # VecNormalize has its own scale
    finally:
        buffer.rewards = rewards
    return samples._replace(rewards=samples.rewards + bonuses)


class BonusReplayBuffer(ReplayBuffer):
    """``ReplayBuffer`` that adds bonuses to the rewards that it samples."""

    bonus: Bonus | None = None

    def _get_samples(self, batch_inds: Rows, env: VecNormalize | None = None) -> ReplayBufferSamples:
        return _with_bonuses(self, ReplayBuffer, batch_inds, env)  # type: ignore[no-any-return]  # as SB3's

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "bonus": None}


class BonusDictReplayBuffer(DictReplayBuffer):
    """``DictReplayBuffer`` that adds bonuses to the rewards that it samples."""

    bonus: Bonus | None = None

    def _get_samples(self, batch_inds: Rows, env: VecNormalize | None = None) -> Any:
        return _with_bonuses(self, DictReplayBuffer, batch_inds, env)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "bonus": None}


class BonusNStepReplayBuffer(NStepReplayBuffer):
    """``NStepReplayBuffer`` that adds the bonuses of all n steps to the returns that it samples."""

    bonus: Bonus | None = None

    def _get_samples(self, batch_inds: Rows, env: VecNormalize | None = None) -> ReplayBufferSamples:
        return _with_bonuses(self, NStepReplayBuffer, batch_inds, env)  # type: ignore[no-any-return]  # as SB3's

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "bonus": None}


WITH_BONUS: dict[type[ReplayBuffer], type[Any]] = {
    ReplayBuffer: BonusReplayBuffer,
    DictReplayBuffer: BonusDictReplayBuffer,
    NStepReplayBuffer: BonusNStepReplayBuffer,
}
"""What a buffer of SB3 becomes as long as there is a bonus; of other classes it is not known what they sample."""


def set_bonus(buffer: ReplayBuffer, bonus: Bonus | None) -> None:
    """Let a buffer add a bonus to the rewards that it samples; or, with None, let it be as it was.

    Args:
        buffer: One of SB3's own, or an `OptionReplayBuffer`.
        bonus: Is asked anew for each batch.

    Raises:
        TypeError: It is a buffer of another class.
        ValueError: It does not store what the bonus is for.
    """
    row_bonuses: RowBonuses | None = getattr(buffer, "row_bonuses", None)
    if row_bonuses is not None:
        row_bonuses.bonus = bonus
        return
    stock = next((stock for stock, made in WITH_BONUS.items() if type(buffer) in (stock, made)), None)
    if stock is None:
        raise TypeError(
            f"A bonus cannot be added to what {type(buffer).__name__} samples: IntrinsicRewardCallback knows "
            "OptionReplayBuffer and SB3's ReplayBuffer, DictReplayBuffer and NStepReplayBuffer."
        )
    if buffer.optimize_memory_usage:
        raise ValueError(
            "With optimize_memory_usage=True a replay buffer does not keep the last observation of an episode, whose "
            "bonus is to be added: pass optimize_memory_usage=False."
        )
    # The algorithm keeps this very object, and a copy would take as much memory again.
    buffer.__class__ = stock if bonus is None else WITH_BONUS[stock]
    buffer.bonus = bonus  # type: ignore[attr-defined]  # of the classes above
