"""Keeping the replay buffer's knowledge of the options up to date: who would have taken which stored step."""

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
from sb3_options.learning.intra_option import IntraOptionMemory, judge
from sb3_options.learning.replay_buffer import OptionReplayBuffer
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option

CHUNK = 4096
"""Stored observations are judged in batches of this many."""

JUDGED_AT_ONCE = 256
"""New transitions wait until there are this many: to judge one takes as long as to judge a hundred."""

REJUDGE_SHARE = 16
"""A changed option is judged anew once the buffer has grown by one part in this many."""


class IntraOptionTeacher:
    """Judges every stored primitive step for every option.

    Args:
        model: Being trained; its buffer is an `OptionReplayBuffer` with ``intra_option``.
        venv: Its environment.
        bank: The options, whose feature maps work in this process.
    """

    def __init__(self, model: BaseAlgorithm, venv: VecEnv, bank: OptionBank) -> None:
        self.model, self.venv, self.bank = model, venv, bank
        self.buffer: OptionReplayBuffer = model.replay_buffer  # type: ignore[attr-defined]  # teaches() has looked
        masked = isinstance(model, OptionDQN)
        quantiles = hasattr(model.policy, "quantile_net")
        self.memory = self.buffer.memory = IntraOptionMemory(
            self.buffer.buffer_size,
            bank.n_primitive,
            bank.max_options,
            self._values,
            outside=not masked,
            quantiles=quantiles,
        )
        self._judged = self.buffer.written
        self._changed: dict[int, int] = {}

    @staticmethod
    def teaches(model: BaseAlgorithm) -> bool:
        """Whether there is something to teach: a replay buffer that asks for it, and values of actions."""
        buffer = getattr(model, "replay_buffer", None)
        return isinstance(buffer, OptionReplayBuffer) and buffer.intra_option and heads.has_networks(model.policy)

    def judge_new(self) -> None:
        """Judge what was stored since the last time, and anew what changed options have judged."""
        new = self.buffer.written - self._judged
        if new >= JUDGED_AT_ONCE:
            rows = (self.buffer.pos - 1 - np.arange(min(new, self.buffer.size()))) % self.buffer.buffer_size
            for slot in self.bank.filled:
                self._judge(slot, rows)
            self._judged = self.buffer.written
        for slot, changed_at in list(self._changed.items()):
            if self.buffer.written - changed_at >= self.buffer.size() // REJUDGE_SHARE:
                self.judge_all(slot)

    def judge_all(self, slot: int) -> None:
        """Judge all that is stored for a slot whose option is new."""
        self._changed.pop(slot, None)
        self._judge(slot, np.arange(self.buffer.size()))

    def changed(self, slot: int) -> None:
        """The option in a slot has learned further: judge all that is stored anew before long."""
        self._changed.setdefault(slot, self.buffer.written)

    def forget(self, slot: int) -> None:
        """The slot is empty now."""
        self._changed.pop(slot, None)
        self.memory.forget_option(slot)

    def _judge(self, slot: int, rows: npt.NDArray[np.int64]) -> None:
        option = self.bank[slot]
        assert isinstance(option, Option)  # only filled slots are judged
        for start in range(0, len(rows), CHUNK):
            chunk = rows[start : start + CHUNK]
            obs, actions, next_obs = self.buffer.stored(chunk)
            primitive = np.where(actions < self.bank.n_primitive, actions, -1)
            seen = as_wrapper_sees(self.venv, obs), as_wrapper_sees(self.venv, next_obs)
            self.memory.note(chunk, slot, judge(option, seen[0], primitive, seen[1]))

    @torch.no_grad()
    def _values(self, observations: Any, options: torch.Tensor) -> torch.Tensor:
        """Q(s', o) of the target network, (n, 1), or its quantiles, (n, n_quantiles)."""
        _, target = heads.networks(self.model.policy)
        values = target(observations)
        if values.ndim == 2:
            return torch.as_tensor(values.gather(1, options[:, None]))
        return torch.as_tensor(values[torch.arange(len(values)), :, options])
