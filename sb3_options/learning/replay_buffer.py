"""Experience replay over options: γᵏ for every transition, and the primitive steps inside options."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_options.experience.observations import BoolArray, Observations, take
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning.intra_option import IntraOptionMemory

Rows = dict[str, npt.NDArray[Any]]

QUANTILE_LESSONS = 0.25
"""QRDQN takes batches of one size only, so that there at most this share of a batch makes room for lessons."""


class OptionReplayBufferSamples(NamedTuple):
    """`ReplayBufferSamples` with what options add.

    Attributes:
        observations: (batch, ...).
        actions: Augmented actions, (batch, 1).
        next_observations: (batch, ...).
        dones: 1 where nothing follows; a timeout is not such an end. (batch, 1).
        rewards: Σ γⁱ rᵢ over the k primitive steps, (batch, 1).
        discounts: γᵏ, (batch, 1).
        next_available: Which option slots may start in the next observation, (batch, max_options); None where the
            buffer was told of no primitive actions.
    """

    observations: Any
    actions: torch.Tensor
    next_observations: Any
    dones: torch.Tensor
    rewards: torch.Tensor
    discounts: torch.Tensor
    next_available: torch.Tensor | None


class OptionReplayBuffer(ReplayBuffer):
    """A replay buffer that makes SB3's off-policy algorithms learn correctly over options.

    Every transition of k primitive steps is stored with Σ γⁱ rᵢ and sampled with ``discounts`` = γᵏ, which DQN,
    QRDQN and the others put into their targets: SMDP Q-learning (Bradtke & Duff 1995; Sutton, Precup & Singh 1999,
    §2). What an empty slot really ran is stored as the primitive it was.

    Macro-Q learning (McGovern & Sutton 1998): each primitive step inside an option is stored as well, with its own
    action and reward and a discount of γ, so that one run of an option teaches k + 1 values.

    Intra-option learning (Sutton, Precup & Singh 1999, §6; `intra_option`): every primitive step of a batch also
    becomes a transition of each option whose policy would have taken it. Options are known where
    `SubgoalDiscoveryCallback` trains the model. At most as many such rows are added as were drawn; SB3's loss is a
    mean over all rows, so that those drawn keep at least half of their weight.

    The rows of all environments stand one behind the other, because their options take different numbers of steps.

    Args:
        buffer_size: Most transitions it holds.
        observation_space: Also ``Dict``.
        action_space: Augmented actions.
        device: Where samples go.
        n_envs: Number of parallel environments.
        optimize_memory_usage: Not supported.
        handle_timeout_termination: Bootstrap after a timeout instead of taking it for an end.
        macro_q: Whether the steps inside options are stored.
        intra_option: Whether primitive steps teach the options that would have taken them. Off by default: on the
            two seeds measured it saved no time (docs/deep.md).

    Raises:
        ValueError: ``optimize_memory_usage`` is set.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: torch.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        *,
        macro_q: bool = True,
        intra_option: bool = False,
    ) -> None:
        if optimize_memory_usage:
            raise ValueError(
                "OptionReplayBuffer needs optimize_memory_usage=False: with options the next observation of one "
                "transition is not the observation of the following one."
            )
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.macro_q = macro_q
        self.intra_option = intra_option
        self.memory: IntraOptionMemory | None = None
        self.written = 0
        self._spaces = (
            observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
        )
        shapes = self.obs_shape if isinstance(self.obs_shape, dict) else {"": self.obs_shape}
        self._shapes: dict[str, tuple[int, ...]] = shapes

        def empty() -> dict[str, npt.NDArray[Any]]:
            return {k: np.zeros((buffer_size, *s), self._spaces[k].dtype) for k, s in self._shapes.items()}

        self._observations, self._next_observations = empty(), empty()
        self.actions = np.zeros((buffer_size, self.action_dim), dtype=np.int64)
        self.rewards = np.zeros(buffer_size, dtype=np.float32)
        self.dones = np.zeros(buffer_size, dtype=np.float32)
        self.timeouts = np.zeros(buffer_size, dtype=np.float32)
        self.discounts = np.zeros(buffer_size, dtype=np.float32)
        self.next_available = np.zeros((buffer_size, 0), dtype=bool)

    def track_availability(self, max_options: int) -> None:
        """Also keep, for each transition, which of ``max_options`` slots may start in its next observation."""
        if self.next_available.shape[1] != max_options:
            self.next_available = np.zeros((self.buffer_size, max_options), dtype=bool)

    def next_observations_stored(self) -> Observations:
        """The next observations of all stored transitions, as the VecEnv gave them, row by row."""
        return self._as_given(self._next_observations, np.s_[: self.size()])

    def stored(self, rows: slice | npt.NDArray[Any]) -> tuple[Observations, npt.NDArray[np.int64], Observations]:
        """Observations as the VecEnv gave them, augmented actions (n,) and next observations of some rows."""
        given = self._as_given(self._observations, rows), self._as_given(self._next_observations, rows)
        return given[0], self.actions[rows, 0], given[1]

    def _as_given(self, stored: Rows, rows: slice | npt.NDArray[Any]) -> Observations:
        taken = {k: v[rows] for k, v in stored.items()}
        return self._joined({k: v.reshape(len(v), *(self._spaces[k].shape or ())) for k, v in taken.items()})

    def set_next_available(self, slot: int, available: BoolArray) -> None:
        """Say of all stored transitions whether ``slot`` may start in their next observations, shape (size,)."""
        self.next_available[: len(available), slot] = available

    def forget_action(self, action: int) -> None:
        """Put other transitions in the place of those that name ``action``, whose slot is being emptied.

        The next stored transition takes the place of each: with Macro-Q that is the first primitive step of the run.
        """
        size = self.size()
        named = self.actions[:size, 0] == action
        others = np.flatnonzero(~named)
        if len(others) == 0:
            self.pos, self.full = 0, False
            return
        rows = np.flatnonzero(named)
        source = others[np.searchsorted(others, rows) % len(others)]
        columns = [self.actions, self.rewards, self.dones, self.timeouts, self.discounts, self.next_available]
        for column in [*columns, *self._observations.values(), *self._next_observations.values()]:
            column[rows] = column[source]
        if self.memory is not None:
            self.memory.copy(source, rows)

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: npt.NDArray[Any],
        reward: npt.NDArray[Any],
        done: npt.NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one step of every environment, and the primitive steps inside it.

        Args:
            obs: (n_envs, ...).
            next_obs: (n_envs, ...).
            action: Augmented actions, (n_envs,) or (n_envs, 1).
            reward: Σ γⁱ rᵢ, (n_envs,).
            done: (n_envs,).
            infos: With ``info["option"]``, as `OptionsWrapper` leaves it.

        Raises:
            ValueError: An info has no record of what ran (`OptionRun.from_info`).
        """
        obs, next_obs = self._split(obs), self._split(next_obs)
        actions = np.asarray(action).reshape(self.n_envs, self.action_dim)
        for i, info in enumerate(infos):
            run = OptionRun.from_info(info)
            here = {k: v[i][None] for k, v in obs.items()}
            there = {k: v[i][None] for k, v in next_obs.items()}
            timeout = bool(info.get("TimeLimit.truncated", False))
            # A slot that ran a primitive instead is stored as that primitive.
            chosen = actions[i] if run.actions is None or run.index >= 0 else run.actions
            last = None if run.available is None else run.available[-1:]
            self._write(
                here,
                there,
                chosen[None],
                reward[i : i + 1],
                done[i : i + 1],
                timeout,
                run.discount,
                last,
            )
            if self.macro_q and run.index >= 0 and run.actions is not None:
                self._write_inner(run, there, bool(done[i]), timeout)

    def _write_inner(self, run: OptionRun, there: Rows, done: bool, timeout: bool) -> None:
        began = {key: self._as_stored(key, rows) for key, rows in self._split(run.observations).items()}
        led = {key: np.concatenate([rows[1:], there[key]]) for key, rows in began.items()}
        dones = np.zeros(run.duration, dtype=np.float32)
        dones[-1] = done
        timeouts = np.zeros(run.duration, dtype=np.float32)
        timeouts[-1] = timeout
        assert run.actions is not None  # an option reports its steps
        assert run.rewards is not None
        self._write(began, led, run.actions[:, None], run.rewards, dones, timeouts, run.gamma, run.available)

    def _as_stored(self, key: str, rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Observations from below the VecEnv in the shape the algorithm sees: SB3 puts image channels first."""
        shape = self._shapes[key]
        rows = rows.reshape(len(rows), *shape) if rows[0].size == 1 else rows
        if rows.shape[1:] != shape and rows.ndim == 4 and is_image_space(self._spaces[key]):
            rows = rows.transpose(0, 3, 1, 2)
        if rows.shape[1:] != shape:
            raise ValueError(
                f"The steps inside an option have observations of shape {rows.shape[1:]}, the algorithm sees {shape}: "
                "a VecEnv wrapper changes them. Pass replay_buffer_kwargs={'macro_q': False}."
            )
        return rows

    def _write(
        self,
        obs: Rows,
        next_obs: Rows,
        actions: npt.NDArray[Any],
        rewards: npt.NDArray[Any],
        dones: npt.NDArray[Any],
        timeouts: npt.NDArray[Any] | bool,
        discounts: float,
        available: BoolArray | None,
    ) -> None:
        """Write n rows at the current position, over the oldest ones where the buffer is full."""
        n = len(actions)
        if n == 1 or self.pos + n <= self.buffer_size:
            rows: slice | npt.NDArray[Any] = slice(self.pos, self.pos + n)
        else:
            rows = (self.pos + np.arange(n)) % self.buffer_size
        for key in self._observations:
            self._observations[key][rows] = obs[key]
            self._next_observations[key][rows] = next_obs[key]
        self.actions[rows] = actions
        self.rewards[rows] = rewards
        self.dones[rows] = dones
        if self.handle_timeout_termination:
            self.timeouts[rows] = timeouts
        self.discounts[rows] = discounts
        if self.next_available.shape[1]:
            self.next_available[rows] = False if available is None else available
        if self.memory is not None:
            self.memory.forget(rows)
        self.written += n
        self.full = self.full or self.pos + n >= self.buffer_size
        self.pos = (self.pos + n) % self.buffer_size

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw transitions uniformly, with replacement.

        Args:
            batch_size: How many.
            env: Normalises observations and rewards.

        Returns:
            An `OptionReplayBufferSamples`, which has all fields of ``ReplayBufferSamples``.
        """
        # SB3 seeds and draws from numpy's global generator; drawing as it does keeps a run without options equal.
        return BaseBuffer.sample(self, batch_size, env)  # type: ignore[no-any-return]  # SB3 leaves it unannotated

    def _get_samples(self, batch_inds: npt.NDArray[Any], env: VecNormalize | None = None) -> ReplayBufferSamples:
        if self.memory is None:
            return cast("ReplayBufferSamples", self.rows_as_samples(batch_inds, env))
        n = len(batch_inds)
        limit = int(QUANTILE_LESSONS * n) if self.memory.quantiles else n
        lessons = self.memory.lessons(batch_inds, limit)
        if lessons is None:
            return cast("ReplayBufferSamples", self.rows_as_samples(batch_inds, env))
        drawn = batch_inds[: n - len(lessons.rows)] if self.memory.quantiles else batch_inds
        samples = self.rows_as_samples(np.concatenate([drawn, lessons.rows]), env)
        return cast("ReplayBufferSamples", self.memory.teach(samples, lessons))

    def rows_as_samples(self, rows: npt.NDArray[Any], env: VecNormalize | None = None) -> OptionReplayBufferSamples:
        """These stored transitions, as the algorithm takes them."""
        obs = self._normalize_obs(self._joined_rows(self._observations, rows), env)
        next_obs = self._normalize_obs(self._joined_rows(self._next_observations, rows), env)
        dones = self.dones[rows] * (1 - self.timeouts[rows])
        available = self.next_available[rows] if self.next_available.shape[1] else None
        return OptionReplayBufferSamples(
            observations=self._tensors(obs),
            actions=self.to_torch(self.actions[rows]),
            next_observations=self._tensors(next_obs),
            dones=self.to_torch(dones.reshape(-1, 1)),
            rewards=self.to_torch(self._normalize_reward(self.rewards[rows].reshape(-1, 1), env)),
            discounts=self.to_torch(self.discounts[rows].reshape(-1, 1)),
            next_available=None if available is None else self.to_torch(available),
        )

    def _split(self, observations: Any) -> Rows:
        rows = observations if isinstance(observations, dict) else {"": observations}
        # A Discrete observation is a scalar to the environment and a vector of one to SB3.
        return {k: v.reshape(len(v), *self._shapes[k]) if v.ndim == 1 else v for k, v in rows.items()}

    def _joined(self, rows: Rows) -> Observations:
        return rows.get("", rows)

    def _joined_rows(self, rows: Rows, indices: npt.NDArray[Any]) -> Any:
        return take(self._joined(rows), indices)

    def _tensors(self, observations: Any) -> Any:
        if isinstance(observations, dict):
            return {key: self.to_torch(value) for key, value in observations.items()}
        return self.to_torch(observations)
