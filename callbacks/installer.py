"""Installs options where they take effect: in every environment, the network's heads and the replay buffer."""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.callbacks.checks import check_same_slots
from sb3_options.callbacks.tree import evaluation_envs
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.execution.above import monitor_primitive_steps
from sb3_options.execution.exploration import cap_option_exploration
from sb3_options.execution.workers import watch_workers
from sb3_options.experience.observations import FloatArray, Observations
from sb3_options.learning import heads
from sb3_options.learning.families import Masked, Networks, Sampled, family_of, forget_empty, forget_slot
from sb3_options.learning.masked import stored_availability
from sb3_options.learning.saved_model import keep_options, put_back
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option, SubgoalOption

MIN_ODDS = 1e-3  # least odds of a new option: a head of probability 0 would never be learned


class OptionInstaller:
    """Keeps environments, network heads and replay buffer in line with the options of its `bank`.

    It starts with the options that the environments hold. It forgets what was learned about empty slots, and corrects
    what an earlier training left behind. The model carries the bank, so SB3's ``save`` writes it too. The environments
    of an ``EvalCallback`` get the same options.

    Off-policy algorithms get an option at once. Algorithms that sample actions from a policy without masks get it when
    the next rollout starts. If a head opened during a rollout, the update would use probabilities that the actions
    never had. ``open_untrained`` says whether the random heads of an untrained model are opened for its present
    options. The other settings are those of `OptionUse`.
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        venv: VecEnv,
        callbacks: BaseCallback | None,
        *,
        max_option_exploration: float = 1.0,
        open_untrained: bool = True,
    ) -> None:
        self.model = model
        self.venv = venv
        self.eval_envs = evaluation_envs(callbacks)
        for eval_env in self.eval_envs:
            watch_workers(eval_env)
            check_same_slots(venv, eval_env)
        for each in (venv, *self.eval_envs):
            monitor_primitive_steps(each)
        self.family = family_of(model)
        self.buffer = self.family.replay_buffer
        self.opening_share = max_option_exploration
        self._pending: list[int] = []  # slots whose option waits for the next rollout
        self._new: list[int] = []
        self._closing: set[int] = set()
        put_back(model, venv)
        present: OptionBank = venv.get_attr("bank", [0])[0]
        self.n_primitive = present.n_primitive
        self.learned_map: LearnedMap | None = None
        self.bank = OptionBank(
            present.n_primitive, present.max_options, feature_map=self.features_of, signature=present.signature
        )
        self.explored = cap_option_exploration(model, self.n_primitive, max_option_exploration)
        opens = open_untrained and isinstance(self.family, Networks) and self.family.is_untrained(self.n_primitive)
        self._set_slots(expect_empty=True)
        for slot, option in enumerate(present.slots):
            if option is None:
                forget_empty(model, slot, self.n_primitive)
                continue
            if opens:
                heads.close_head(model.policy, self.n_primitive + slot)  # random weights; it is opened below
            self._install_now(slot, option, present=True)
        self._changed()

    def features_of(self, observations: Observations) -> FloatArray:
        """Return φ of a batch of observations, (batch, d). φ may exist only in a worker process."""
        if self.learned_map is not None:
            return self.learned_map(observations)
        return np.asarray(self.venv.env_method("concept_features", observations, indices=[0])[0])

    def send_learned_map(self) -> None:
        """Send the feature map that is learned here to every environment."""
        assert self.learned_map is not None  # `LearnedFeatures.begin` has set it
        self._set_slots(learned_map=self.learned_map.arrays())
        self._changed()

    def install(self, slot: int, option: Option) -> None:
        """Install an option in an empty slot, at once or when the next rollout starts."""
        if self.family.waits_for_rollout:
            self.bank.add(option, slot)
            self._pending.append(slot)
        else:
            self._install_now(slot, option)
        self._changed()

    def replace(self, slot: int, option: Option) -> None:
        """Put a later version of an option into the slot it is in."""
        before = self.bank[slot]
        if slot in self._pending:
            self.bank.add(option, slot)
        else:
            self._send(slot, option)
            if slot not in self._new and _initiation(before) is not _initiation(option):
                self._new.append(slot)  # its availability has to be computed anew
        self._changed()

    def uninstall(self, slot: int) -> None:
        """Remove an option once no experience that is still to be learned from can name it.

        By then a replay buffer has stored the current step, and a rollout buffer has been emptied.
        """
        if slot in self._pending:
            self._pending.remove(slot)
            self.bank.remove(slot)  # it never was in an environment
            self._changed()
        else:
            self._closing.add(slot)

    def installed(self) -> list[int]:
        """Return the filled slots without those that are being emptied."""
        return [slot for slot in self.bank.filled if slot not in self._closing]

    def on_rollout_start(self) -> None:
        """Install pending options and remove closed ones."""
        self._uninstall_closed()
        for slot in self._pending:
            self._install_now(slot, cast("Option", self.bank[slot]))
        self._pending.clear()

    def on_rollout_end(self) -> None:
        """Bring the replay buffer up to date."""
        if not isinstance(self.family, Sampled):
            self._uninstall_closed()
        # Only now is the step stored that ended with a new option. No gradient step was taken in between.
        if self._new and self.buffer is not None and self.buffer.tracks_availability and self.buffer.size():
            available = stored_availability(self.buffer, self.venv)
            for slot in self._new:
                self.buffer.set_next_available(slot, available[:, self.n_primitive + slot])
        self._new.clear()

    def on_training_end(self) -> None:
        """Leave no option pending."""
        self.on_rollout_start()
        self.on_rollout_end()

    def get_state(self) -> dict[str, Any]:
        """Return the state for a checkpoint. Of a hand-made option, which is code, it holds the name."""
        return {
            "slots": [each if isinstance(each, SubgoalOption) else each and each.name for each in self.bank.slots],
            "pending": list(self._pending),
            "new": list(self._new),
            "closing": sorted(self._closing),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `get_state`, and put its options into the slots of all environments."""
        if len(state["slots"]) != self.bank.max_options:
            raise ValueError(
                f"The checkpoint is of an environment with {len(state['slots'])} slots for options, and this one has "
                f"{self.bank.max_options}: pass max_options={len(state['slots'])} to OptionsWrapper."
            )
        self._pending = state["pending"]
        self._new = state["new"]
        self._closing = set(state["closing"])
        for slot, (there, here) in enumerate(zip(state["slots"], self.bank.slots, strict=True)):
            if isinstance(there, str):
                if here is None or here.name != there:
                    raise ValueError(
                        f"Slot {slot} held the hand-made option {there!r}, which is code and not in the checkpoint: "
                        "put it into the bank before training goes on."
                    )
                continue
            if here is not None:
                self.bank.remove(slot)
                self._set_slots(options={slot: None})
            if there is not None and slot in self._pending:
                self.bank.add(there, slot)
            elif there is not None:
                self._send(slot, there)
        self._changed()

    def _install_now(self, slot: int, option: Option, *, present: bool = False) -> None:
        self._send(slot, option, present=present)
        if not isinstance(self.family, Networks):
            return
        action = self.n_primitive + slot
        if heads.is_closed(self.model.policy, action):
            heads.open_head(self.model.policy, action, self.n_primitive, odds=self._odds(slot, option))
        self._new.append(slot)

    def _odds(self, slot: int, option: Option) -> float | None:
        """Return the odds of a new option against all primitives; None unless the policy samples and masks.

        The k-th of the options that are available together gets 1/k of the odds that `opening_share` gives.
        """
        share = self.opening_share
        if not isinstance(self.family, Masked) or share == 1.0:
            return None
        others = [self.bank[i] for i in self.bank.filled if i != slot]
        return max(share / (1.0 - share) / (1.0 + _n_available(others, option)), MIN_ODDS)

    def _uninstall_closed(self) -> None:
        for slot in self._closing:
            self.bank.remove(slot)
            self._set_slots(options={slot: None})
            forget_slot(self.model, slot, self.n_primitive)
            if slot in self._new:
                self._new.remove(slot)
        if self._closing:
            self._closing.clear()
            self._changed()

    def _send(self, slot: int, option: Option, *, present: bool = False) -> None:
        """Put an option into all environments; ``present``: the training environments already have one of that name."""
        self.bank.add(option, slot)
        if isinstance(option, SubgoalOption):
            # φ stays behind: functions may not travel between processes.
            self._set_slots(options={slot: option.bind(None)})
        else:  # it may be specific to its environment
            self._set_slots(training=not present, options={slot: option})

    def _changed(self) -> None:
        """Give the model the present options, and let it explore those that the environments have."""
        keep_options(self.model, self.bank)
        if self.explored is not None:
            self.explored.filled = tuple(slot for slot in self.bank.filled if slot not in self._pending)

    def _set_slots(self, *, training: bool = True, **changes: Any) -> None:
        """Change the `SlotState` of the evaluation environments and, if ``training``, of the training environments."""
        for venv in [self.venv, *self.eval_envs] if training else self.eval_envs:
            venv.env_method("set_slots", **changes)


def _n_available(others: Sequence[Option | None], option: Option) -> float:
    """Estimate how many other options are available in the average state of an option's initiation set."""
    if not isinstance(option, SubgoalOption) or not len(option.initiation_set.points):
        return len(others)
    points, group = option.initiation_set.points, option.initiation_set.group
    return sum(
        # Points of one group say nothing about the features of another.
        float(other.initiation_set.covers(points).mean())
        if isinstance(other, SubgoalOption) and other.initiation_set.group == group
        else 1.0
        for other in others
    )


def _initiation(option: Option | None) -> object:
    """Return the object that says where an option starts."""
    return option.initiation_set if isinstance(option, SubgoalOption) else option
