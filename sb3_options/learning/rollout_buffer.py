"""Rollouts over options: advantages and returns with γᵏ for every transition, for PPO, A2C and TRPO."""

import math
from collections.abc import Generator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_options.experience.observations import BoolArray, FloatArray
from sb3_options.experience.option_run import OptionRun


def smdp_advantages(
    rewards: FloatArray,
    values: FloatArray,
    next_values: FloatArray,
    discounts: FloatArray,
    goes_on: FloatArray,
    gae_lambda: FloatArray | float,
) -> FloatArray:
    """Compute generalised advantage estimates over a semi-Markov process.

    δₜ = Rₜ + γᵏ V(sₜ₊₁) − V(sₜ) and Aₜ = δₜ + γᵏ λ Aₜ₊₁, both without their second term where an episode ended
    (Schulman et al. 2016, eq. 11–16, with the discount of Bradtke & Duff 1995 for an action of k steps). The trace
    decays by λ per decision, so an option carries credit as far as a primitive action does.

    All arrays are (n_steps, n_envs). ``rewards`` are Σ γⁱ rᵢ over the k primitive steps, and ``discounts`` γᵏ;
    ``goes_on`` is 1 where the episode goes on after the step, else 0; λ is one number, or one for each transition.
    """
    deltas = rewards + discounts * next_values * goes_on - values
    decay = discounts * gae_lambda * goes_on
    advantages = np.zeros_like(deltas)
    later = np.zeros_like(deltas[0])
    for step in reversed(range(len(deltas))):
        later = advantages[step] = deltas[step] + decay[step] * later
    return advantages


