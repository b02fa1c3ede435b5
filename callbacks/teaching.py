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
from sb3_options.learning.head_teaching import HeadLessons, teach_head
from sb3_options.learning.intra_option import IntraOptionMemory, judge
from sb3_options.learning.replay_buffer import OptionReplayBuffer
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option

CHUNK = 4096
"""Stored observations are judged in batches of this many."""

JUDGED_AT_ONCE = 256
"""New transitions wait until there are this many: to judge one takes as long as to judge a hundred."""

HEAD_LESSONS = 10_000
"""Most steps inside, and as many outside, an initiation set that teach a new head."""

REJUDGE_SHARE = 16
"""A changed option is judged anew once the buffer has grown by one part in this many."""


class IntraOptionTeacher:
    """Judges every stored primitive step for every option, and teaches new heads.

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
        memory = IntraOptionMemory(
            self.buffer.buffer_size, bank.n_primitive, bank.max_options, outside=not masked, quantiles=quantiles
        )
        self.memory = self.buffer.memory = memory
        if self.buffer.intra_option:
            memory.values = self._values
        self._judged = self.buffer.written
        self._changed: dict[int, int] = {}

    @staticmethod
    def teaches(model: BaseAlgorithm) -> bool:
        """Whether there is something to teach: a replay buffer that knows options, and values of actions."""
        buffer = getattr(model, "replay_buffer", None)
        return isinstance(buffer, OptionReplayBuffer) and heads.has_networks(model.policy)

    def judge_new(self) -> None:
        """Judge what was stored since the last time, and anew what changed options have judged."""
        if self.memory.values is None:
            return  # only new heads are taught
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

    def teach_new_head(self, slot: int) -> bool:
        """Fit the head of an option that has just moved in, and been judged.

        Returns:
            Whether anything stored could teach it.
        """
        memory, buffer = self.memory, self.buffer
        takes = memory.takes[: buffer.size(), slot]
        inside = _evenly(np.flatnonzero(takes & memory.inside[: buffer.size(), slot]), HEAD_LESSONS)
        outside = _evenly(np.flatnonzero(takes & ~memory.inside[: buffer.size(), slot]), HEAD_LESSONS)
        if len(inside) == 0:
            return False
        rows = np.concatenate([inside, outside])
        samples = buffer.rows_as_samples(rows, self.model.get_vec_normalize_env())
        # There is far more outside than inside, and inside is where it will be chosen.
        weights = np.concatenate([np.full(len(s), 1.0 / len(s)) for s in (inside, outside) if len(s)]) * len(rows)
        n_actions = self.bank.n_primitive + self.bank.max_options
        allowed = torch.ones((len(rows), n_actions), dtype=torch.bool, device=samples.rewards.device)
        if samples.next_available is not None:
            allowed[:, self.bank.n_primitive :] = samples.next_available
        lessons = HeadLessons(
            samples.observations,
            samples.next_observations,
            samples.rewards,
            samples.discounts * (1 - samples.dones),
            buffer.to_torch(memory.goes_on[rows, slot])[:, None],
            buffer.to_torch(weights)[:, None],
            allowed,
        )
        self.model.policy.set_training_mode(False)
        teach_head(self.model.policy, self.bank.n_primitive + slot, self.bank.n_primitive, lessons)
        return True


def _evenly(rows: npt.NDArray[np.int64], most: int) -> npt.NDArray[np.int64]:
    """At most ``most`` of the rows, evenly spaced."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(np.int64)]
