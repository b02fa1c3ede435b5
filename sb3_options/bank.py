"""The slots behind the augmented actions, and the file that options are kept in."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as to_safetensors

from sb3_options import option_policy
from sb3_options.atomic import whole_file
from sb3_options.observations import BoolArray, FeatureMap, Observations, batch_size
from sb3_options.option import HalfSpace, Option, Region, SubgoalOption
from sb3_options.option_policy import PolicyInput

FILE_FORMAT = "sb3-options 1"
FILE_FORMAT_HALF_SPACE = "sb3-options 2"
"""Of a file with a half-space, which a reader of the first format would take for a ball."""


class OptionBank:
    """Ordered slots: augmented action ``n_primitive + i`` is slot i, for ever.

    The capacity never changes, so that the action space stays what it was under an algorithm, a worker process, a
    replay buffer or a saved model while slots fill.

    Args:
        n_primitive: Number of primitive actions, at least 1.
        max_options: Number of slots, at least 0.
        feature_map: φ that discovered options are bound to when they are added.
        observation_size: Numbers in one flat observation; None accepts options for any.
        feature_size: Dimensions d of concept space; None accepts options for any.

    Raises:
        ValueError: ``n_primitive`` < 1 or ``max_options`` < 0.
    """

    def __init__(
        self,
        n_primitive: int,
        max_options: int,
        *,
        feature_map: FeatureMap | None = None,
        observation_size: int | None = None,
        feature_size: int | None = None,
    ) -> None:
        if n_primitive < 1:
            raise ValueError(f"n_primitive must be at least 1, got {n_primitive}.")
        if max_options < 0:
            raise ValueError(f"max_options must be at least 0, got {max_options}.")
        self.n_primitive = n_primitive
        self.max_options = max_options
        self.feature_map = feature_map
        self.observation_size = observation_size
        self.feature_size = feature_size
        self._slots: list[Option | None] = [None] * max_options
        self.filled: tuple[int, ...] = ()

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
        """Put an option into a slot.

        Args:
            option: Any option. A `SubgoalOption` is bound to the bank's feature map, if it has one.
            slot: Which slot, replacing what is in it; by default the first empty one.

        Returns:
            The slot it went into.

        Raises:
            TypeError: ``option`` is no `Option`.
            ValueError: No slot is empty, or there is no such slot.
        """
        if not isinstance(option, Option):
            raise TypeError(f"option must be an Option, got {type(option).__name__}.")
        if slot is None:
            if len(self) == self.max_options:
                raise ValueError(
                    f"All {self.max_options} option slots are filled: remove one, or make the wrapper with a "
                    "larger max_options."
                )
            slot = self._slots.index(None)
        self._check_slot(slot)
        self._put(slot, self._bound(option))
        return slot

    def remove(self, slot: int) -> Option:
        """Empty a slot, and return what was in it.

        Raises:
            ValueError: There is no such slot, or it is empty.
        """
        self._check_slot(slot)
        option = self._slots[slot]
        if option is None:
            raise ValueError(f"Slot {slot} is empty already.")
        self._put(slot, None)
        return option

    def bind(self, feature_map: FeatureMap | None) -> None:
        """Take ``feature_map`` for the discovered options there are and those to come."""
        self.feature_map = feature_map
        self._slots = [option and self._bound(option) for option in self._slots]

    def available(self, observations: Observations) -> BoolArray:
        """Which augmented actions may start in each observation.

        Returns:
            Shape (batch, n_primitive + max_options): primitives always, options within their initiation sets, empty
            slots never.
        """
        mask = np.ones((batch_size(observations), self.n_primitive + self.max_options), dtype=bool)
        mask[:, self.n_primitive :] = self.available_slots(observations)
        return mask

    def available_slots(self, observations: Observations) -> BoolArray:
        """Which options may start in each observation, shape (batch, max_options)."""
        mask = np.zeros((batch_size(observations), self.max_options), dtype=bool)
        for slot in self.filled:
            mask[:, slot] = cast("Option", self._slots[slot]).initiation(observations)
        return mask

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the discovered options to a safetensors file: arrays and JSON, nothing that can run.

        A hand-made option consists of code, so only its name is written. The file appears whole or not at all: a
        full disk or a killed process leaves the old one as it was.

        Raises:
            OSError: The file cannot be written.
        """
        tensors: dict[str, np.ndarray[Any, Any]] = {}
        slots: dict[str, Any] = {}
        file_format = FILE_FORMAT
        for slot in self.filled:
            option = cast("Option", self._slots[slot])
            if isinstance(option, SubgoalOption):
                arrays = {
                    "subgoal": option.subgoal.points,
                    "subgoal_scale": option.subgoal.scale,
                    "initiation": option.initiation_set.points,
                    "initiation_scale": option.initiation_set.scale,
                    **option.option_policy.arrays(),
                }
                if isinstance(option.subgoal, HalfSpace):
                    arrays["subgoal_normal"] = option.subgoal.normal
                    file_format = FILE_FORMAT_HALF_SPACE
                tensors |= {f"{slot}.{k}": np.ascontiguousarray(a, dtype=np.float64) for k, a in arrays.items()}
                radii = {"subgoal": float(option.subgoal.radius), "initiation": float(option.initiation_set.radius)}
                slots[str(slot)] = {
                    "name": option.name,
                    "max_duration": option.max_duration,
                    "radius": radii,
                    "policy_input": option.policy_input,
                }
            else:
                slots[str(slot)] = {"name": option.name, "hand_made": True}
        about = json.dumps({"n_primitive": self.n_primitive, "max_options": self.max_options, "slots": slots})
        metadata = {"format": file_format, "bank": about, "digest": _digest(about, tensors)}
        content = to_safetensors(tensors, metadata=metadata)
        with whole_file(path) as temporary:
            temporary.write_bytes(content)

    def load(self, path: str | os.PathLike[str]) -> None:
        """Fill the slots with the options of a file that `save` wrote, in the slots they were in.

        A hand-made option of the file must already be in its slot. Either everything is loaded or nothing is.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged, is something else, or holds options for other observations, other
                features or other primitive actions.
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
        if metadata.get("digest") != _digest(metadata.get("bank", ""), tensors):
            raise ValueError(f"{path} is damaged: its contents are not what was written to it.")
        try:
            loaded = self._read(json.loads(metadata["bank"]), tensors)
        except (KeyError, TypeError, AttributeError, OverflowError, RecursionError, json.JSONDecodeError) as error:
            raise ValueError(f"{path} is damaged: {error!r}") from error
        except ValueError as error:
            raise ValueError(f"{path} does not fit: {error}.") from error
        for slot, option in loaded.items():
            self._put(slot, option)

    def _read(self, about: dict[str, Any], tensors: dict[str, Any]) -> dict[int, Option]:
        if about["n_primitive"] != self.n_primitive:
            raise ValueError(
                f"its options choose among {about['n_primitive']} primitive actions, this task has {self.n_primitive}"
            )
        options: dict[int, Option] = {}
        for key, entry in about["slots"].items():
            slot = int(key)
            if not 0 <= slot < self.max_options:
                raise ValueError(
                    f"it has an option in slot {slot}, this bank only has {self.max_options} slots; make the wrapper "
                    f"with max_options={about['max_options']}"
                )
            if entry.get("hand_made"):
                present = self._slots[slot]
                if present is None or present.name != entry["name"]:
                    raise ValueError(
                        f"slot {slot} held the hand-made option {entry['name']!r}, which is code and not in the "
                        "file; add it to the bank first"
                    )
                continue
            arrays = {
                name.removeprefix(f"{slot}."): np.asarray(tensor, dtype=np.float64)
                for name, tensor in tensors.items()
                if name.startswith(f"{slot}.")
            }
            options[slot] = self._option(entry, arrays)
        return options

    def _option(self, entry: dict[str, Any], arrays: dict[str, Any]) -> SubgoalOption:
        subgoal = _region(arrays, "subgoal", entry["radius"]["subgoal"])
        initiation = _region(arrays, "initiation", entry["radius"]["initiation"])
        if self.feature_size is not None and subgoal.points.shape[1] != self.feature_size:
            raise ValueError(
                f"its subgoals have {subgoal.points.shape[1]} features, the feature map here gives {self.feature_size}"
            )
        if initiation.points.shape[1] != subgoal.points.shape[1]:
            raise ValueError(
                f"its initiation set has {initiation.points.shape[1]} features, its subgoal {subgoal.points.shape[1]}"
            )
        policy_input = entry.get("policy_input", "observation")
        if policy_input not in get_args(PolicyInput):
            raise ValueError(f"its policy acts on {policy_input!r}, expected one of {', '.join(get_args(PolicyInput))}")
        size = self.observation_size if policy_input == "observation" else subgoal.points.shape[1]
        if size is None:
            stored = arrays.get("table_states", arrays.get("network_mean"))
            size = 0 if stored is None else stored.shape[-1]
        policy = option_policy.from_arrays(arrays, size, self.n_primitive)
        return SubgoalOption(
            subgoal,
            initiation,
            policy,
            policy_input=policy_input,
            feature_map=self.feature_map,
            max_duration=entry["max_duration"],
            name=str(entry["name"]),
        )

    def _bound(self, option: Option) -> Option:
        if isinstance(option, SubgoalOption) and self.feature_map is not None:
            return option.bind(self.feature_map)
        return option

    def _put(self, slot: int, option: Option | None) -> None:
        self._slots[slot] = option
        self.filled = tuple(i for i, present in enumerate(self._slots) if present is not None)

    def __getstate__(self) -> dict[str, Any]:
        # Functions may not travel between processes; whoever receives the bank has a feature map of its own.
        return {**self.__dict__, "feature_map": None}

    def _check_slot(self, slot: int) -> None:
        if not 0 <= slot < self.max_options:
            raise ValueError(f"slot must be between 0 and {self.max_options - 1}, got {slot}.")


def _digest(about: str, tensors: dict[str, Any]) -> str:
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
