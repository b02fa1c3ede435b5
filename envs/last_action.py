"""`LastActionObservation`: adds the last primitive action to the observation, as a short memory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

Vector = npt.NDArray[Any]


class LastActionObservation(gym.Wrapper[Vector, Any, Vector, Any], RecordConstructorArgs):
    """Appends the last primitive action to the observation, one-hot; zeros after a reset.

    If observations show only part of the state, a policy without memory does not know which way it was turning, and
    may turn back and forth. The last action tells it. The feature map φ is the inner environment's. So options whose
    policies act on features fit with and without this wrapper.

    Args:
        env: Environment with vector observations and discrete actions. This wrapper goes beneath `OptionsWrapper`.

    Raises:
        TypeError: The environment has other observations or actions.
        ValueError: Its ``concept_features`` are for observations that a wrapper has changed.
    """

    STATE = ("_last",)

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        seen, actions = env.observation_space, env.action_space
        if not (isinstance(seen, spaces.Box) and len(seen.shape) == 1 and isinstance(actions, spaces.Discrete)):
            raise TypeError(
                f"LastActionObservation needs observations in a Box of one dimension and Discrete actions, got {seen} "
                f"and {actions}: put gymnasium.wrappers.FlattenObservation beneath."
            )
        self._codes = np.eye(int(actions.n), dtype=seen.dtype)
        self._first = int(actions.start)
        self._n_seen = seen.shape[0]
        self._last: int | None = None
        own = env.get_wrapper_attr("concept_features") if env.has_wrapper_attr("concept_features") else None
        owner = getattr(own, "__self__", None)
        if getattr(owner, "observation_space", seen) != seen:
            raise ValueError(
                f"concept_features of {type(owner).__name__} is for its own observations, and a wrapper beneath "
                "LastActionObservation has changed them: leave that wrapper out, or put a concept_features above it."
            )
        self._own = own
        self._groups = getattr(owner, "concept_groups", None)
        low, high = (
            np.concatenate([bound, np.full(len(self._codes), end, dtype=seen.dtype)])
            for bound, end in ((seen.low, 0), (seen.high, 1))
        )
        self.observation_space = spaces.Box(low, high, dtype=seen.dtype.type)

    def reset(self, **kwargs: Any) -> tuple[Vector, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(**kwargs)
        self._last = None
        return self._with_action(observation), info

    def step(self, action: Any) -> tuple[Vector, Any, bool, bool, dict[str, Any]]:
        """Step the environment."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._last = int(action) - self._first
        return self._with_action(observation), reward, terminated, truncated, info

    def concept_features(self, observations: Vector) -> npt.NDArray[np.float64]:
        """Return φ of a batch of observations, (batch, d): the inner environment's φ, or its observations."""
        seen = np.asarray(observations)[:, : self._n_seen]
        return np.asarray(seen if self._own is None else self._own(seen), dtype=np.float64)

    def concept_groups(self) -> Iterable[Mapping[str, Any]]:
        """Return which features of φ make a concept together; empty if all do."""
        return () if self._groups is None else self._groups()

    def _with_action(self, observation: Vector) -> Vector:
        code = np.zeros(len(self._codes), self._codes.dtype) if self._last is None else self._codes[self._last]
        return np.concatenate([observation, code])
