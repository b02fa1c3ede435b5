"""Putting options where they take effect: into every environment, the network's heads and the replay buffer."""

from __future__ import annotations

import inspect
import logging

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.callbacks.checks import check_same_slots
from sb3_options.callbacks.primitive_steps import all_callbacks, monitor_primitive_steps
from sb3_options.callbacks.teaching import IntraOptionTeacher
from sb3_options.execution.exploration import cap_option_exploration
from sb3_options.execution.vec_env import as_wrapper_sees
from sb3_options.execution.workers import watch_workers
from sb3_options.experience.observations import BoolArray, FloatArray, Observations, take
from sb3_options.learning import heads
from sb3_options.learning.interrupting import Interrupter
from sb3_options.learning.macro_q import MacroQ
from sb3_options.learning.replay_buffer import OptionReplayBuffer
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option, SubgoalOption

AVAILABILITY_CHUNK = 4096
"""Stored observations are sent to the environment in batches of this many when an option moves in."""

logger = logging.getLogger("sb3_options")


class OptionServer:
    """Keeps the options of all environments, the heads of the network and the replay buffer in step with its `bank`.

    An option reaches off-policy algorithms at once. Those that sample actions from a policy without masks get it when
    the next rollout starts: a rollout that began with the head closed and ended with it open would be learned from
    with probabilities that its actions never had.

    Args:
        model: Being trained.
        venv: Its environment.
        callbacks: The tree that ``learn`` was given: the environment of an ``EvalCallback`` in it is served as well.
        max_option_exploration: Largest share of options among exploratory choices.
        interruption: Whether options end where going on is worth less than the best alternative (`Interruption`).
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        venv: VecEnv,
        callbacks: BaseCallback | None,
        *,
        max_option_exploration: float = 1.0,
        interruption: bool = False,
    ) -> None:
        self.model, self.venv = model, venv
        self.eval_envs = [c.eval_env for c in all_callbacks(callbacks) if isinstance(c, EvalCallback)]
        for eval_env in self.eval_envs:
            watch_workers(eval_env)
            check_same_slots(venv, eval_env)
            monitor_primitive_steps(eval_env)
        self.has_heads = not isinstance(model, MacroQ)
        masks = "action_masks" in inspect.signature(model.policy.forward).parameters
        self.waits_for_rollout = hasattr(model, "rollout_buffer") and not masks
        self._waiting: dict[int, Option] = {}
        self._moved_in: list[int] = []
        self._leaving: set[int] = set()
        present: OptionBank = venv.get_attr("bank", [0])[0]
        self.n_primitive = present.n_primitive
        self.bank = OptionBank(
            present.n_primitive, present.max_options, feature_map=self.features_of, signature=present.signature
        )
        self.explored = cap_option_exploration(model, self.n_primitive, max_option_exploration)
        self.max_option_exploration = max_option_exploration
        self.teacher: IntraOptionTeacher | None = None
        if IntraOptionTeacher.teaches(model):
            self.teacher = IntraOptionTeacher(model, venv, self.bank)
        self.interrupter: Interrupter | None = None
        if interruption and heads.has_networks(model.policy):
            self.interrupter = Interrupter(model, venv, self.eval_envs)
        else:
            for each in [venv, *self.eval_envs]:
                each.env_method("set_interruption", None)  # an earlier training may have left its own
        for slot, option in enumerate(present.slots):
            if option is not None:
                if self.has_heads and getattr(model, "_n_updates", 1) == 0:
                    heads.close_head(model.policy, self.n_primitive + slot)  # as drawn at random; it opens below
                self._move_in(slot, option)
            elif self.has_heads:
                self._close(slot)

    def _close(self, slot: int) -> None:
        action = self.n_primitive + slot
        if getattr(self.model, "_n_updates", 0) > 0 and not heads.is_closed(self.model.policy, action):
            logger.warning(
                "Slot %d is empty, and the model has learned what an option there is worth: that is forgotten now. If "
                "the options of an earlier training were meant to be there, load them first: OptionsWrapper(env, "
                "options_file=...) or env.bank.load(...).",
                slot,
            )
        heads.close_head(self.model.policy, action)

    def features_of(self, observations: Observations) -> FloatArray:
        """φ of a batch of observations, which may live in a worker process only, (batch, d)."""
        features: FloatArray = self.venv.env_method("concept_features", observations, indices=[0])[0]
        return features

    def put(self, slot: int, option: Option) -> None:
        """Let ``option`` move into a slot."""
        if self.waits_for_rollout:
            self.bank.add(option, slot)
            self._waiting[slot] = option
        else:
            self._move_in(slot, option)

    def replace(self, slot: int, option: Option) -> None:
        """Put a later version of an option into the slot it is in."""
        if slot in self._waiting:
            self.bank.add(option, slot)
            self._waiting[slot] = option
        else:
            before = self.bank[slot]
            self._send(slot, option)
            if _same_initiation(before, option):
                if self.teacher is not None:
                    self.teacher.changed(slot)
            elif slot not in self._moved_in:
                self._moved_in.append(slot)  # where it may start has to be worked out again

    def staying(self) -> list[int]:
        """The filled slots, without those that are to be emptied."""
        return [slot for slot in self.bank.filled if slot not in self._leaving]

    def remove(self, slot: int) -> None:
        """Let the option in a slot move out, when nothing can name it any more that is learned from.

        A replay buffer must have stored the step that is under way, a rollout buffer must have been emptied.
        """
        if self._waiting.pop(slot, None) is not None:
            self.bank.remove(slot)  # it never moved in
        else:
            self._leaving.add(slot)

    def rollout_starts(self) -> None:
        """Let the options in that waited, and those out that are to leave."""
        self._move_out()
        for slot, option in self._waiting.items():
            self._move_in(slot, option)
        self._waiting.clear()

    def rollout_ends(self) -> None:
        """Let the replay buffer know of the options that just moved in, and of what was stored since."""
        if not hasattr(self.model, "rollout_buffer"):
            self._move_out()
        # Only now is the step stored at whose end an option was made, and no gradient step was taken in between.
        buffer = getattr(self.model, "replay_buffer", None)
        if isinstance(buffer, OptionReplayBuffer) and buffer.next_available.shape[1]:
            for slot in self._moved_in:
                buffer.set_next_available(slot, self._available_in(buffer, self.n_primitive + slot))
        if self.teacher is not None:
            for slot in self._moved_in:
                self.teacher.judge_all(slot)
            self.teacher.judge_new()
        if self.interrupter is not None and len(self.bank):
            self.interrupter.refresh(at_once=bool(self._moved_in))
        self._moved_in.clear()

    def training_ends(self) -> None:
        """Leave no option waiting, and the environments with the values that were learned."""
        self.rollout_starts()
        self.rollout_ends()
        if self.interrupter is not None and len(self.bank):
            self.interrupter.refresh(at_once=True)

    def _move_in(self, slot: int, option: Option) -> None:
        self._send(slot, option)
        if not self.has_heads:
            return  # MacroQ asks for what is available in every step
        action = self.n_primitive + slot
        if heads.is_closed(self.model.policy, action):
            heads.open_head(self.model.policy, action, self.n_primitive, odds=self._odds())
        self._moved_in.append(slot)

    def _odds(self) -> float | None:
        """Of a new option against all primitives, for policies that sample and mask; of the options' joint share."""
        if not hasattr(self.model, "rollout_buffer") or self.waits_for_rollout or self.max_option_exploration == 1.0:
            return None
        share = self.max_option_exploration
        return max(share / (1.0 - share) / len(self.bank), 1e-3)

    def _move_out(self) -> None:
        for slot in self._leaving:
            self.bank.remove(slot)
            for venv in [self.venv, *self.eval_envs]:
                venv.env_method("set_option", slot, None)
            if self.explored is not None:
                self.explored.filled = self.bank.filled
            if self.has_heads:
                heads.close_head(self.model.policy, self.n_primitive + slot)
                heads.forget_moments(self.model.policy, self.n_primitive + slot)
            buffer = getattr(self.model, "replay_buffer", None)
            if isinstance(buffer, OptionReplayBuffer):
                buffer.forget_action(self.n_primitive + slot)
                if buffer.next_available.shape[1]:
                    buffer.next_available[:, slot] = False
            if self.teacher is not None:
                self.teacher.forget(slot)
            if slot in self._moved_in:
                self._moved_in.remove(slot)
        self._leaving.clear()

    def _send(self, slot: int, option: Option) -> None:
        self.bank.add(option, slot)
        if self.explored is not None:
            self.explored.filled = self.bank.filled
        travelling = option.bind(None) if isinstance(option, SubgoalOption) else option
        for venv in [self.venv, *self.eval_envs]:
            venv.env_method("set_option", slot, travelling)

    def _available_in(self, buffer: OptionReplayBuffer, action: int) -> BoolArray:
        available = [np.zeros(0, dtype=bool)]
        stored = buffer.next_observations_stored()
        for start in range(0, buffer.size(), AVAILABILITY_CHUNK):
            chunk = as_wrapper_sees(self.venv, take(stored, slice(start, start + AVAILABILITY_CHUNK)))
            available.append(self.venv.env_method("available", chunk, indices=[0])[0][:, action])
        return np.concatenate(available)


def _same_initiation(one: Option | None, other: Option) -> bool:
    """Whether two options are known to start in the same states."""
    if not (isinstance(one, SubgoalOption) and isinstance(other, SubgoalOption)):
        return False
    return one.initiation_set is other.initiation_set
