"""The options file: safetensors arrays and JSON, and the signature of the observations that the options act on."""

import dataclasses
import hashlib
import os
from collections.abc import Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, Field, TypeAdapter

from sb3_options.density.groups import FeatureGroup, checked_groups
from sb3_options.density.regions import Region
from sb3_options.embedding.settings import LEARNED
from sb3_options.options import policies
from sb3_options.options.archive import NO_OPTIONS_FILE, Source, content_in
from sb3_options.options.option import Option, SubgoalOption
from sb3_options.options.policies import PolicyInput
from sb3_options.options.sealed import Arrays, errors_of, sealed, unsealed

MAX_SLOTS = 1_000_000  # each slot is an action, for which a network has an output
FILE_FORMAT = "sb3-options 1"  # an optional entry such as ``made_for`` needs no new number
MAP = "feature_map"  # prefix of the array names of a learned feature map. Slots have numbers


class SpaceSignature(NamedTuple):
    """The observations that options act on."""

    space: str  # the observation space in readable form
    digest: str  # equal for two spaces exactly if type, shape, dtype and bounds are, part by part
    features: str | None  # origin of the feature map (`features.FeatureKind`); None if there is none


def check_signature(made_for: SpaceSignature, task: SpaceSignature, policy_inputs: set[PolicyInput]) -> None:
    """Refuse options of a file that were made for other observations than those of this task.

    A policy that acts on the observation needs the same space; one that acts on features does not. Both need the same
    kind of feature map, because the subgoals lie in its space. A map that the user passed counts as the same map,
    unless the options were made with a learned one.
    """
    if "observation" in policy_inputs and made_for.digest != task.digest:
        bounds = "" if made_for.space != task.space else ", whose bounds differ"
        raise ValueError(
            f"its options were made for observations {made_for.space}, this task's are {task.space}{bounds}; only "
            "options whose policies act on features (policy_input='features') move between tasks that are observed "
            "differently: learn them so, or make both environments give the same observations"
        )
    given = task.features == "given" and made_for.features != LEARNED  # its map is in the file
    if policy_inputs and not given and task.features != made_for.features:
        name = f'"{made_for.features}"' if made_for.features == LEARNED else "..."
        raise ValueError(
            f"its subgoals lie in {_OF_KIND[made_for.features]}, this task's in {_OF_KIND[task.features]}; pass the "
            f"feature map they were made with, OptionsWrapper(env, feature_map={name})"
        )


_OF_KIND: dict[str | None, str] = {
    "given": "the features of a feature_map that was passed",
    "environment": "the environment's own concept_features",
    "categorical": "one-hot codes of the observations",
    "identity": "the flat observations",
    "temporal-distance": "a learned space of temporal distances",
    None: "no features at all",
}


class Entry(BaseModel):
    """Content of a file about one discovered option, besides its arrays."""

    name: str
    max_duration: Annotated[int, Field(ge=1)]
    radius: dict[Literal["subgoal", "initiation"], Annotated[float, Field(ge=0, allow_inf_nan=False)]]
    policy_input: PolicyInput = "observation"
    group: FeatureGroup | None = None


class About(BaseModel):
    """Content of a file besides its arrays."""

    n_primitive: Annotated[int, Field(ge=1, le=MAX_SLOTS)]  # checked before anything of this size is made
    max_options: Annotated[int, Field(ge=0, le=MAX_SLOTS)]
    slots: dict[Annotated[int, Field(ge=0)], dict[str, Any]]
    made_for: SpaceSignature | None = None


def content_of(
    slots: Sequence[Option | None], n_primitive: int, signature: SpaceSignature | None, learned_map: Arrays
) -> bytes:
    """Return the content of a file: the arrays of the discovered options and the names of the hand-made ones.

    It includes a learned feature map, without which its options are useless.
    """
    tensors: Arrays = {f"{MAP}.{name}": array for name, array in learned_map.items()}
    entries: dict[str, Any] = {}
    for slot, option in enumerate(slots):
        if isinstance(option, SubgoalOption):
            entries[str(slot)], arrays = _encode(option)
            tensors |= {f"{slot}.{name}": array for name, array in arrays.items()}
        elif option is not None:
            entries[str(slot)] = {"name": option.name, "hand_made": True}
    about: dict[str, Any] = {"n_primitive": n_primitive, "max_options": len(slots), "slots": entries}
    if signature is not None:
        about["made_for"] = signature._asdict()
    return sealed(FILE_FORMAT, {"bank": about}, tensors)


