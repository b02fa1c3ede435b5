"""Families of algorithms: where an algorithm keeps its heads, masks and buffers, and what follows for options.

`family_of` returns the adapter of a model. No other module checks which algorithm a model belongs to.
"""

import inspect
import logging
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer, DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, is_vecenv_wrapped

from sb3_options.discovery.budget import STEP_SECONDS, TABLE_STEP_SECONDS
from sb3_options.execution.options_vec_env import OptionsVecEnv
from sb3_options.learning import heads
from sb3_options.learning.macro_q import MacroQ
from sb3_options.learning.replay_buffer import OptionReplayBuffer

logger = logging.getLogger("sb3_options")

STOCK_BUFFERS = (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer)  # an `OptionReplayBuffer` may replace empty ones
KEPT_KWARGS = frozenset({"handle_timeout_termination", "n_steps", "gamma"})  # `OptionReplayBuffer` takes them, too


class Family:
    """An algorithm without network heads and buffer."""

    waits_for_rollout: ClassVar[bool] = False  # whether options are installed between rollouts only
    step_seconds: ClassVar[float] = STEP_SECONDS  # nominal training time per primitive step

    def __init__(self, model: Any) -> None:
        self.model = model

    @property
    def replay_buffer(self) -> OptionReplayBuffer | None:
        """The replay buffer, if it supports options."""
        return None

    def prepare(self) -> None:
        """Replace parts of the model, before it trains or is restored, with parts for options; refuse unfit ones."""

    def check(self, venv: VecEnv) -> None:
        """Refuse networks, buffers and wrappers that options would spoil, and say what to change."""

    def has_learned(self) -> bool:
        """Return whether an update was made."""
        return getattr(self.model, "_n_updates", 0) > 0

    def forget(self, action: int) -> bool:
        """Forget the values of an action whose slot was emptied; return whether there were any."""
        return False


class Table(Family):
    """`MacroQ`: values in a table, updated after every step."""

    step_seconds = TABLE_STEP_SECONDS

    def check(self, venv: VecEnv) -> None:
        """Refuse ``VecNormalize``."""
        if self.model.get_vec_normalize_env() is not None:
            raise ValueError(
                "MacroQ learns from the steps inside options as the environment gives them, which VecNormalize never "
                "sees: leave VecNormalize out."
            )

    def has_learned(self) -> bool:
        """Return True: a table begins with zeros."""
        return True

    def forget(self, action: int) -> bool:
        """Set the values of the action to 0."""
        values = self.model.policy.table()[:, action]
        had_values = bool(values.any())
        values[:] = 0.0
        return had_values


class Networks(Family, ABC):
    """Base of the families whose policy is a network with outputs for each action, closed while a slot is empty."""

    def check(self, venv: VecEnv) -> None:
        """Refuse heads that cannot be closed."""
        self.check_heads()

    def check_heads(self) -> None:
        """Refuse unknown heads and, once the environment was reset, heads on which other outputs depend."""
        heads.option_outputs(self.model.policy)
        last_obs = self.model._last_obs
        if last_obs is None:
            return
        first = {k: v[:1] for k, v in last_obs.items()} if isinstance(last_obs, dict) else last_obs[:1]
        policy = self.model.policy
        training = policy.training
        policy.set_training_mode(False)
        batch, _ = policy.obs_to_tensor(first)
        heads.check_outputs(policy, lambda: self.outputs(batch))
        policy.set_training_mode(training)

    @abstractmethod
    def outputs(self, batch: Any) -> torch.Tensor:
        """Return values of actions, or logits up to a common constant, (…, n_actions)."""

    def is_untrained(self, n_primitive: int) -> bool:
        """Return whether option slots have random initial weights: nothing was learned, loaded or closed."""
        policy = self.model.policy
        if self.has_learned() or policy.optimizer.state:
            return False
        return not any(heads.is_closed(policy, action) for action in range(n_primitive, int(self.model.action_space.n)))

    def forget(self, action: int) -> bool:
        """Close the head of the action, and forget the moments of the optimizer."""
        policy = self.model.policy
        was_open = not heads.is_closed(policy, action)
        heads.close_head(policy, action)
        if was_open:
            heads.forget_moments(policy, action)
        return was_open

    def widen(self, actions: spaces.Discrete) -> None:
        """Give the model more actions, with closed heads, and keep everything that it has learned."""
        policy = self.model.policy
        n_before = int(self.model.action_space.n)
        for layer, outputs in heads.option_outputs(policy):
            heads.widen(layer, int(actions.n) - n_before, outputs, policy.optimizer)
        for module in policy.modules():
            if isinstance(module, BasePolicy):
                module.action_space = actions
        self.model.action_space = actions
        for action in range(n_before, int(actions.n)):
            heads.close_head(policy, action)


