"""Which feature map φ an environment gets if its user names none."""

import copy
import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_options.checked import given_as
from sb3_options.density.groups import FeatureGroup, checked_groups
from sb3_options.embedding.encoders import ObservationForm, form_of_array
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.embedding.settings import LEARNED, MapName
from sb3_options.experience import observations as obs_batch
from sb3_options.experience.observations import FeatureMap, FloatArray, IntArray, Observations
from sb3_options.options.file import SpaceSignature

MAX_FEATURES = 4096  # in spaces with more dimensions, such as images, distances mean nothing
NUMBERS = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)  # SB3 takes them, also in a ``Dict``

FeatureKind = Literal["given", "environment", "categorical", "identity", "temporal-distance"]
"""Where a feature map comes from: the user, the environment, one-hot codes, flat observations, or learning."""


class Features(NamedTuple):
    """A feature map φ and where it comes from."""

    map: FeatureMap
    size: int | None  # dimensions d; None if φ refuses a made-up observation, until there is a real one
    kind: FeatureKind
    groups: tuple[FeatureGroup, ...] = ()  # features that make a concept together; empty if all do


def _one_hot(numbers: IntArray, observations: Observations) -> FloatArray:
    return np.asarray(np.asarray(observations).reshape(-1, 1) == numbers, dtype=np.float64)


def of_space(
    space: gym.Space[Any], feature_map: FeatureMap | MapName | None, own: FeatureMap | None
) -> Features | None:
    """Return the feature map to use: the given one, else the environment's ``own``, else one that fits its space.

    Return None if there is no sensible default (``Dict`` and other composite spaces, images).
    """
    if isinstance(feature_map, str) and feature_map == LEARNED:
        feature_map = LearnedMap(form_of(space))
    if isinstance(feature_map, LearnedMap):
        return Features(feature_map, feature_map.size, feature_map.name)
    if feature_map is not None:
        if not callable(feature_map):
            raise TypeError(
                "feature_map must be a function from a batch of observations to features (batch, d), or "
                f"{LEARNED!r}, got {feature_map!r:.100}."
            )
        size = _size_of(feature_map, space, "feature_map")
        return Features(feature_map, size, "given", _groups(getattr(feature_map, "concept_groups", None), size))
    if own is not None:
        # The wrapper that has φ: another wrapper beneath may name groups of other features.
        owner = getattr(own, "__self__", None)
        _check_seen(owner, space)
        size = _size_of(own, space, "the environment's concept_features")
        return Features(own, size, "environment", _groups(getattr(owner, "concept_groups", None), size))
    if isinstance(space, spaces.Discrete) and space.n <= MAX_FEATURES:
        numbers = np.arange(space.start, space.start + space.n)
        return Features(partial(_one_hot, numbers), int(space.n), "categorical")
    if isinstance(space, spaces.Box | spaces.MultiBinary | spaces.MultiDiscrete):
        size = int(np.prod(space.shape))
        if size <= MAX_FEATURES:
            return Features(obs_batch.flatten, size, "identity")
    return None


def _check_seen(owner: Any, space: spaces.Space[Any]) -> None:
    """Refuse φ of an environment whose observations a wrapper has changed: φ would misread them."""
    of_owner = getattr(owner, "observation_space", space)
    if of_owner != space:
        raise ValueError(
            f"concept_features of {type(owner).__name__} is for its own observations, {_described(of_owner)}, but a "
            f"wrapper beneath OptionsWrapper makes {_described(space)} of them: leave that wrapper out, or pass "
            "OptionsWrapper(env, feature_map=...) a function from a batch of these observations to features (batch, d)."
        )


def form_of(space: gym.Space[Any]) -> ObservationForm:
    """Return the form of an observation space, for the network of a learned map."""
    if isinstance(space, spaces.Discrete):
        return ObservationForm("table", (int(space.n),), int(space.start))
    if isinstance(space, spaces.Box):
        return form_of_array(space.shape, space.dtype)
    return ObservationForm("vector", (flat_size(space),))