def n_decisions(n_primitive_steps: int, durations: FloatArray, multiple: int = 1, least: int = 1) -> int:
    """Return how many decisions per environment take about ``n_primitive_steps``, by the last durations.

    The number is a multiple of ``multiple``, to fill minibatches, if ``n_primitive_steps`` decisions fill one. It is at
    least ``least``, and at most the number of primitive steps.
    """
    if multiple > n_primitive_steps:
        multiple = 1
    wanted = max(round(n_primitive_steps / float(durations.mean()) / multiple), 1)
    return max(multiple * min(wanted, n_primitive_steps // multiple), min(least, n_primitive_steps))


def add_bonuses(buffer: RolloutBuffer, bonuses: FloatArray) -> None:
    """Add bonuses to the rewards, advantages and returns of a complete rollout.

    Generalised advantage estimation is linear in rewards and values. So the result of `smdp_advantages` for the
    bonuses, with values of 0, can be added to the present advantages and returns.
    """
    nothing = np.zeros_like(bonuses)
    over_options = buffer if isinstance(buffer, SMDPAdvantages) else None
    discounts = np.asarray(buffer.gamma) if over_options is None else over_options.discounts
    traces = buffer.gae_lambda if over_options is None else over_options.traces()
    # No bonus follows the last step, whether the episode ended there or not.
    goes_on = 1.0 - np.concatenate([buffer.episode_starts[1:], nothing[:1]])
    advantages = smdp_advantages(bonuses, nothing, nothing, discounts, goes_on, traces)
    buffer.rewards += bonuses.astype(np.float32)
    buffer.advantages += advantages.astype(np.float32)
    buffer.returns += advantages.astype(np.float32)


def normalized_rewards(
    rewards: npt.NDArray[Any], runs: Sequence[OptionRun], normalizer: VecNormalize | None
) -> FloatArray:
    """Return Σ γⁱ r̃ᵢ over the primitive steps of each run, with ``VecNormalize``'s r̃ = clip(r / σ, ±``clip_reward``).

    ``VecNormalize`` itself would clip the sum of an option. Beyond the clip no effect of γ would be left: an option
    that reaches the goal in 120 steps would be worth as much as one that takes 1.
    """
    normalized = np.array(rewards, dtype=np.float64)
    if normalizer is not None and normalizer.norm_reward:
        for i, run in enumerate(runs):
            if run.rewards is not None:
                normalized[i] = run.gamma ** np.arange(run.duration) @ normalizer.normalize_reward(run.rewards)
    return normalized


class Choice(NamedTuple):
    """Data to learn from of a choice that another row completes."""

    action: npt.NDArray[Any]
    log_prob: torch.Tensor
    mask: npt.NDArray[Any] | None


class SMDPAdvantages(RolloutBuffer):
    """Semi-Markov advantages: put this class before SB3's rollout buffer in the bases of a subclass.

    SB3 discounts every transition with γ, and adds γ V(s) to the last reward of an episode that timed out. Here both
    discounts are γᵏ for a transition of k primitive steps. SB3 does not pass infos to the buffer. Hence a callback
    (`PrimitiveStepsCallback`, `SubgoalDiscoveryCallback`) calls `expect` before each `add`.

    Attributes:
        next_size: ``buffer_size`` of the rollout that begins with the next `reset`; None leaves it unchanged.
        n_primitive_steps: Primitive steps per rollout and environment; None if rollouts have a number of decisions.
    """

    next_size: int | None = None
    n_primitive_steps: int | None = None

    durations: FloatArray
    waits: bool = False  # whether environments wait for options to end, so that a row is a primitive step

    def reset(self) -> None:
        """Forget the last rollout."""
        if self.next_size is not None:
            self.buffer_size, self.next_size = self.next_size, None
        shape: tuple[int, ...] | None = getattr(self, "hidden_state_shape", None)
        if shape is not None:  # RecurrentPPO's buffer keeps an LSTM state for each row
            self.hidden_state_shape = (self.buffer_size, *shape[1:])
        self.durations = np.ones((self.buffer_size, self.n_envs))
        self._learned_from: BoolArray = np.ones((self.buffer_size, self.n_envs), dtype=bool)
        self.discounts = np.full((self.buffer_size, self.n_envs), self.gamma)
        self._expected: tuple[FloatArray, Sequence[OptionRun], VecNormalize | None] | None = None
        self._choices: dict[int, Choice] = getattr(self, "_choices", {})  # a rollout may end while options run
        super().reset()

    def expect(
        self, rewards: npt.NDArray[Any], runs: Sequence[OptionRun], normalizer: VecNormalize | None = None
    ) -> None:
        """Announce the step of the next call of `add`, with the run of each environment.

        ``rewards`` are Σ γⁱ rᵢ from the VecEnv, before SB3 adds a bootstrap, (n_envs,). ``normalizer`` normalises them.
        """
        self._expected = np.array(rewards, dtype=np.float64), runs, normalizer

    def add(self, *args: Any, **kwargs: Any) -> None:
        """Store one step of every environment."""
        if self._expected is None:
            raise ValueError(
                f"{type(self).__name__} was not told how long the actions took: pass PrimitiveStepsCallback() or "
                "SubgoalDiscoveryCallback() to learn()."
            )
        (given, runs, normalizer), self._expected = self._expected, None
        if not self._choices and all(map(self._is_plain_step, runs)):
            super().add(*args, **kwargs)
            return
        durations = np.array([run.duration for run in runs], dtype=np.float64)
        discounts = np.array([run.discount for run in runs], dtype=np.float64)
        self._learned_from[self.pos] = [run.termination != "running" for run in runs]
        observations, actions, rewards, starts, values, log_probs, *others = args
        if self._choices or not durations.all():
            self.waits = True
            masks = kwargs.get("action_masks")
            actions, log_probs = np.array(actions), log_probs.clone()
            kwargs |= {} if masks is None else {"action_masks": np.array(masks)}
            self._swap_choices(durations == 0, starts, actions, log_probs, kwargs.get("action_masks"))
        bootstrap = np.asarray(rewards, dtype=np.float64) - given
        rewards = normalized_rewards(given, runs, normalizer) + bootstrap * discounts / self.gamma
        self.durations[self.pos] = durations
        self.discounts[self.pos] = discounts
        super().add(observations, actions, rewards, starts, values, log_probs, *others, **kwargs)

    def _is_plain_step(self, run: OptionRun) -> bool:
        """Whether SB3 itself stores a row correctly: then `reset` has filled in its duration and discount."""
        one_step = run.duration == 1 and run.discount == self.gamma
        return one_step and run.termination == "primitive" and run.rewards is None

    def _swap_choices(
        self,
        waits: BoolArray,
        starts: npt.NDArray[Any],
        actions: npt.NDArray[Any],
        log_probs: torch.Tensor,
        masks: npt.NDArray[Any] | None,
    ) -> None:
        """Keep the choice from the row where an option begins, and put it into the row where it ends, in place."""
        for env in range(self.n_envs):
            if starts[env]:
                self._choices.pop(env, None)  # the environment was reset
            if waits[env]:
                mask = None if masks is None else masks[env].copy()
                self._choices.setdefault(env, Choice(actions[env].copy(), log_probs[env].clone(), mask))
            elif env in self._choices:
                choice = self._choices.pop(env)
                actions[env], log_probs[env] = choice.action, choice.log_prob
                if masks is not None:
                    masks[env] = choice.mask

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: npt.NDArray[Any]) -> None:
        """Compute `smdp_advantages` of the rollout; returns are advantages plus values."""
        values = self.values.astype(np.float64)
        last = last_values.detach().cpu().numpy().reshape(1, -1)
        ended = np.concatenate([self.episode_starts[1:], np.reshape(dones, (1, -1))]).astype(np.float64)
        advantages = smdp_advantages(
            self.rewards.astype(np.float64),
            values,
            np.concatenate([values[1:], last]),
            self.discounts,
            1.0 - ended,
            self.traces(),
        )
        self.advantages[:] = advantages
        self.returns[:] = advantages + values

    def traces(self) -> FloatArray | float:
        """Return λ of each transition: 1 where an environment waits for its option to end (`OptionsVecEnv`).

        Such a row has no reward, γ⁰ = 1 and the observation of the next one. So it hands the advantage of the row where
        the option ends to the decision before.
        """
        waits = self.durations == 0
        return np.where(waits, 1.0, self.gae_lambda) if waits.any() else self.gae_lambda

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        """Yield minibatches of the rollout, without rows in which an environment waited for its option to end.

        An option is learned from in the row where it ends, with the action, probability and mask of the row in which it
        was chosen.
        """
        rows = self._learned_from.T.ravel().nonzero()[0]  # in SB3's order: one environment after another
        if len(rows) == self._learned_from.size:
            yield from super().get(batch_size)
            return
        if not self.generator_ready:
            next(super().get(1))  # lays them out
        if not len(rows):  # nothing ended; a row without advantage teaches nothing
            rows = np.arange(1)
            self.advantages[:1] = 0.0
            self.returns[:1] = self.values[:1]
        rows = np.random.permutation(rows)  # noqa: NPY002  # SB3 seeds and draws from this generator
        if len(rows) == 1:
            rows = rows.repeat(2)  # advantages are divided by their spread, and a single one has none
        for minibatch in np.array_split(rows, math.ceil(len(rows) / (batch_size or len(rows)))):
            yield self._get_samples(minibatch)


class OptionRolloutBuffer(SMDPAdvantages, RolloutBuffer):
    """A rollout buffer that makes PPO, A2C and TRPO learn correctly over options; see `SMDPAdvantages`.

    ``PPO("MlpPolicy", env, rollout_buffer_class=OptionRolloutBuffer)``; `SubgoalDiscoveryCallback` and
    `PrimitiveStepsCallback` replace the buffer of a model that was built without (`option_rollout_buffer`). For
    ``Dict`` observations use `OptionDictRolloutBuffer`.
    """


class OptionDictRolloutBuffer(SMDPAdvantages, DictRolloutBuffer):
    """`OptionRolloutBuffer` for ``Dict`` observations."""


_derived: dict[type[Any], type[Any]] = {RolloutBuffer: OptionRolloutBuffer, DictRolloutBuffer: OptionDictRolloutBuffer}
"""The class that replaces each stock class. sb3-contrib may not be installed, so its buffers are added when met."""


def option_rollout_buffer(model: BaseAlgorithm) -> SMDPAdvantages | None:
    """Return the model's rollout buffer, after replacing one of SB3 or sb3-contrib with one that discounts with γᵏ.

    MaskablePPO and RecurrentPPO get a class derived from their own. RecurrentPPO's LSTM sees the observations at
    decisions only.
    """
    buffer = getattr(model, "rollout_buffer", None)
    if buffer is None or isinstance(buffer, SMDPAdvantages):
        return buffer
    stock = type(buffer)
    if stock.__module__.partition(".")[0] not in ("stable_baselines3", "sb3_contrib"):
        raise ValueError(
            f"{type(model).__name__} was built with {stock.__name__}, which discounts an option of k steps with "
            f"γ instead of γᵏ: derive a class from (SMDPAdvantages, {stock.__name__}) and pass it as "
            "rollout_buffer_class."
        )
    shape = {"hidden_state_shape": buffer.hidden_state_shape} if hasattr(buffer, "hidden_state_shape") else {}
    if stock not in _derived:
        _derived[stock] = type(f"Option{stock.__name__}", (SMDPAdvantages, stock), {})
    replacement: SMDPAdvantages = _derived[stock](
        buffer.buffer_size,
        buffer.observation_space,
        buffer.action_space,
        device=buffer.device,
        gae_lambda=buffer.gae_lambda,
        gamma=buffer.gamma,
        n_envs=buffer.n_envs,
        **shape,
    )
    model.rollout_buffer = replacement  # type: ignore[attr-defined]  # it had one
    return replacement