class OptionsFile(NamedTuple):
    """Content of an options file, checked except for the arrays of its options."""

    name: str  # for errors
    n_primitive: int
    max_options: int
    entries: dict[int, Entry]  # of discovered options, by slot
    hand_made: dict[int, str]  # names of the others, by slot
    made_for: SpaceSignature | None  # observations they act on; None for any
    tensors: Arrays
    digest: str  # SHA-256 of the content

    @property
    def slots(self) -> set[int]:
        """Slots that the file has options for."""
        return {*self.entries, *self.hand_made}

    def feature_map(self) -> Arrays:
        """Return the arrays of its learned feature map, if it has one."""
        return _named(f"{MAP}.", self.tensors)

    def options(
        self, *, observation_size: int | None = None, feature_size: int | None = None
    ) -> dict[int, SubgoalOption]:
        """Return the discovered options by slot, not bound to a feature map; a size of None accepts any."""
        options = {}
        for slot, entry in self.entries.items():
            arrays = {name: np.asarray(a, dtype=np.float64) for name, a in _named(f"{slot}.", self.tensors).items()}
            with errors_of(self.name, f"does not fit, the option in slot {slot}, {entry.name!r}"):
                options[slot] = _decode(entry, arrays, self.n_primitive, observation_size, feature_size)
        return options


def opened(source: Source) -> OptionsFile:
    """Read an options file."""
    content = content_in(source)
    name = "What the model carries" if isinstance(source, bytes) else os.fspath(source)
    with errors_of(name, NO_OPTIONS_FILE):
        parts, tensors = unsealed(content, FILE_FORMAT)
        about = About.model_validate(parts["bank"])
        hand_made = {slot: str(entry["name"]) for slot, entry in about.slots.items() if entry.get("hand_made")}
        discovered = {slot: entry for slot, entry in about.slots.items() if slot not in hand_made}
        entries = TypeAdapter(dict[int, Entry]).validate_python(discovered)
    sha256 = hashlib.sha256(content).hexdigest()
    return OptionsFile(name, about.n_primitive, about.max_options, entries, hand_made, about.made_for, tensors, sha256)


def _named(first: str, tensors: Arrays) -> Arrays:
    """Return the arrays whose names begin with ``first``, by the rest of the name."""
    return {name.removeprefix(first): array for name, array in tensors.items() if name.startswith(first)}


def _encode(option: SubgoalOption) -> tuple[dict[str, Any], Arrays]:
    """Return a discovered option as JSON and arrays; `_decode` is the inverse."""
    arrays = {
        "subgoal": option.subgoal.points,
        "subgoal_scale": option.subgoal.scale,
        "initiation": option.initiation_set.points,
        "initiation_scale": option.initiation_set.scale,
        **option.option_policy.arrays(),
    }
    if option.subgoal.normal is not None:
        arrays["subgoal_normal"] = option.subgoal.normal
    entry = {
        "name": option.name,
        "max_duration": option.max_duration,
        "radius": {"subgoal": float(option.subgoal.radius), "initiation": float(option.initiation_set.radius)},
        "policy_input": option.policy_input,
    }
    if option.subgoal.group is not None:
        entry["group"] = {k: v for k, v in dataclasses.asdict(option.subgoal.group).items() if v is not None}
    return entry, {name: np.ascontiguousarray(array, dtype=np.float64) for name, array in arrays.items()}


def _decode(
    entry: Entry, arrays: Arrays, n_primitive: int, observation_size: int | None, feature_size: int | None
) -> SubgoalOption:
    """Return the option that `_encode` encoded."""
    group = entry.group
    if group is not None and feature_size is not None:
        checked_groups([group], feature_size)
    subgoal = _region(arrays, "subgoal", entry, group, feature_size)
    initiation = _region(arrays, "initiation", entry, group and group.sees, subgoal.points.shape[1])
    size = observation_size if entry.policy_input == "observation" else initiation.points.shape[1]
    return SubgoalOption(
        subgoal,
        initiation,
        policies.from_arrays(arrays, size, n_primitive),
        policy_input=entry.policy_input,
        max_duration=entry.max_duration,
        name=entry.name,
    )


def _region(arrays: Arrays, name: str, entry: Entry, group: FeatureGroup | None, n_features: int | None) -> Region:
    """Return a region in a group's features, or in ``n_features``; None accepts any number."""
    points, scale, normal = arrays[name], arrays[f"{name}_scale"], arrays.get(f"{name}_normal")
    n = len(group.features) if group is not None else points.shape[1] if n_features is None else n_features
    fits = points.shape == (len(points), n) and scale.shape == (n,)
    fits = fits and (normal is None or (len(points) == 1 and normal.shape == (n,)))
    if not (fits and all(np.isfinite(each).all() for each in (points, scale, normal) if each is not None)):
        raise ValueError(
            f"its {name} has points of shape {points.shape} and a scale of shape {scale.shape}, expected {n} features "
            "and finite numbers"
        )
    return Region(points, scale, entry.radius[name], group=group, normal=normal)  # type: ignore[index]  # one of two
