"""Experience replay over options: γᵏ for every transition, and the primitive steps inside options."""

from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecNormalize

from sb3_options.experience.observations import BoolArray, Observations, take
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning.n_step import Successors

NO_ROWS: npt.NDArray[np.int64] = np.zeros(0, dtype=np.int64)

Rows = dict[str, npt.NDArray[Any]]  # observations by key; the key is empty unless the space is a ``Dict``


class OptionReplayBufferSamples(NamedTuple):
    """`ReplayBufferSamples` with the additions for options.

    Attributes:
        observations: (batch, ...).
        actions: Augmented actions, (batch, 1).
        next_observations: (batch, ...).
        dones: 1 where nothing follows; a timeout is not such an end. (batch, 1).
        rewards: Σ γⁱ rᵢ over the k primitive steps, (batch, 1).
        discounts: γᵏ, (batch, 1).
        next_available: Which option slots may start in the next observation, (batch, max_options); None if the buffer
            does not track availability.
    """

    observations: Any
    actions: torch.Tensor
    next_observations: Any
    dones: torch.Tensor
    rewards: torch.Tensor
    discounts: torch.Tensor
    next_available: torch.Tensor | None


class Growing(NamedTuple):
    """An array and, for each row, the number of ``changes`` at which it was last written."""

    array: npt.NDArray[Any]
    changed_at: npt.NDArray[np.int64]
    changes: int


