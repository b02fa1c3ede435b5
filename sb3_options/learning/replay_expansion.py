"""What a replay buffer of SB3 holds, as an `OptionReplayBuffer`."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer

from sb3_options.learning.replay_buffer import OptionReplayBuffer

STOCK_BUFFERS = (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer)
"""What is known of these, and of no subclass, is that their rows are single primitive steps."""


def check_buffer(buffer: ReplayBuffer | None) -> None:
    """Refuse a buffer whose rows mean something that is not known.

    Raises:
        TypeError: It is neither one of SB3's own buffers for single steps nor an `OptionReplayBuffer`.
    """
    if buffer is not None and type(buffer) not in STOCK_BUFFERS and not isinstance(buffer, OptionReplayBuffer):
        raise TypeError(
            f"The transitions of a {type(buffer).__name__} cannot be taken over, only those of ReplayBuffer and "
            "DictReplayBuffer: set model.replay_buffer = None to go on with an empty one."
        )


def option_replay_buffer(stock: ReplayBuffer, action_space: spaces.Space[Any], gamma: float) -> OptionReplayBuffer:
    """A buffer that knows options, with the transitions of one that does not.

    SB3 keeps rows of (steps, environments). In this order they stand one behind the other here, so that the oldest
    are still the first to be overwritten, and as many transitions find room as before. The arrays are taken over and
    not copied: ``stock`` must not be used any more.

    Args:
        stock: One of SB3's own; `check_buffer` tells.
        action_space: Augmented actions.
        gamma: Discount γ of each transition; all are single primitive steps.

    Returns:
        The buffer, with the same transitions.
    """
    made = OptionReplayBuffer(
        stock.buffer_size * stock.n_envs,
        stock.observation_space,
        action_space,
        device=stock.device,
        n_envs=stock.n_envs,
        handle_timeout_termination=stock.handle_timeout_termination,
    )

    def flat(rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return rows.reshape(made.buffer_size, *rows.shape[2:])

    observations, following = _observations(stock)
    made._observations = {key: flat(rows) for key, rows in observations.items()}
    made._next_observations = {key: flat(rows) for key, rows in following.items()}
    made.actions = flat(stock.actions)
    made.rewards, made.dones, made.timeouts = flat(stock.rewards), flat(stock.dones), flat(stock.timeouts)
    made.discounts[:] = gamma
    made.pos, made.full = stock.pos * stock.n_envs, stock.full
    if stock.optimize_memory_usage and stock.full:
        _drop_oldest(made, stock.n_envs)
    return made


def _observations(stock: ReplayBuffer) -> tuple[dict[str, npt.NDArray[Any]], dict[str, npt.NDArray[Any]]]:
    """Observations and next observations by key, each (steps, environments, ...)."""
    if isinstance(stock, DictReplayBuffer):
        return stock.observations, stock.next_observations
    if stock.optimize_memory_usage:
        # A step's next observation is kept as the observation of the step behind it.
        return {"": stock.observations}, {"": np.roll(stock.observations, -1, axis=0)}
    return {"": stock.observations}, {"": stock.next_observations}


def _drop_oldest(buffer: OptionReplayBuffer, n_rows: int) -> None:
    """Leave out the oldest rows of a full buffer, which SB3 does not sample: their observations are overwritten."""
    for rows in (
        *buffer._observations.values(),
        *buffer._next_observations.values(),
        *(buffer.actions, buffer.rewards, buffer.dones, buffer.timeouts),
    ):
        rows[:] = np.roll(rows, -buffer.pos - n_rows, axis=0)
    buffer.pos, buffer.full = buffer.buffer_size - n_rows, False