class ValueBased(Networks):
    """DQN, QRDQN, `OptionDQN`: networks of action values, and a replay buffer."""

    @property
    def replay_buffer(self) -> OptionReplayBuffer | None:
        """The buffer of γᵏ and the steps inside options."""
        buffer = self.model.replay_buffer
        return buffer if isinstance(buffer, OptionReplayBuffer) else None

    def prepare(self) -> None:
        """Replace SB3's empty replay buffer with an `OptionReplayBuffer`; refuse one that ignores γᵏ or ``n_steps``."""
        buffer = self.model.replay_buffer
        name = type(self.model).__name__
        if buffer is None:
            return
        if self.replay_buffer is None:
            self._check_stock(irreplaceable=buffer.size() or buffer.optimize_memory_usage)
            self._use_option_buffer(self.model.action_space)
        n_steps = getattr(self.model, "n_steps", 1)
        if n_steps > 1 and self.model.replay_buffer.n_steps != n_steps:
            raise ValueError(
                f"SB3 does not pass n_steps={n_steps} on to OptionReplayBuffer: pass "
                f"{name}(..., replay_buffer_kwargs={{'n_steps': {n_steps}}}) instead of n_steps."
            )

    def check_heads(self) -> None:
        """Also refuse a replay buffer of a user's own class, which cannot store the steps inside options."""
        super().check_heads()
        self._check_stock()

    def check(self, venv: VecEnv) -> None:
        """Also refuse stacked frames that could not be stored, and a clip of sums of rewards."""
        super().check(venv)
        normalizer = self.model.get_vec_normalize_env()
        name = type(self.model).__name__
        macro_q = self.replay_buffer is not None and self.replay_buffer.macro_q
        if macro_q and is_vecenv_wrapped(venv, VecFrameStack):
            raise ValueError(
                "The steps inside options are never stacked by VecFrameStack, so that Macro-Q cannot learn from them: "
                f"pass {name}(..., replay_buffer_kwargs={{'macro_q': False}}), or stack beneath the options: "
                "OptionsWrapper(FrameStackObservation(env, n))."
            )
        # A replay buffer stores sums, and normalises them when they are drawn, with the σ at that time.
        if normalizer is not None and normalizer.norm_reward and np.isfinite(normalizer.clip_reward):
            raise ValueError(
                f"VecNormalize clips the reward of a whole option at {normalizer.clip_reward}, and with it γ: how long "
                "the option took would no longer show. Set its clip_reward to np.inf, so that it only divides, or pass "
                "norm_reward=False."
            )

    def outputs(self, batch: Any) -> torch.Tensor:
        """Return Q of every action; for QRDQN every quantile."""
        return torch.as_tensor(heads.networks(self.model.policy)[0](batch))

    def widen(self, actions: spaces.Discrete) -> None:
        """Also replace a stock replay buffer with an empty `OptionReplayBuffer`."""
        super().widen(actions)
        model = self.model
        model.policy.net_args["action_space"] = actions  # for building networks
        if self.replay_buffer is not None:
            self.replay_buffer.action_space = actions
        else:
            self._use_option_buffer(actions)

    def _check_stock(self, *, irreplaceable: bool = False) -> None:
        """Refuse a replay buffer that `OptionReplayBuffer` may not replace."""
        buffer = self.model.replay_buffer
        name = type(self.model).__name__
        known = self.replay_buffer is not None or type(buffer) in (*STOCK_BUFFERS, type(None))
        if irreplaceable or not known:
            raise ValueError(
                f"{name} was built with {type(buffer).__name__}, which discounts an option of k steps with γ instead "
                f"of γᵏ: pass {name}(..., replay_buffer_class=OptionReplayBuffer)."
            )

    def _use_option_buffer(self, actions: spaces.Discrete) -> None:
        """Give the model an empty `OptionReplayBuffer`."""
        model = self.model
        kwargs = {key: value for key, value in model.replay_buffer_kwargs.items() if key in KEPT_KWARGS}
        model.replay_buffer_class = OptionReplayBuffer
        model.replay_buffer_kwargs = kwargs
        model.optimize_memory_usage = False
        model.replay_buffer = OptionReplayBuffer(
            model.buffer_size, model.observation_space, actions, model.device, model.n_envs, **kwargs
        )