class OptionReplayBuffer(ReplayBuffer):
    """A replay buffer that makes SB3's off-policy algorithms learn correctly over options.

    Every transition of k primitive steps is stored with Σ γⁱ rᵢ and sampled with ``discounts`` = γᵏ, which DQN, QRDQN
    and the others put into their targets: SMDP Q-learning (Bradtke & Duff 1995; Sutton, Precup & Singh 1999, §2). The
    primitive that an empty slot ran is stored as that primitive.

    Macro-Q learning (McGovern & Sutton 1998): each primitive step inside an option is stored as well, with its own
    action and reward and a discount of γ. So one run of an option updates k + 1 values.

    With ``n_steps`` the target is the return over the next n decisions (`n_step`), for the steps inside options too.

    The rows of all environments are stored in one sequence, because their options take different numbers of steps.

    Args:
        buffer_size: Maximum number of transitions.
        observation_space: Observation space, also a ``Dict``.
        action_space: Augmented actions.
        device: Device of samples.
        n_envs: Number of parallel environments.
        optimize_memory_usage: Not supported.
        handle_timeout_termination: Bootstrap after a timeout instead of treating it as an end.
        macro_q: Whether the steps inside options are stored.
        n_steps: Decisions of an n-step return, each with its own γᵏ; at least 1. Steps inside options are one each.
        gamma: Unused, as for SB3's ``NStepReplayBuffer``: every transition has its own discount.

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
        n_steps: int = 1,
        gamma: float | None = None,
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
        self.n_steps = n_steps
        self._successors = Successors(buffer_size, n_envs) if n_steps > 1 else None
        self.changes = 0
        self._changed_at = np.zeros(buffer_size, dtype=np.int64)
        self._spaces = (
            observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
        )
        shapes = self.obs_shape if isinstance(self.obs_shape, dict) else {"": self.obs_shape}
        self._shapes: dict[str, tuple[int, ...]] = shapes

        def zeros(dtype: Any, *shape: int) -> npt.NDArray[Any]:
            return np.zeros((buffer_size, *shape), dtype)

        self._observations = {k: zeros(self._spaces[k].dtype, *s) for k, s in self._shapes.items()}
        self._next_observations = {k: zeros(self._spaces[k].dtype, *s) for k, s in self._shapes.items()}
        self.actions = zeros(np.int64, self.action_dim)
        self.rewards, self.dones = zeros(np.float32), zeros(np.float32)
        self.timeouts, self.discounts = zeros(np.float32), zeros(np.float32)
        self.next_available = zeros(bool, 0)

    def track_availability(self, max_options: int) -> None:
        """Also store, for each transition, which of ``max_options`` slots may start in its next observation."""
        if self.next_available.shape[1] != max_options:
            self.next_available = np.zeros((self.buffer_size, max_options), dtype=bool)

    def next_observations_stored(self) -> Observations:
        """Return the next observations of all stored transitions, in the form of the VecEnv, row by row."""
        taken = {k: v[: self.size()] for k, v in self._next_observations.items()}
        given = {k: v.reshape(len(v), *(self._spaces[k].shape or ())) for k, v in taken.items()}
        return given.get("", given)

    @property
    def tracks_availability(self) -> bool:
        """Whether the buffer stores which slots may start in next observations."""
        return bool(self.next_available.shape[1])

    def set_next_available(self, slot: int, available: BoolArray | bool) -> None:
        """Store for all transitions whether ``slot`` may start in their next observations, shape (size,) or one value.

        Without `track_availability` nothing happens.
        """
        if self.tracks_availability:
            self.next_available[: self.size(), slot] = available

    def forget_action(self, action: int) -> None:
        """Replace each transition of ``action``, whose slot was emptied, with a copy of the next one of another action.

        With Macro-Q that is the first primitive step of the run.
        """
        named = self.actions[: self.size(), 0] == action
        rows, others = np.flatnonzero(named), np.flatnonzero(~named)
        if len(rows) == 0:
            return
        if self._successors is not None:
            self._successors.cut(rows)
        if len(others) == 0:
            self.pos = 0
            self.full = False
            return
        source = others[np.searchsorted(others, rows) % len(others)]
        for column in self._columns():
            column[rows] = column[source]
        self._note_change(rows)

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: npt.NDArray[Any],
        reward: npt.NDArray[Any],
        done: npt.NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one step of every environment, and the primitive steps inside it; all have shape (n_envs, ...).

        ``reward`` is Σ γⁱ rᵢ, and the infos have the ``info["option"]`` of `OptionsWrapper`.
        """
        if len(infos) != self.n_envs:  # it was loaded into a model with other environments
            self.n_envs = len(infos)
            if self._successors is not None:
                self._successors.begin(self.n_envs)
        obs, next_obs = self._split(obs), self._split(next_obs)
        actions = np.asarray(action).reshape(self.n_envs, self.action_dim)
        for i, info in enumerate(infos):
            run = OptionRun.from_info(info)
            if run.termination == "running":  # its environment waits, or its slot was emptied
                continue
            here = {k: v[i] for k, v in obs.items()}
            there = {k: v[i] for k, v in next_obs.items()}
            ended, timeout = bool(done[i]), bool(info.get("TimeLimit.truncated", False))
            chosen = actions[i] if run.chosen is None else run.chosen
            if run.index < 0 and run.actions is not None:
                chosen = run.actions  # a slot that ran a primitive instead is stored as that primitive
            last = None if run.available is None else run.available[-1]
            decision = self.pos
            inner = NO_ROWS
            follows = self._successors is not None and self._follows(i, here, self._successors)
            self._write(decision, here, there, chosen, reward[i], ended, timeout, run.discount, last)
            if self.macro_q and run.index >= 0 and run.actions is not None:
                inner = (self.pos + np.arange(run.duration)) % self.buffer_size
                self._write_inner(inner, run, there, ended, timeout)
            if self._successors is not None:
                self._successors.add(i, decision, inner, follows=follows, done=ended)

    def _follows(self, env: int, here: Rows, successors: Successors) -> bool:
        """Return whether a decision begins where the last one of its environment ended."""
        newest = successors.newest(env)
        return newest is not None and all(
            np.array_equal(self._next_observations[k][newest], v) for k, v in here.items()
        )

    def _write_inner(self, rows: npt.NDArray[Any], run: OptionRun, there: Rows, done: bool, timeout: bool) -> None:
        assert run.observations is not None  # an option reports its steps
        here = self.as_stored(run.observations)
        led = {key: np.concatenate([of_key[1:], there[key][None]]) for key, of_key in here.items()}
        last = np.arange(run.duration) == run.duration - 1
        assert run.actions is not None
        assert run.rewards is not None
        ends = last & done, last & timeout
        self._write(rows, here, led, run.actions[:, None], run.rewards, *ends, run.gamma, run.available)

    def as_stored(self, observations: Observations) -> Rows:
        """Return observations from below the VecEnv in the algorithm's shape: SB3 puts image channels first."""
        stored = self._split(observations)
        for key, rows in stored.items():
            shape = self._shapes[key]
            rows = rows.reshape(len(rows), *shape) if rows[0].size == 1 else rows
            if rows.shape[1:] != shape and rows.ndim == 4 and is_image_space(self._spaces[key]):
                rows = rows.transpose(0, 3, 1, 2)
            if rows.shape[1:] != shape:
                raise ValueError(
                    f"The steps inside an option have observations of shape {rows.shape[1:]}, the algorithm sees "
                    f"{shape}: a VecEnv wrapper changes them. Pass replay_buffer_kwargs={{'macro_q': False}}."
                )
            stored[key] = rows
        return stored

    def _write(
        self,
        rows: int | npt.NDArray[Any],
        obs: Rows,
        next_obs: Rows,
        actions: Any,
        rewards: Any,
        dones: Any,
        timeouts: Any,
        discounts: float,
        available: BoolArray | None,
    ) -> None:
        """Write one row or several from the current position on, over the oldest ones if the buffer is full."""
        for key in self._observations:
            self._observations[key][rows] = obs[key]
            self._next_observations[key][rows] = next_obs[key]
        self.actions[rows] = actions
        self.rewards[rows] = rewards
        self.dones[rows] = dones
        if self.handle_timeout_termination:
            self.timeouts[rows] = timeouts
        self.discounts[rows] = discounts
        if self.tracks_availability:
            self.next_available[rows] = False if available is None else available
        self._note_change(rows)
        end = self.pos + np.size(rows)
        self.full = self.full or end >= self.buffer_size
        self.pos = end % self.buffer_size

    def _note_change(self, rows: int | slice | npt.NDArray[Any]) -> None:
        self.changes += 1
        self._changed_at[rows] = self.changes

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """Draw an `OptionReplayBufferSamples` uniformly, with replacement."""
        # SB3 seeds and draws from numpy's global generator. Doing the same keeps a run without options equal.
        return BaseBuffer.sample(self, batch_size, env)

    def _get_samples(self, batch_inds: npt.NDArray[Any], env: VecNormalize | None = None) -> Any:
        def tensors(stored: Rows, rows: npt.NDArray[Any]) -> Any:
            seen: Any = self._normalize_obs(cast("Any", take(stored.get("", stored), rows)), env)
            return {k: self.to_torch(v) for k, v in seen.items()} if isinstance(seen, dict) else self.to_torch(seen)

        last = batch_inds
        rewards = self.rewards[batch_inds]
        discounts = self.discounts[batch_inds]
        if self._successors is not None:
            last, rewards, discounts = self._successors.returns(batch_inds, self.n_steps, self.rewards, self.discounts)
        rewards = self._normalize_reward(rewards.reshape(-1, 1), env)
        dones = self.dones[last] * (1 - self.timeouts[last])
        return OptionReplayBufferSamples(
            observations=tensors(self._observations, batch_inds),
            actions=self.to_torch(self.actions[batch_inds]),
            next_observations=tensors(self._next_observations, last),
            dones=self.to_torch(dones.reshape(-1, 1)),
            rewards=self.to_torch(rewards),
            discounts=self.to_torch(discounts.reshape(-1, 1)),
            next_available=self.to_torch(self.next_available[last]) if self.tracks_availability else None,
        )

    def _split(self, observations: Any) -> Rows:
        rows = observations if isinstance(observations, dict) else {"": observations}
        # A Discrete observation is a scalar to the environment and a vector of length 1 to SB3.
        return {k: v.reshape(len(v), *self._shapes[k]) if v.ndim == 1 else v for k, v in rows.items()}

    def _columns(self) -> list[npt.NDArray[Any]]:
        """Return every array with one row per transition."""
        columns = [self.actions, self.rewards, self.dones, self.timeouts, self.discounts, self.next_available]
        return [*columns, *self._observations.values(), *self._next_observations.values()]

    def growing(self) -> list[Growing]:
        """Return the observations, which take most of the memory: a checkpoint reads only the new ones."""
        return [
            Growing(array, self._changed_at, self.changes)
            for array in (*self._observations.values(), *self._next_observations.values())
        ]

    def get_state(self) -> dict[str, Any]:
        """Return the stored rows, without copying them, and the counters, for a checkpoint."""
        size = self.size()
        return {
            "counters": (self.pos, self.full),
            "columns": [column[:size] for column in self._columns()],
            "successors": None if self._successors is None else self._successors.get_state(size),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore the state from `get_state`, in the present arrays."""
        self.pos, self.full = state["counters"]
        self._note_change(np.s_[:])
        for column, rows in zip(self._columns(), state["columns"], strict=True):
            column[: len(rows)] = rows
        if self._successors is not None:
            self._successors.set_state(state["successors"])
            self.n_envs = self._successors.n_envs  # demonstrations came from one
