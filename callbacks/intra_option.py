"""Keeping up to date which options are consistent with which stored steps (`learning.intra_option`)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.execution.vec_env import as_wrapper_sees
from sb3_options.learning import heads
from sb3_options.learning.dqn import OptionDQN
from sb3_options.learning.intra_option import ConsistencyTable, consistency_of
from sb3_options.learning.replay_buffer import OptionReplayBuffer
from sb3_options.options.bank import OptionBank

CHUNK = 4096
"""Stored transitions are compared with an option in batches of this many."""

PORTION = 256
"""New transitions are compared once there are this many: one alone takes as long as a hundred together."""

CHANGE_SHARE = 16
"""An option that changed is compared anew once the buffer has been given one part in this many of its size."""


class IntraOptionUpdater:
    """Compares every stored primitive step with every option, for a replay buffer with ``intra_option``.

    Args:
        model: Being trained; `applies_to` it.
        venv: Its environment.
        bank: The options, whose feature maps work in this process.
    """

    def __init__(self, model: BaseAlgorithm, venv: VecEnv, bank: OptionBank) -> None:
        self.model, self.venv, self.bank = model, venv, bank
        self.buffer: OptionReplayBuffer = model.replay_buffer  # type: ignore[attr-defined]  # applies_to() has looked
        self.table = self.buffer.consistency = ConsistencyTable(
            self.buffer.buffer_size,
            bank.n_primitive,
            bank.max_options,
            self._values,
            outside=not isinstance(model, OptionDQN),
            quantiles=hasattr(model.policy, "quantile_net"),
        )
        self._compared = self.buffer.written
        self._changed: dict[int, int] = {}

    @staticmethod
    def applies_to(model: BaseAlgorithm) -> bool:
        """Whether the model's replay buffer asks for intra-option learning and its networks value actions."""
        buffer = getattr(model, "replay_buffer", None)
        return isinstance(buffer, OptionReplayBuffer) and buffer.intra_option and heads.has_networks(model.policy)

    def update(self) -> None:
        """Compare what was stored since the last time, and everything stored with options that changed."""
        new = self.buffer.written - self._compared
        if new >= PORTION:
            rows = (self.buffer.pos - 1 - np.arange(min(new, self.buffer.size()))) % self.buffer.buffer_size
            for slot in self.bank.filled:
                self._compare(slot, rows)
            self._compared = self.buffer.written
        for slot, changed_at in list(self._changed.items()):
            if self.buffer.written - changed_at >= self.buffer.size() // CHANGE_SHARE:
                self.compare_all(slot)

    def compare_all(self, slot: int) -> None:
        """Compare everything stored with the option in a slot."""
        self._changed.pop(slot, None)
        self._compare(slot, np.arange(self.buffer.size()))

    def note_change(self, slot: int) -> None:
        """The policy of the option in a slot has changed: everything stored is due to be compared anew."""
        self._changed.setdefault(slot, self.buffer.written)

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint; the table is the replay buffer's."""
        return {"compared": self._compared, "changed": dict(self._changed)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._compared, self._changed = state["compared"], state["changed"]

    def clear(self, slot: int) -> None:
        """The slot is empty now."""
        self._changed.pop(slot, None)
        self.table.clear_slot(slot)

    def _compare(self, slot: int, rows: npt.NDArray[np.int64]) -> None:
        option = self.bank[slot]
        assert option is not None  # only filled slots are compared
        for start in range(0, len(rows), CHUNK):
            chunk = rows[start : start + CHUNK]
            obs, actions, next_obs = self.buffer.stored(chunk)
            primitive = np.where(actions < self.bank.n_primitive, actions, -1)
            seen = as_wrapper_sees(self.venv, obs), as_wrapper_sees(self.venv, next_obs)
            self.table.record(chunk, slot, consistency_of(option, seen[0], primitive, seen[1]))

    @torch.no_grad()
    def _values(self, observations: Any, options: torch.Tensor) -> torch.Tensor:
        """Q(s', o) of the target network, (n, 1), or its quantiles, (n, n_quantiles)."""
        _, target = heads.networks(self.model.policy)
        values = target(observations)
        if values.ndim == 2:
            return torch.as_tensor(values.gather(1, options[:, None]))
        return torch.as_tensor(values[torch.arange(len(values)), :, options])
