"""`SlotState`: the options as sent to an environment; `Traits`: properties that an environment reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy.typing as npt
from gymnasium import spaces

from sb3_options.density.groups import FeatureGroup
from sb3_options.execution.features import FeatureKind
from sb3_options.options.option import Option


@dataclass(frozen=True)
class SlotState:
    """Everything that an environment holds of options. ``env_method("set_slots", field=value)`` replaces fields.

    Attributes:
        options: By slot, what was put into it: an option, or None for an empty slot. Slots that are not named hold
            what the environment was made with. `OptionsWrapper.set_slots` adds to this field.
        learned_map: What the learned feature map is (`LearnedMap.arrays`).
        record: Whether infos hold the primitive steps: the info that ends an episode as ``info["trajectory"]``.
        max_segment: Primitive steps of the longest segment, where ``record`` cuts at peaks of reward: then
            ``info["segments"]`` lists the segments that ended in the step. None records whole episodes.
        report_availability: Whether ``info["option"]["available"]`` says which slots may start in each observation
            arrived in.
        expect_empty: Whether a callback knows which slots are empty: then to choose one is exploration, no mistake.
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
    """What an environment with options is; ``get_attr("traits")``."""

    n_primitive: int
    max_options: int
    gamma: float
    max_runs: int | None
    masks_primitives: bool  # whether the environment says which of its own actions may be taken
    observation_space: spaces.Space[Any]  # of what options act on; a wrapper above may have another
    feature_kind: FeatureKind | None  # None without a feature map
    feature_groups: tuple[FeatureGroup, ...]
    feature_size: int | None  # None without a feature map, or where only an observation tells
