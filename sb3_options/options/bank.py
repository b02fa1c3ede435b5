"""The option slots behind the augmented actions."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, TypeGuard, cast

import numpy as np

from sb3_options.atomic import atomic_write
from sb3_options.checked import whole
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.experience import observations as obs_batch
from sb3_options.experience.observations import BoolArray, FeatureMap, FloatArray, IntArray, Observations, key_of
from sb3_options.options.archive import Source
from sb3_options.options.file import MAX_SLOTS, OptionsFile, SpaceSignature, check_signature, content_of, opened
from sb3_options.options.option import CACHE_BYTES, KnownFeatures, KnownResults, Option, SubgoalOption
from sb3_options.options.sealed import errors_of

FEW = 8  # most observations that are looked up one by one, where observations recur
TRIAL = 500  # new observations before it is judged whether they recur
HITS = 4  # they recur if they were asked for more often than this, on average
ANSWERS_BYTES = 600  # memory of `Answers` and their entries, besides the observation and its features; approximate


@dataclass(slots=True)
class Answers:
    """Answers of the options of a bank at one observation, each computed when it is first asked for."""

    key: bytes = b""  # of φ
    features: FloatArray | None = None  # φ, (1, d), in the memory of ``key``; None if an option is hand-made
    available: BoolArray | None = None  # which options may start, (max_options,)
    actions: dict[int, int] = field(default_factory=dict)  # by slot: the primitive action of π


@dataclass(eq=False, repr=False)
class OptionBank:
    """Ordered slots: augmented action ``n_primitive + i`` always is slot i.

    The capacity never changes. So the action space of an algorithm, a worker process, a replay buffer or a saved model
    stays the same while slots fill.

    Args:
        n_primitive: Number of primitive actions, at least 1.
        max_options: Number of slots, at least 0.
        feature_map: φ that discovered options are bound to when they are added.
        observation_size: Numbers in one flat observation; None accepts options for any.
        feature_size: Dimensions d of concept space; None accepts options for any.
        signature: Observations that the options act on, which `save` writes and `load` compares; None accepts any.

    Raises:
        ValueError: ``n_primitive`` < 1 or ``max_options`` < 0.
    """

    n_primitive: int
    max_options: int
    _: KW_ONLY
    feature_map: FeatureMap | None = None
    observation_size: int | None = None
    feature_size: int | None = None
    signature: SpaceSignature | None = None

    def __post_init__(self) -> None:
        """Begin with empty slots."""
        if not (whole(self.max_options, 0) and self.max_options <= MAX_SLOTS):
            raise ValueError(f"max_options must be a whole number from 0 to {MAX_SLOTS:,}, got {self.max_options!r}.")
        self._shared: KnownFeatures | None = None
        self._slots: list[Option | None] = [None] * self.max_options
        self.filled: tuple[int, ...] = ()
        self._forget_results()

    def copy(self) -> OptionBank:
        """Return a bank with the same options in slots of its own."""
        bank = OptionBank.__new__(OptionBank)
        bank.__dict__.update(self.__dict__, _slots=list(self._slots))
        return bank

    def __repr__(self) -> str:
        names = [None if option is None else option.name for option in self._slots]
        return f"<{type(self).__name__} of {self.n_primitive} primitive actions and {names}>"

    @property
    def slots(self) -> tuple[Option | None, ...]:
        """Every slot in order; None where empty."""
        return tuple(self._slots)

    def __getitem__(self, slot: int) -> Option | None:
        return self._slots[slot]

    def __len__(self) -> int:
        """Number of filled slots."""
        return len(self.filled)

    def add(self, option: Option, slot: int | None = None) -> int:
        """Put an option into a slot, by default the first empty one, and return the slot.

        A `SubgoalOption` is bound to the bank's feature map, if it has one.
        """
        if slot is None:
            if len(self) == self.max_options:
                raise ValueError(
                    f"All {self.max_options} option slots are filled: remove one, or make the wrapper with a "
                    "larger max_options."
                )
            slot = self._slots.index(None)
        self.check_slot(slot)
        self._put(slot, self._bound(option))
        return slot

    def remove(self, slot: int) -> Option | None:
        """Empty a slot and return its option."""
        self.check_slot(slot)
        option = self._slots[slot]
        self._put(slot, None)
        return option

    def bind(self, feature_map: FeatureMap | None) -> None:
        """Use ``feature_map`` for present and future discovered options."""
        self.feature_map, self._shared = feature_map, None
        self._slots = [option and self._bound(option) for option in self._slots]
        self._forget_results()

    def available(self, observations: Observations) -> BoolArray:
        """Return which augmented actions may start in each observation, shape (batch, n_primitive + max_options).

        Primitives are always available, options within their initiation sets, empty slots never.
        """
        mask = np.ones((obs_batch.batch_size(observations), self.n_primitive + self.max_options), dtype=bool)
        mask[:, self.n_primitive :] = self.available_slots(observations)
        return mask

    def available_slots(self, observations: Observations) -> BoolArray:
        """Return which options may start in each observation, shape (batch, max_options)."""
        if self._is_by_data():
            return self._known(self._computed_slots, observations).copy()
        return self._computed_slots(observations)

    def available_in(self, observations: Sequence[Any]) -> BoolArray:
        """`available_slots` of single observations, each looked up for itself."""
        if len(observations) == 1:
            return np.array([self.available_at(observations[0])])
        if not self._is_by_data():
            return self._computed_slots(obs_batch.stack(list(observations)))
        answers = list(map(self._answers_at, observations))
        new = [each for each in answers if each.available is None]
        if new:
            features = np.concatenate([cast("FloatArray", each.features) for each in new])
            for each, available in zip(new, self._slots_at(features), strict=True):
                each.available = available
        return np.array([each.available for each in answers])

    def available_at(self, observation: Any) -> BoolArray:
        """Return which options may start in one observation, shape (max_options,). Not to be changed."""
        if not self._is_by_data():
            return np.asarray(self._computed_slots(obs_batch.batch_of_one(observation))[0])
        answers = self._answers_at(observation)
        if answers.available is None:
            available = [False] * self.max_options
            for slot in self.filled:
                option = cast("SubgoalOption", self._slots[slot])
                available[slot] = option.member(cast("FloatArray", answers.features), answers.key)[0]
            answers.available = np.array(available)
        return answers.available

    def may_start(self, slot: int, observation: Any) -> bool:
        """Return whether one observation lies in I of the option in a slot."""
        if self._is_by_data():
            return bool(self.available_at(observation)[slot])
        return bool(cast("Option", self._slots[slot]).initiation(obs_batch.batch_of_one(observation))[0])

    def membership(self, slot: int, observation: Any) -> tuple[bool, float]:
        """Return whether one observation lies in I of the option in a slot, and β there."""
        answers = self._answers_at(observation)
        option = cast("Option", self._slots[slot])
        if answers.features is None:
            initiation, termination = option.membership(obs_batch.batch_of_one(observation))
            return bool(initiation[0]), float(termination[0])
        inside, arrived = cast("SubgoalOption", option).member(answers.features, answers.key)
        return inside, float(arrived)

    def action(self, slot: int, observation: Any) -> int:
        """Return the primitive action in one observation of the option in a slot."""
        answers = self._answers_at(observation)
        known = answers.actions.get(slot)
        if known is None:
            option = cast("Option", self._slots[slot])
            if answers.features is not None and cast("SubgoalOption", option).policy_input == "features":
                actions = cast("SubgoalOption", option).policy_at(answers.features)
            else:
                actions = option.policy(obs_batch.batch_of_one(observation))
            known = answers.actions[slot] = int(checked_actions(option, actions, self.n_primitive)[0])
        return known

    def looks_up(self, slot: int, option: Option, n: int) -> bool:
        """Return whether n observations are quicker looked up one by one than asked of a slot's option in a batch."""
        new = len(self._answers)
        recur = new < TRIAL or self._lookups > HITS * new
        return n <= FEW and self._is_by_data() and recur and self._slots[slot] is option

    def _answers_at(self, observation: Any) -> Answers:
        if not self._is_by_data():
            return Answers()
        self._lookups += 1
        key = key_of(observation)
        answers = self._answers.get(key)
        if answers is None:
            if self._answers_bytes > CACHE_BYTES:
                self._forget_answers()
            answers = self._answers[key] = self._new_answers(observation)
            self._answers_bytes += len(key) + len(answers.key) + ANSWERS_BYTES
        return answers

    def _new_answers(self, observation: Any) -> Answers:
        key = cast("KnownFeatures", self._shared).computed(obs_batch.batch_of_one(observation)).tobytes()
        answers = Answers(key, np.frombuffer(key)[None])
        return self._answers_by_features.setdefault(key, answers) if self._sees_features else answers

    def _computed_slots(self, observations: Observations) -> BoolArray:
        mask = np.zeros((obs_batch.batch_size(observations), self.max_options), dtype=bool)
        features = None
        for slot in self.filled:
            option = cast("Option", self._slots[slot])
            if self._is_bound(option):
                features = option.features(observations) if features is None else features
                mask[:, slot] = option.membership_at(features)[:, 0]
            else:
                mask[:, slot] = option.initiation(observations)
        return mask

    def _slots_at(self, features: FloatArray) -> BoolArray:
        """Return which options, all of data, may start at each row of φ, (batch, max_options)."""
        mask = np.zeros((len(features), self.max_options), dtype=bool)
        for slot in self.filled:
            mask[:, slot] = cast("SubgoalOption", self._slots[slot]).membership_at(features)[:, 0]
        return mask

    def _is_bound(self, option: Option | None) -> TypeGuard[SubgoalOption]:
        """Whether an option consists of data and acts on the bank's φ."""
        return isinstance(option, SubgoalOption) and option.known_features is self._shared is not None

    def _is_by_data(self) -> bool:
        """Whether all options are made of data only, so that results may be kept: a hand-made one may have a memory."""
        if self._by_data and cast("KnownFeatures", self._shared).scale is not self._scale:
            self._forget_results()  # the feature map was learned anew
        return self._by_data

    def _forget_results(self) -> None:
        options = [self._slots[slot] for slot in self.filled]
        own = all(type(option) is SubgoalOption and self._is_bound(option) for option in options)
        self._by_data = self.filled != () and own
        self._sees_features = all(getattr(option, "policy_input", None) == "features" for option in options)
        self._scale = None if self._shared is None else self._shared.scale
        self._known: KnownResults[np.bool_] = KnownResults()
        self._forget_answers()

    def _forget_answers(self) -> None:
        self._answers: dict[bytes, Answers] = {}
        self._answers_by_features: dict[bytes, Answers] = {}
        self._answers_bytes = 0
        self._lookups = 0

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the discovered options to a safetensors file, atomically: arrays and JSON, nothing that can run.

        A hand-made option consists of code, so only its name is written.
        """
        with atomic_write(path) as temporary:
            temporary.write_bytes(self.content())

    def content(self) -> bytes:
        """Return the content that `save` writes."""
        learned = self.feature_map.arrays() if isinstance(self.feature_map, LearnedMap) else {}
        return content_of(self.slots, self.n_primitive, self.signature, learned)

    def load(self, source: Source) -> None:
        """Load the options of a file that `save` wrote into the slots they were in.

        A hand-made option of the file must already be in its slot. Either everything is loaded or nothing is.
        """
        file = opened(source)
        with errors_of(file.name, "does not fit"):
            self._check_fits(file)
        loaded = file.options(observation_size=self.observation_size, feature_size=self.feature_size)
        if isinstance(self.feature_map, LearnedMap) and loaded:
            with errors_of(file.name, "does not fit"):
                self.feature_map.load(file.feature_map())
        for slot, option in loaded.items():
            self._put(slot, self._bound(option))

    def _check_fits(self, file: OptionsFile) -> None:
        if file.n_primitive != self.n_primitive:
            raise ValueError(
                f"its options choose among {file.n_primitive} primitive actions, this task has {self.n_primitive}"
            )
        last = max(file.slots, default=-1)
        if last >= self.max_options:
            raise ValueError(
                f"it has an option in slot {last}, this bank only has {self.max_options} slots; make the wrapper with "
                f"max_options={file.max_options}"
            )
        for slot, name in file.hand_made.items():
            present = self._slots[slot]
            if present is None or present.name != name:
                raise ValueError(
                    f"slot {slot} held the hand-made option {name!r}, which is code and not in the file; add it to "
                    "the bank first"
                )
        if self.signature is not None and file.made_for is not None:
            check_signature(file.made_for, self.signature, {entry.policy_input for entry in file.entries.values()})

    def _bound(self, option: Option) -> Option:
        if not isinstance(option, SubgoalOption) or self.feature_map is None:
            return option
        if self._shared is None or self._shared.of != self.feature_map:
            self._shared = KnownFeatures(self.feature_map)
        return option.bind(self._shared)

    def _put(self, slot: int, option: Option | None) -> None:
        self._slots[slot] = option
        self.filled = tuple(i for i, present in enumerate(self._slots) if present is not None)
        self._forget_results()

    def __getstate__(self) -> dict[str, Any]:
        # Functions may not travel between processes; the receiver of the bank has its own feature map. A learned
        # map is data, and belongs to `content`.
        traveller = self.copy()
        traveller.bind(None)
        traveller.feature_map = self.feature_map if isinstance(self.feature_map, LearnedMap) else None
        return traveller.__dict__

    def check_slot(self, slot: int) -> None:
        """Refuse an unknown slot."""
        if not 0 <= slot < self.max_options:
            raise ValueError(f"slot must be between 0 and {self.max_options - 1}, got {slot}.")


def checked_actions(option: Option, actions: IntArray, n_primitive: int) -> IntArray:
    """Return the actions of an option's policy, (batch,), if all are primitive."""
    for action in actions.tolist():
        if not 0 <= action < n_primitive:
            raise ValueError(
                f"The policy of option {option.name!r} chose {action}; primitive actions are 0 to {n_primitive - 1}."
            )
    return actions