def _groups(named: Callable[[], Iterable[Mapping[str, Any]]] | None, size: int | None) -> tuple[FeatureGroup, ...]:
    """Return the groups that a ``concept_groups`` names, if there is one."""
    groups = () if named is None else tuple(given_as(FeatureGroup, group) for group in named())
    return groups if size is None else checked_groups(groups, size)


def flat_size(space: gym.Space[Any]) -> int:
    """Return the length of one flat observation of ``space`` (`observations.flatten`)."""
    parts = space.spaces if isinstance(space, spaces.Dict) else {"observation": space}
    others = [f"{name}: {_described(part)}" for name, part in parts.items() if not isinstance(part, NUMBERS)]
    if others:
        raise ValueError(
            f"Stable-Baselines3 cannot learn from these observations ({', '.join(others)}). Beneath OptionsWrapper, "
            "leave them out by gymnasium.wrappers.FilterObservation(env, keys), or make Tuple and nested spaces one "
            "array by gymnasium.wrappers.FlattenObservation(env). For MiniGrid, use "
            "sb3_options.envs.minigrid.MiniGridWrapper."
        )
    return int(obs_batch.flatten(_sample(space)).shape[1])


def _sample(space: gym.Space[Any]) -> Observations:
    # From a copy: the environment's own space must draw the same samples as without us.
    space = copy.deepcopy(space)
    space.seed(0)
    return obs_batch.batch_of_one(space.sample())


def _size_of(feature_map: FeatureMap, space: gym.Space[Any], name: str) -> int | None:
    sample = _sample(space)
    try:
        feature_map(sample)
    except Exception:
        # A random element of the space need not be an observation (random pixels show no agent), and a user's function
        # may raise anything then. The first observation of an episode reveals the size.
        return None
    return checked_size(feature_map, sample, name)


def checked_size(feature_map: FeatureMap, one: Observations, name: str = "feature_map") -> int:
    """Return the dimensions d of a feature map, after checking it on ``one`` observation and on two."""
    features = np.asarray(feature_map(one))
    two = np.asarray(feature_map(obs_batch.concatenate([one, one])))
    d = features.shape[-1] if features.ndim else 0
    if d == 0 or features.shape != (1, d) or two.shape != (2, d) or features.dtype.kind not in "biufO":
        raise ValueError(
            f"{name} must return real numbers of shape (batch, d), d ≥ 1; it gave {features.dtype} of shape "
            f"{features.shape} for one observation and {two.shape} for two."
        )
    return int(d)


def signature(space: gym.Space[Any], features: Features | None) -> SpaceSignature:
    """Return the description of the observations that an options file holds."""
    sha256 = hashlib.sha256()
    for part in _parts(space, ""):
        sha256.update(part + b"\n")
    return SpaceSignature(_described(space), sha256.hexdigest(), None if features is None else features.kind)


def _described(space: gym.Space[Any]) -> str:
    """Return a description of a space in one line that is short enough for an error."""
    text = " ".join(str(space).split())
    return text if len(text) <= 200 else text[:200] + "…"


def _parts(space: gym.Space[Any], name: str) -> Iterator[bytes]:
    """Yield all properties in which two spaces can differ, part by part."""
    if isinstance(space, spaces.Dict):
        yield f"{name} Dict {sorted(space.spaces)}".encode()
        for key in sorted(space.spaces):
            yield from _parts(space[key], f"{name}.{key}")
    elif isinstance(space, spaces.Tuple):
        yield f"{name} Tuple {len(space.spaces)}".encode()
        for i, part in enumerate(space.spaces):
            yield from _parts(part, f"{name}.{i}")
    elif isinstance(space, spaces.Box):
        yield f"{name} Box {space.shape} {space.dtype}".encode()
        yield space.low.tobytes() + space.high.tobytes()
    elif isinstance(space, spaces.MultiDiscrete):
        # Not its text: numpy leaves out the middle of a long array there.
        yield f"{name} MultiDiscrete {space.dtype} {space.nvec.tolist()} {space.start.tolist()}".encode()
    else:
        yield f"{name} {space}".encode()