class Sampled(Networks):
    """PPO, A2C, TRPO: sample actions from a policy's probabilities, and learn from rollouts.

    An update uses the probabilities that the actions had, so no head may open within a rollout.
    """

    waits_for_rollout = True

    def outputs(self, batch: Any) -> torch.Tensor:
        """Return the logarithms of the probabilities."""
        return torch.as_tensor(self.model.policy.get_distribution(batch).distribution.logits)

    def widen(self, actions: spaces.Discrete) -> None:
        """Also tell the distribution and the rollout buffer of the actions."""
        super().widen(actions)
        self.model.policy.action_dist.action_dim = int(actions.n)
        buffer: BaseBuffer = self.model.rollout_buffer
        buffer.action_space = actions


class Masked(Sampled):
    """MaskablePPO: probabilities of the available actions. Masks are stored, so a head may open at any time."""

    waits_for_rollout = False

    def prepare(self) -> None:
        """Replace sb3-contrib's distribution with an equal one that takes less time."""
        policy = self.model.policy
        if type(getattr(policy, "action_dist", None)).__module__ == "sb3_contrib.common.maskable.distributions":
            from sb3_options.learning.masked_distribution import quick  # here: sb3-contrib is optional

            policy.action_dist = quick(policy.action_dist)

    def widen(self, actions: spaces.Discrete) -> None:
        """Also let the rollout buffer store masks of the wider space."""
        super().widen(actions)
        self.model.rollout_buffer.mask_dims = int(actions.n)
        self.model.rollout_buffer.reset()


class Recurrent(Sampled):
    """RecurrentPPO: its LSTM sees the observations at decisions only."""

    def check(self, venv: VecEnv) -> None:
        """Also refuse `OptionsVecEnv`."""
        super().check(venv)
        if is_vecenv_wrapped(venv, OptionsVecEnv):
            raise ValueError(
                "OptionsVecEnv shows the same observation again while an option runs, and the LSTM of RecurrentPPO "
                "would remember that: use OptionsWrapper, or an algorithm without memory."
            )

    def outputs(self, batch: Any) -> torch.Tensor:
        """Return the logarithms of the probabilities without a memory."""
        policy = self.model.policy
        memory = torch.zeros(policy.lstm_hidden_state_shape, device=policy.device)
        distribution, _ = policy.get_distribution(batch, (memory, memory), torch.ones(1, device=policy.device))
        return torch.as_tensor(distribution.distribution.logits)


def family_of(model: BaseAlgorithm) -> Family:
    """Return the adapter of a model."""
    if isinstance(model, MacroQ):
        return Table(model)
    if hasattr(model, "rollout_buffer"):
        if "action_masks" in inspect.signature(model.policy.forward).parameters:
            return Masked(model)
        return Recurrent(model) if hasattr(model, "_last_lstm_states") else Sampled(model)
    return ValueBased(model) if hasattr(model, "replay_buffer") else Family(model)


def forget_slot(model: BaseAlgorithm, slot: int, n_primitive: int) -> bool:
    """Remove values, optimizer moments and stored transitions of an emptied slot; return whether it had values.

    The values of an empty slot are closed (`heads`) or 0 (`MacroQ`), and no stored transition names it. Otherwise
    updates would move the closed values, and with them the weights that all actions share.
    """
    family = family_of(model)
    action = n_primitive + slot
    had_values = family.forget(action)
    if family.replay_buffer is not None:
        family.replay_buffer.forget_action(action)
        family.replay_buffer.set_next_available(slot, False)
    return had_values


def forget_empty(model: BaseAlgorithm, slot: int, n_primitive: int) -> None:
    """Call `forget_slot` for a slot that is empty when training starts, and warn if the model had learned about it."""
    if forget_slot(model, slot, n_primitive) and family_of(model).has_learned():
        logger.warning(
            "Slot %d is empty, and the model has learned what an option there is worth: that is forgotten now. If "
            "the options of an earlier training were meant to be there, load them first: "
            "sb3_options.load_options(FILE, env).",
            slot,
        )
