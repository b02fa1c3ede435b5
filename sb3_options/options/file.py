"""The options file: safetensors arrays and JSON, and the signature of the observations that the options act on."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, get_args

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as from_safetensors
from safetensors.numpy import save as to_safetensors

from sb3_options.checked import whole
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.embedding.settings import LEARNED
from sb3_options.options import policies
from sb3_options.options.archive import Source, content_in, name_of
from sb3_options.options.option import Option, SubgoalOption
from sb3_options.options.policies import PolicyInput

MAX_SLOTS = 1_000_000  # each slot is an action, for which a network has an output
FILE_FORMAT = "sb3-options 1"  # an optional entry such as ``made_for`` needs no new number
MAP = "feature_map"  # before the names of arrays of a learned feature map. Slots have numbers

FEWER_FEATURES = (
    "Discover options on groups that both tasks have, ConceptSettings(groups=...). In MiniGrid what a mission "
    "asks for is such a group: discover with make(..., asked=False), train.py --env-kwargs asked:False"
)
"""What to do about an option whose features a task does not have."""

Arrays = dict[str, np.ndarray[Any, Any]]


class SpaceSignature(NamedTuple):
    """The observations that options act on.

    Attributes:
        space: The observation space, for people.
        digest: Equal for two spaces exactly if type, shape, dtype and bounds are, part by part.
        features: Where the feature map comes from (`features.FeatureKind`); None where there is none.
    """

    space: str
    digest: str
    features: str | None


def check_signature(there: SpaceSignature, here: SpaceSignature, policy_inputs: set[PolicyInput]) -> None:
    """Refuse options that were made for other observations: those of a file, ``there``, and of the bank, ``here``.

    A policy that acts on the observation needs the same space, one that acts on features does not. Both need the same
    kind of feature map, because the subgoals lie in its space. A map that the user passed is taken to be that one,
    unless that was learned.
    """
    if "observation" in policy_inputs and there.digest != here.digest:
        bounds = "" if there.space != here.space else ", whose bounds differ"
        raise ValueError(
            f"its options were made for observations {there.space}, this task's are {here.space}{bounds}; only "
            "options whose policies act on features (policy_input='features') move between tasks that are observed "
            "differently: learn them so, or make both environments give the same observations"
        )
    given = here.features == "given" and there.features != LEARNED  # of which the file holds the map
    if policy_inputs and not given and here.features != there.features:
        name = f'"{there.features}"' if there.features == LEARNED else "..."
        raise ValueError(
            f"its subgoals lie in {_OF_KIND[there.features]}, this task's in {_OF_KIND[here.features]}; pass the "
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


def content_of(
    slots: Sequence[Option | None],
    *,
    n_primitive: int,
    signature: SpaceSignature | None,
    feature_map: Arrays | None = None,
) -> bytes:
    """What a file says: the arrays of the discovered options and the names of the hand-made ones.

    ``feature_map`` is what a learned map consists of, without which its options are of no use.
    """
    tensors: Arrays = {f"{MAP}.{name}": array for name, array in (feature_map or {}).items()}
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
    return packed(about, tensors)


class OptionsFile(NamedTuple):
    """What an options file says, checked but for the arrays of its options."""

    name: str  # for errors
    n_primitive: int
    max_options: int
    entries: dict[int, dict[str, Any]]  # of discovered options, by slot
    hand_made: dict[int, str]  # names of the others, by slot
    made_for: SpaceSignature | None  # observations they act on; None for any
    tensors: Arrays
    digest: str  # SHA-256 of the content

    def feature_map(self) -> Arrays:
        """What its learned feature map consists of; nothing if it has none."""
        return _named(f"{MAP}.", self.tensors)

    def options(
        self, *, observation_size: int | None = None, feature_size: int | None = None
    ) -> dict[int, SubgoalOption]:
        """The discovered options by slot, not bound to a feature map; a size of None takes any."""
        options = {}
        with _errors_of(self.name):
            for slot, entry in self.entries.items():
                arrays = {name: np.asarray(a, dtype=np.float64) for name, a in _named(f"{slot}.", self.tensors).items()}
                try:
                    options[slot] = _decode(entry, arrays, self.n_primitive, observation_size, feature_size)
                except ValueError as error:
                    raise ValueError(f"the option in slot {slot}, {entry['name']!r}: {error}") from error
        return options


def opened(source: Source) -> OptionsFile:
    """What an options file says."""
    content, name = content_in(source), name_of(source)
    about, tensors = _parts_of(content, name)
    with _errors_of(name):
        n_primitive, max_options = about["n_primitive"], about["max_options"]
        for what, number, least in (("n_primitive", n_primitive, 1), ("max_options", max_options, 0)):
            if not (whole(number, least) and number <= MAX_SLOTS):  # before anything is made of so many
                raise TypeError(f"{what} must be a whole number from {least} to {MAX_SLOTS:,}, got {number!r:.50}")
        slots = {int(slot): entry for slot, entry in about["slots"].items()}
        if not all(0 <= slot < max_options for slot in slots):
            raise IndexError(f"an option in slot {max(slots, key=abs)} of {max_options}")
        hand_made = {slot: str(entry["name"]) for slot, entry in slots.items() if entry.get("hand_made")}
        entries = {slot: entry for slot, entry in slots.items() if slot not in hand_made}
        made_for = SpaceSignature(**about["made_for"]) if "made_for" in about else None
        if made_for is not None and made_for.features not in _OF_KIND:
            raise KeyError(made_for.features)
    sha256 = hashlib.sha256(content).hexdigest()
    return OptionsFile(name, n_primitive, max_options, entries, hand_made, made_for, tensors, sha256)


@contextmanager
def _errors_of(name: str) -> Iterator[None]:
    """What does not fit, and what makes no sense, as a `ValueError` that says in which file."""
    try:
        yield
    except (KeyError, IndexError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError(f"{name} is damaged: {error!r}") from error
    except ValueError as error:
        raise ValueError(f"{name} does not fit: {error}.") from error


def load(
    source: Source,
    slots: Sequence[Option | None],
    *,
    n_primitive: int,
    observation_size: int | None,
    feature_size: int | None,
    signature: SpaceSignature | None,
) -> dict[int, SubgoalOption]:
    """The discovered options of `content_of`, by slot, not bound to a feature map, as `OptionBank.load`.

    A hand-made option of the file must be in its slot.
    """
    file = opened(source)
    with _errors_of(file.name):
        if file.n_primitive != n_primitive:
            raise ValueError(
                f"its options choose among {file.n_primitive} primitive actions, this task has {n_primitive}"
            )
        for slot in (*file.entries, *file.hand_made):
            if slot >= len(slots):
                raise ValueError(
                    f"it has an option in slot {slot}, this bank only has {len(slots)} slots; make the wrapper "
                    f"with max_options={file.max_options}"
                )
        for slot, name in file.hand_made.items():
            present = slots[slot]
            if present is None or present.name != name:
                raise ValueError(
                    f"slot {slot} held the hand-made option {name!r}, which is code and not in the file; add it to "
                    "the bank first"
                )
        if signature is not None and file.made_for is not None:
            check_signature(file.made_for, signature, {_policy_input(entry) for entry in file.entries.values()})
    return file.options(observation_size=observation_size, feature_size=feature_size)


def slots_of(source: Source) -> list[int]:
    """The slots that a file has options for."""
    file = opened(source)
    return [*file.entries, *file.hand_made]


def _named(first: str, tensors: Arrays) -> Arrays:
    """The arrays whose names begin so, by the rest of the name."""
    return {name.removeprefix(first): array for name, array in tensors.items() if name.startswith(first)}


def packed(about: dict[str, Any], tensors: Arrays) -> bytes:
    """JSON and arrays with their digest; `read` is the inverse."""
    text = json.dumps(about)
    metadata = {"format": FILE_FORMAT, "bank": text, "digest": digest(text, tensors)}
    return _in_order(to_safetensors(tensors, metadata=metadata))


def _in_order(content: bytes) -> bytes:
    """The same file with its metadata in order, so that the same options are the same bytes: safetensors draws one."""
    start = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:start])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + content[start:]


def read(source: Source) -> tuple[dict[str, Any], Arrays]:
    """What `packed` was given. Only the digest is checked, and the errors are those of `load`."""
    return _parts_of(content_in(source), name_of(source))


def _parts_of(content: bytes, name: str) -> tuple[dict[str, Any], Arrays]:
    try:
        tensors = {key: np.array(array) for key, array in from_safetensors(content).items()}
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    except (SafetensorError, KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{name} is no options file, or it is damaged: {error}") from error
    metadata = header.get("__metadata__", {})
    if metadata.get("format") != FILE_FORMAT:
        raise ValueError(
            f"{name} is no options file of this version: its format is {metadata.get('format')!r}, "
            f"expected {FILE_FORMAT!r}."
        )
    if metadata.get("digest") != digest(metadata.get("bank", ""), tensors):
        raise ValueError(f"{name} is damaged: its contents are not what was written to it.")
    try:
        about = json.loads(metadata["bank"])
    except (KeyError, RecursionError, json.JSONDecodeError) as error:
        raise ValueError(f"{name} is damaged: {error!r}") from error
    if not isinstance(about, dict):
        raise ValueError(f"{name} is damaged: it says {type(about).__name__} where a dictionary should be.")
    return about, tensors


def _encode(option: SubgoalOption) -> tuple[dict[str, Any], Arrays]:
    """A discovered option as JSON and arrays; `_decode` is the inverse."""
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
    entry: dict[str, Any], arrays: Arrays, n_primitive: int, observation_size: int | None, feature_size: int | None
) -> SubgoalOption:
    """The option that `_encode` was given; a `ValueError` says which parts do not fit."""
    group = FeatureGroup(**entry["group"]) if "group" in entry else None
    subgoal = _region(arrays, "subgoal", entry["radius"]["subgoal"], group)
    sees = None if group is None else group.sees
    initiation = _region(arrays, "initiation", entry["radius"]["initiation"], sees)
    n_features, n_seen = subgoal.points.shape[1], initiation.points.shape[1]
    if group is not None and sees is not None:
        for what, number, of in (("subgoal", n_features, group), ("initiation set", n_seen, sees)):
            if number != len(of.features):
                raise ValueError(f"its {what} has {number} features, its group names {len(of.features)}")
        most = max(*group.features, *sees.features)
        if feature_size is not None and most >= feature_size:
            raise ValueError(
                f"its group {group.name!r} names feature {most}, the feature map gives {feature_size}. {FEWER_FEATURES}"
            )
    elif feature_size is not None and n_features != feature_size:
        raise ValueError(f"its subgoals have {n_features} features, the feature map here gives {feature_size}")
    elif n_seen != n_features:
        raise ValueError(f"its initiation set has {n_seen} features, its subgoal {n_features}")
    policy_input = _policy_input(entry)
    size = observation_size if policy_input == "observation" else n_seen
    return SubgoalOption(
        subgoal,
        initiation,
        policies.from_arrays(arrays, size, n_primitive),
        policy_input=policy_input,
        max_duration=entry["max_duration"],
        name=str(entry["name"]),
    )


def _policy_input(entry: dict[str, Any]) -> PolicyInput:
    policy_input: PolicyInput = entry.get("policy_input", "observation")
    if policy_input not in get_args(PolicyInput):
        raise ValueError(f"its policy acts on {policy_input!r}, expected one of {', '.join(get_args(PolicyInput))}")
    return policy_input


def _region(arrays: Arrays, name: str, radius: float, group: FeatureGroup | None) -> Region:
    points, scale = arrays[name], arrays[f"{name}_scale"]
    if points.ndim != 2 or scale.shape != points.shape[1:]:
        raise ValueError(f"its {name} has points of shape {points.shape} and a scale of shape {scale.shape}")
    if not (np.isfinite(points).all() and np.isfinite(scale).all() and np.isfinite(radius) and radius >= 0):
        raise ValueError(f"its {name} holds numbers that are not finite, or a negative radius")
    normal = arrays.get(f"{name}_normal")
    if normal is not None and not (len(points) == 1 and normal.shape == scale.shape and np.isfinite(normal).all()):
        raise ValueError(f"its {name} has {len(points)} points and a normal of shape {normal.shape}, or no finite one")
    return Region(points, scale, float(radius), group=group, normal=normal)


def digest(about: str, tensors: Arrays) -> str:
    """SHA-256 of everything an options file says, by which a damaged file is recognised."""
    sha256 = hashlib.sha256(about.encode())
    for name in sorted(tensors):
        sha256.update(f"{name} {tensors[name].dtype} {tensors[name].shape}".encode())
        sha256.update(tensors[name].tobytes())
    return sha256.hexdigest()
