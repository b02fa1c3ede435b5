"""Rollouts over options: advantages and returns with γᵏ for every transition, for PPO, A2C and TRPO."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer

from sb3_options.experience.observations import FloatArray
from sb3_options.experience.option_run import OptionRun


class Passage(NamedTuple):
    """What one step of all environments took, in their order.

    Attributes:
        rewards: Σ γⁱ rᵢ over the primitive steps, before any bootstrap, (n_envs,).
        durations: Primitive steps k, (n_envs,).
        discounts: γᵏ, (n_envs,).
    """

    rewards: FloatArray
    durations: FloatArray
    discounts: FloatArray


def passage_of(rewards: npt.NDArray[Any], runs: Sequence[OptionRun]) -> Passage:
    """What one step took, from what the environments reported.

    Args:
        rewards: As the VecEnv gave them, (n_envs,).
        runs: Of each environment.
    """
    return Passage(
        np.array(rewards, dtype=np.float64),
        np.array([run.duration for run in runs], dtype=np.float64),
        np.array([run.discount for run in runs], dtype=np.float64),
    )


def smdp_advantages(
    rewards: FloatArray,
    values: FloatArray,
    next_values: FloatArray,
    discounts: FloatArray,
    goes_on: FloatArray,
    gae_lambda: float,
) -> FloatArray:
    """Generalised advantage estimation over a semi-Markov process.

    δₜ = Rₜ + γᵏ V(sₜ₊₁) − V(sₜ) and Aₜ = δₜ + γᵏ λ Aₜ₊₁, both without their second term where an episode ended
    (Schulman et al. 2016, eq. 11–16, with the discount of Bradtke & Duff 1995 for an action of k steps). The trace
    decays by λ per decision, so that an option carries credit as far as a primitive action does.

    Args:
        rewards: Rₜ = Σ γⁱ rᵢ over the k primitive steps, (n_steps, n_envs); likewise all others.
        values: V(sₜ).
        next_values: V(sₜ₊₁).
        discounts: γᵏ.
        goes_on: 1 where the episode goes on after the step, else 0.
        gae_lambda: λ, one number.

    Returns:
        Aₜ, (n_steps, n_envs).
    """
    deltas = rewards + discounts * next_values * goes_on - values
    decay = discounts * gae_lambda * goes_on
    advantages = np.zeros_like(deltas)
    later = np.zeros_like(deltas[0])
    for step in reversed(range(len(deltas))):
        later = advantages[step] = deltas[step] + decay[step] * later
    return advantages


class SMDPAdvantages:
    """Makes the advantages of an SB3 rollout buffer those of a semi-Markov process; stands before it in the bases.

    SB3 discounts every transition with γ, and adds γ V(s) to the last reward of an episode that timed out. Here both
    are γᵏ for a transition of k primitive steps. The buffer sees no infos, so a callback (`PrimitiveStepsCallback`,
    `SubgoalDiscoveryCallback`) calls `expect` before each `add`.

    """

    # Of the SB3 buffer that stands behind this class in the bases.
    buffer_size: int
    n_envs: int
    gamma: float
    gae_lambda: float
    rewards: npt.NDArray[np.float32]
    values: npt.NDArray[np.float32]
    episode_starts: npt.NDArray[np.float32]
    advantages: npt.NDArray[np.float32]
    returns: npt.NDArray[np.float32]
    pos: int

    def reset(self) -> None:
        """Forget the last rollout."""
        self.durations = np.ones((self.buffer_size, self.n_envs))
        self.discounts = np.full((self.buffer_size, self.n_envs), self.gamma)
        self._expected: Passage | None = None
        super().reset()  # type: ignore[misc]  # the SB3 buffer's

    def expect(self, passage: Passage) -> None:
        """Say what the step took that `add` is about to be called for."""
        self._expected = passage

    def add(self, *args: Any, **kwargs: Any) -> None:
        """Store one step of every environment.

        Args:
            *args: As for the SB3 buffer: observations, actions, rewards of shape (n_envs,), to which SB3 has added
                γ V(s) where an episode timed out, and so on.
            **kwargs: As for the SB3 buffer.

        Raises:
            ValueError: Nobody said how long the actions took.
        """
        if self._expected is None:
            raise ValueError(
                f"{type(self).__name__} was not told how long the actions took: pass PrimitiveStepsCallback() or "
                "SubgoalDiscoveryCallback() to learn()."
            )
        passage, self._expected = self._expected, None
        observations, actions, rewards, *others = args
        bootstrap = np.asarray(rewards, dtype=np.float64) - passage.rewards
        rewards = passage.rewards + bootstrap * passage.discounts / self.gamma
        self.durations[self.pos] = passage.durations
        self.discounts[self.pos] = passage.discounts
        super().add(observations, actions, rewards, *others, **kwargs)  # type: ignore[misc]  # the SB3 buffer's

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: npt.NDArray[Any]) -> None:
        """`smdp_advantages` of the rollout; returns are advantages plus values.

        Args:
            last_values: V of the observations after the last step, (n_envs,) or (n_envs, 1).
            dones: Whether the last step ended an episode, (n_envs,).
        """
        values = self.values.astype(np.float64)
        last = last_values.detach().cpu().numpy().reshape(1, -1)
        ended = np.concatenate([self.episode_starts[1:], np.reshape(dones, (1, -1))]).astype(np.float64)
        advantages = smdp_advantages(
            self.rewards.astype(np.float64),
            values,
            np.concatenate([values[1:], last]),
            self.discounts,
            1.0 - ended,
            self.gae_lambda,
        )
        self.advantages[:] = advantages
        self.returns[:] = advantages + values


class OptionRolloutBuffer(SMDPAdvantages, RolloutBuffer):
    """A rollout buffer that makes PPO, A2C and TRPO learn correctly over options; see `SMDPAdvantages`.

    ``PPO("MlpPolicy", env, rollout_buffer_class=OptionRolloutBuffer)``; `SubgoalDiscoveryCallback` and
    `PrimitiveStepsCallback` put it into a model that was built without. For ``Dict`` observations it is
    `OptionDictRolloutBuffer`.

    Args:
        buffer_size: Decisions per environment.
        observation_space: No ``Dict``.
        action_space: Augmented actions.
        *args: ``device``, ``gae_lambda``, ``gamma`` and ``n_envs``, as for ``RolloutBuffer``.
        **kwargs: The same by name.

    Raises:
        ValueError: Observations are a ``Dict``.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *args: Any,
        **kwargs: Any,
    ) -> None:
        if isinstance(observation_space, spaces.Dict):
            raise ValueError("For Dict observations pass rollout_buffer_class=OptionDictRolloutBuffer.")
        super().__init__(buffer_size, observation_space, action_space, *args, **kwargs)


class OptionDictRolloutBuffer(SMDPAdvantages, DictRolloutBuffer):
    """`OptionRolloutBuffer` for ``Dict`` observations."""
