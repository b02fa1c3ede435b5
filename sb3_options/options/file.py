"""The file that options are kept in: arrays and JSON, and what observations they were made for."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as to_safetensors

from sb3_options.atomic import whole_file
from sb3_options.density.regions import HalfSpace, Region
from sb3_options.options import policies as option_policy
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import PolicyInput

FILE_FORMAT = "sb3-options 1"
FILE_FORMAT_HALF_SPACE = "sb3-options 2"
"""Of a file with a half-space, which a reader of the first format would take for a ball.

What observations the options were made for needs no number of its own: a reader that does not know of it reads
everything else as before.
"""


class MadeFor(NamedTuple):
    """The observations that options act on.

    Attributes:
        space: The observation space, for people.
        digest: Equal for two spaces exactly if type, shape, dtype and bounds are, part by part.
        features: Where the feature map comes from (`features.FeatureKind`); None where there is none.
    """

    space: str
    digest: str
    features: str | None


def check_made_for(there: MadeFor, here: MadeFor, policy_inputs: set[PolicyInput]) -> None:
    """Refuse options that were made for other observations.

    A policy that acts on the observation needs the same space. One that acts on features does not: what its features
    are made of is the feature map's affair. Either needs the same kind of feature map, because that is where the
    subgoals lie; a map that the user gave here is taken to be meant.

    Args:
        there: Of the file.
        here: Of the bank.
        policy_inputs: What the file's policies act on.

    Raises:
        ValueError: They do not agree.
    """
    if "observation" in policy_inputs and there.digest != here.digest:
        bounds = "" if there.space != here.space else ", whose bounds differ"
        raise ValueError(
            f"its options were made for observations {there.space}, this task's are {here.space}{bounds}; only "
            "options whose policies act on features (policy_input='features') move between tasks that are observed "
            "differently: learn them so, or make both environments give the same observations"
        )
    if policy_inputs and here.features not in ("given", there.features):
        raise ValueError(
            f"its subgoals lie in {_OF_KIND[there.features]}, this task's in {_OF_KIND[here.features]}; pass the "
            "feature map they were made with, OptionsWrapper(env, feature_map=...)"
        )


_OF_KIND: dict[str | None, str] = {
    "given": "the features of a feature_map that was passed",
    "environment": "the environment's own concept_features",
    "categorical": "one-hot codes of the observations",
    "identity": "the flat observations",
    None: "no features at all",
}


def write(path: str | os.PathLike[str], about: dict[str, Any], tensors: dict[str, np.ndarray[Any, Any]]) -> None:
    """Write a file, whole or not at all.

    Args:
        path: Where.
        about: What `read` returns, JSON.
        tensors: The options' arrays, as `taken_apart` names them, the slot and a dot before.

    Raises:
        OSError: It cannot be written.
    """
    half_space = any(name.endswith(".subgoal_normal") for name in tensors)
    text = json.dumps(about)
    metadata = {
        "format": FILE_FORMAT_HALF_SPACE if half_space else FILE_FORMAT,
        "bank": text,
        "digest": digest(text, tensors),
    }
    content = to_safetensors(tensors, metadata=metadata)
    with whole_file(path) as temporary:
        temporary.write_bytes(content)


def read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """What `write` wrote, its digest checked and nothing else.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, or something else.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"There is no options file at {path}.")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # no dictionary
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is no options file, or it is damaged: {error}") from error
    if metadata.get("format") not in (FILE_FORMAT, FILE_FORMAT_HALF_SPACE):
        raise ValueError(
            f"{path} is no options file of this version: its format is {metadata.get('format')!r}, "
            f"expected {FILE_FORMAT!r} or {FILE_FORMAT_HALF_SPACE!r}."
        )
    if metadata.get("digest") != digest(metadata.get("bank", ""), tensors):
        raise ValueError(f"{path} is damaged: its contents are not what was written to it.")
    try:
        about = json.loads(metadata["bank"])
    except (KeyError, RecursionError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is damaged: {error!r}") from error
    if not isinstance(about, dict):
        raise ValueError(f"{path} is damaged: it says {type(about).__name__} where a dictionary should be.")
    return about, tensors


def slots_of(path: str | os.PathLike[str]) -> list[int]:
    """The slots that a file has options for.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, or something else.
    """
    about, _ = read(path)
    try:
        return [int(slot) for slot in about["slots"]]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged: {error!r}") from error


def taken_apart(option: SubgoalOption) -> tuple[dict[str, Any], dict[str, np.ndarray[Any, Any]]]:
    """A discovered option as JSON and arrays; `put_together` turns it back."""
    arrays = {
        "subgoal": option.subgoal.points,
        "subgoal_scale": option.subgoal.scale,
        "initiation": option.initiation_set.points,
        "initiation_scale": option.initiation_set.scale,
        **option.option_policy.arrays(),
    }
    if isinstance(option.subgoal, HalfSpace):
        arrays["subgoal_normal"] = option.subgoal.normal
    entry = {
        "name": option.name,
        "max_duration": option.max_duration,
        "radius": {"subgoal": float(option.subgoal.radius), "initiation": float(option.initiation_set.radius)},
        "policy_input": option.policy_input,
    }
    return entry, {name: np.ascontiguousarray(array, dtype=np.float64) for name, array in arrays.items()}


def put_together(
    entry: dict[str, Any],
    arrays: dict[str, Any],
    *,
    n_primitive: int,
    observation_size: int | None,
    feature_size: int | None,
) -> SubgoalOption:
    """The option that `taken_apart` took apart, not bound to a feature map.

    Args:
        entry: Its JSON.
        arrays: By name.
        n_primitive: Number of primitive actions.
        observation_size: Numbers in one flat observation; None for any.
        feature_size: Dimensions of concept space; None for any.

    Raises:
        ValueError: Its parts fit neither each other nor these.
        KeyError: A part is missing.
        TypeError: A part is of another type.
    """
    subgoal = _region(arrays, "subgoal", entry["radius"]["subgoal"])
    initiation = _region(arrays, "initiation", entry["radius"]["initiation"])
    if feature_size is not None and subgoal.points.shape[1] != feature_size:
        raise ValueError(
            f"its subgoals have {subgoal.points.shape[1]} features, the feature map here gives {feature_size}"
        )
    if initiation.points.shape[1] != subgoal.points.shape[1]:
        raise ValueError(
            f"its initiation set has {initiation.points.shape[1]} features, its subgoal {subgoal.points.shape[1]}"
        )
    policy_input = policy_input_of(entry)
    size = observation_size if policy_input == "observation" else subgoal.points.shape[1]
    if size is None:
        stored = arrays.get("table_states", arrays.get("network_mean"))
        size = 0 if stored is None else stored.shape[-1]
    return SubgoalOption(
        subgoal,
        initiation,
        option_policy.from_arrays(arrays, size, n_primitive),
        policy_input=policy_input,
        max_duration=entry["max_duration"],
        name=str(entry["name"]),
    )


def policy_input_of(entry: dict[str, Any]) -> PolicyInput:
    """What the policy of an option acts on.

    Raises:
        ValueError: It is none of those there are.
    """
    policy_input: PolicyInput = entry.get("policy_input", "observation")
    if policy_input not in get_args(PolicyInput):
        raise ValueError(f"its policy acts on {policy_input!r}, expected one of {', '.join(get_args(PolicyInput))}")
    return policy_input


def digest(about: str, tensors: dict[str, Any]) -> str:
    """SHA-256 of everything an options file says, so that a damaged one is told from a whole one."""
    sha256 = hashlib.sha256(about.encode())
    for name in sorted(tensors):
        sha256.update(f"{name} {tensors[name].dtype} {tensors[name].shape}".encode())
        sha256.update(tensors[name].tobytes())
    return sha256.hexdigest()


def _region(arrays: dict[str, Any], name: str, radius: float) -> Region:
    points, scale = arrays[name], arrays[f"{name}_scale"]
    if points.ndim != 2 or scale.shape != points.shape[1:]:
        raise ValueError(f"its {name} has points of shape {points.shape} and a scale of shape {scale.shape}")
    if not (np.isfinite(points).all() and np.isfinite(scale).all() and np.isfinite(radius) and radius >= 0):
        raise ValueError(f"its {name} holds numbers that are not finite, or a negative radius")
    normal = arrays.get(f"{name}_normal")
    if normal is None:
        return Region(points, scale, float(radius))
    if len(points) != 1 or normal.shape != scale.shape or not np.isfinite(normal).all():
        raise ValueError(f"its {name} has points of shape {points.shape} and a normal of shape {normal.shape}")
    return HalfSpace(points, scale, float(radius), normal)
