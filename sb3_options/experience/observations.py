"""Batches of observations, as arrays or as dictionaries of arrays, and their way into concept space."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.integer[Any]]
BoolArray: TypeAlias = npt.NDArray[np.bool_]

Observations: TypeAlias = npt.NDArray[Any] | Mapping[str, npt.NDArray[Any]]
"""A batch: an array of shape (batch, ...), or one such array for each key of a ``Dict`` space."""

FeatureMap: TypeAlias = Callable[[Observations], FloatArray]
"""φ: a batch of observations → features in concept space, shape (batch, d)."""


def batch_size(observations: Observations) -> int:
    """Return the number of observations in a batch."""
    # The common case first: the check for a Mapping takes ten times as long.
    if isinstance(observations, np.ndarray) or not isinstance(observations, Mapping):
        return len(observations)
    return len(next(iter(observations.values())))


def _of_each(function: Callable[[npt.NDArray[Any]], Any], observation: Any) -> Any:
    """Apply a function to an array, or to each array of a dictionary."""
    if isinstance(observation, np.ndarray):
        return function(observation)
    if isinstance(observation, Mapping):
        return {key: function(np.asarray(value)) for key, value in observation.items()}
    return function(np.asarray(observation))


def batch_of_one(observation: Any) -> Observations:
    """Make one observation, as an environment returns it, a batch of shape (1, ...)."""
    batch: Observations = _of_each(lambda array: array[None], observation)
    return batch


def stack(observations: Sequence[Any]) -> Observations:
    """Make single observations one batch, in the same order."""
    if isinstance(observations[0], Mapping):
        return {key: np.stack([o[key] for o in observations]) for key in observations[0]}
    return np.array(observations)


def take(observations: Observations, indices: IntArray | Sequence[int] | slice | int) -> Any:
    """Return the observations at ``indices``, in that order, as a batch; at a single index one observation."""
    return _of_each(lambda array: array[indices], observations)


def singles(observations: Observations) -> list[Any]:
    """Return the single observations of a batch, the inverse of `stack`."""
    if isinstance(observations, Mapping):
        return [dict(zip(observations, row, strict=True)) for row in zip(*observations.values(), strict=True)]
    return list(observations)


def concatenate(batches: Sequence[Observations]) -> Observations:
    """Join several batches in order."""
    first = batches[0]
    if isinstance(first, Mapping):
        return {key: np.concatenate([cast("Mapping[str, Any]", b)[key] for b in batches]) for key in first}
    return np.concatenate(cast("Sequence[npt.NDArray[Any]]", batches))


def replaced(observations: Observations, rows: Sequence[int], others: Observations) -> Any:
    """Return a copy of a batch with other observations in some of its rows."""
    if isinstance(observations, Mapping):
        return {key: replaced(part, rows, np.asarray(others[key])) for key, part in observations.items()}
    copy = np.array(observations)
    copy[rows] = others
    return copy


def copy_of(observation: Any) -> Any:
    """Copy one observation: some environments write every observation into the same array."""
    return _of_each(np.array, observation)


def keys_of(observations: Observations) -> list[bytes]:
    """Return the `key_of` of each observation of a batch."""
    if isinstance(observations, Mapping):
        parts = [keys_of(np.asarray(observations[k])) for k in sorted(observations)]
        return [b"".join(of_one) for of_one in zip(*parts, strict=True)]
    size = math.prod(observations.shape[1:])
    if not size:
        return [b""] * len(observations)
    rows = np.ascontiguousarray(observations).reshape(len(observations), size)
    return rows.view(f"V{size * rows.itemsize}").ravel().tolist()


def key_of(observation: Any) -> bytes:
    """Return a key that two observations of one space share exactly if they are equal, bit for bit."""
    if isinstance(observation, np.ndarray):
        return observation.tobytes()
    if isinstance(observation, Mapping):
        return b"".join(np.asarray(observation[k]).tobytes() for k in sorted(observation))
    return np.asarray(observation).tobytes()


def flatten(observations: Observations) -> FloatArray:
    """Make every observation one row of float64: shape (batch, total size), keys in sorted order."""
    if isinstance(observations, Mapping):
        return np.concatenate([flatten(observations[key]) for key in sorted(observations)], axis=1)
    # Not -1 for the size: numpy cannot infer it for an empty batch.
    return np.asarray(observations, dtype=np.float64).reshape(len(observations), math.prod(observations.shape[1:]))
