"""Option slots, as `OptionsWrapper` and `OptionsVecEnv` have them; what they are told, and what they are asked."""

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import numpy.typing as npt
from gymnasium import spaces

from sb3_options.checked import is_number, whole
from sb3_options.density.groups import FeatureGroup
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.embedding.settings import MapName
from sb3_options.execution import features as feature_maps
from sb3_options.execution.features import FeatureKind
from sb3_options.experience.observations import BoolArray, FeatureMap, FloatArray, Observations, batch_of_one
from sb3_options.experience.option_run import OptionRun
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option


@dataclass(frozen=True)
class SlotState:
    """State of an environment's options. ``env_method("set_slots", field=value)`` replaces fields.

    Attributes:
        options: Content by slot: an option, or None for an empty slot. Slots that are not named keep the option
            that the environment was made with. `OptionsWrapper.set_slots` adds to this field.
        learned_map: Content of the learned feature map (`LearnedMap.arrays`).
        record: Whether infos hold the primitive steps: the info that ends an episode as ``info["trajectory"]``.
        max_segment: Primitive steps of the longest segment, where ``record`` cuts at peaks of reward.
            ``info["segments"]`` then lists the segments that ended in the step. None records whole episodes.
        report_availability: Whether ``info["option"]["available"]`` says which slots may start in each observation
            arrived in.
        expect_empty: Whether a callback knows which slots are empty. Choosing one is then exploration, not a mistake.
        primitive_monitor: Whether a ``Monitor`` above the options counts primitive steps.
    """

    options: Mapping[int, Option | None] = field(default_factory=dict)
    learned_map: Mapping[str, npt.NDArray[Any]] | None = None
    record: bool = False
    max_segment: int | None = None
    report_availability: bool = False
    expect_empty: bool = False
    primitive_monitor: bool = False


class Traits(NamedTuple):
    """Properties of an environment with options: ``get_attr("traits")``."""

    n_primitive: int
    gamma: float
    max_runs: int | None
    masks_primitives: bool  # whether the environment masks its own actions
    observation_space: spaces.Space[Any]  # of the observations that options act on; a wrapper above may have another
    feature_kind: FeatureKind | None  # None without a feature map
    feature_groups: tuple[FeatureGroup, ...]
    feature_size: int | None  # None without a feature map, or if only an observation reveals it


class WithSlots:
    """Option slots of one environment, or of all environments of a ``VecEnv``, and their feature map."""

    _has_masks = False  # whether the environment masks its own actions

    def _make_slots(
        self,
        inner: Any,
        own_map: FeatureMap | None,
        max_options: int,
        gamma: float,
        feature_map: FeatureMap | MapName | None,
        options_file: str | os.PathLike[str] | None,
        max_runs: int | None,
    ) -> spaces.Discrete:
        """Make slots over the ``inner`` environment, whose own φ is ``own_map``, and return the augmented actions."""
        space = inner.observation_space
        self.n_primitive = checked_primitives(type(self).__name__, inner.action_space, gamma, max_runs)
        self.gamma = float(gamma)
        self.max_runs = max_runs
        observation_size = feature_maps.flat_size(space)
        self.features = features = feature_maps.of_space(space, feature_map, own_map)
        self.bank = OptionBank(
            self.n_primitive,
            max_options,
            feature_map=features.map if features else None,
            observation_size=observation_size,
            feature_size=features.size if features else None,
            signature=feature_maps.signature(space, features),
        )
        if options_file is not None:
            self.bank.load(options_file)
        self.slot_state = SlotState()
        self._inner_space = space
        self._primitive = OptionRun(-1, 1, self.gamma, self.gamma, "primitive").as_info()
        return spaces.Discrete(self.n_primitive + max_options)

    @property
    def traits(self) -> Traits:
        """Properties of each environment. With `bank` they hold all that others ask, also from another process."""
        features = self.features
        return Traits(
            self.n_primitive,
            self.gamma,
            self.max_runs,
            self._has_masks,
            self._inner_space,
            features.kind if features else None,
            features.groups if features else (),
            self.bank.feature_size,
        )

    def concept_features(self, observations: Observations) -> FloatArray:
        """Return φ of a batch of observations, shape (batch, d)."""
        if self.features is None:
            raise ValueError(
                f"There is no default feature map for {self._inner_space}: pass OptionsWrapper(env, feature_map=...) "
                "a function from a batch of observations to features (batch, d), or 'temporal-distance', which is "
                "learned."
            )
        return self.features.map(observations)

    def available(self, observations: Observations) -> BoolArray:
        """Return which augmented actions may start by initiation sets alone, (batch, n_primitive + max_options)."""
        return self.bank.available(observations)

    def _change_slots(self, changes: Mapping[str, Any]) -> None:
        """Change bank, learned map and state."""
        options: Mapping[int, Option | None] = changes.get("options", {})
        later = dataclasses.replace(self.slot_state, **changes)
        for slot, option in options.items():
            self.bank.check_slot(slot)
            if option is not None:
                self.bank.add(option, slot)
            elif slot in self.bank.filled:
                self.bank.remove(slot)
        if changes.get("learned_map") is not None:
            assert self.features is not None  # a map is learned only where there is one
            cast("LearnedMap", self.features.map).load(changes["learned_map"])
            self.bank.bind(self.features.map)  # and forget what followed from the former one
        self.slot_state = dataclasses.replace(later, options={**self.slot_state.options, **options})

    def _measure_features(self, observation: Any) -> None:
        """Set the size of φ, if only an observation reveals it."""
        if self.features is not None and self.bank.feature_size is None:
            self.bank.feature_size = feature_maps.checked_size(self.features.map, batch_of_one(observation))


def checked_primitives(whose: str, space: spaces.Space[Any], gamma: float, max_runs: int | None) -> int:
    """Return the number of primitive actions, after checking action space, γ and ``max_runs``."""
    if not isinstance(space, spaces.Discrete) or space.start != 0:
        raise TypeError(
            f"{whose} needs a Discrete action space that starts at 0, got {space}: discretise or number the actions "
            "first, for instance by gymnasium.wrappers.TransformAction."
        )
    if not (is_number(gamma) and 0.0 < gamma <= 1.0):
        raise ValueError(f"gamma must be in (0, 1], got {gamma!r}.")
    if max_runs is not None and not whole(max_runs, 1):
        raise ValueError(f"max_runs must be a whole number, at least 1, or None for no limit, got {max_runs!r}.")
    return int(space.n)
