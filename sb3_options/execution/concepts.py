"""`ConceptsInObservation`: a concept space made from the environment or ``info``, not from the agent's observation."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.torch_layers import CombinedExtractor

from sb3_options.experience.observations import FloatArray, Observations

CONCEPTS = "concepts"  # key of φ in the observations
OBSERVATION = "observation"  # key of an observation that was not a ``Dict``

Concepts = Callable[[gym.Env[Any, Any], dict[str, Any]], npt.ArrayLike]
"""Environment and the ``info`` of its last ``reset`` or ``step`` → features (d,)."""


class ConceptsInObservation(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Adds features that the observation does not show, and makes them the feature map φ.

    Discovery compares stored observations, so they have to hold all that φ reads. The observation becomes a ``Dict``
    with its former keys (or ``observation``) and ``concepts``. `OptionsWrapper` takes φ from there by itself. The
    network sees the concepts too, unless its features extractor is `WithoutConcepts`.

    Args:
        env: Any environment; this wrapper goes beneath `OptionsWrapper`.
        concepts: Returns φ of the present state, for instance ``lambda env, info: env.unwrapped.agent_pos`` or
            ``lambda env, info: info["position"]``. Called once a step.
        size: Dimensions d of φ, at least 1.

    Raises:
        ValueError: In ``reset`` or ``step``: ``concepts`` does not return d finite numbers.
    """

    def __init__(self, env: gym.Env[Any, Any], concepts: Concepts, size: int) -> None:
        RecordConstructorArgs.__init__(self, concepts=concepts, size=size)
        gym.Wrapper.__init__(self, env)
        inner = env.observation_space
        self._is_dict = isinstance(inner, spaces.Dict)
        parts = dict(inner.spaces) if isinstance(inner, spaces.Dict) else {OBSERVATION: inner}
        parts[CONCEPTS] = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.observation_space = spaces.Dict(parts)
        self._concepts = concepts
        self._size = size

    def reset(self, **kwargs: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(**kwargs)
        return self._with_concepts(observation, info), info

    def step(self, action: Any) -> tuple[dict[str, Any], Any, bool, bool, dict[str, Any]]:
        """Take one step of the environment."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._with_concepts(observation, info), reward, terminated, truncated, info

    def concept_features(self, observations: Observations) -> FloatArray:
        """Return φ of a batch of observations, (batch, d)."""
        return np.asarray(observations[CONCEPTS], dtype=np.float64)

    def _with_concepts(self, observation: Any, info: dict[str, Any]) -> dict[str, Any]:
        concepts = np.array(self._concepts(self.env, info), dtype=np.float32)  # a copy: the environment may reuse it
        if concepts.shape != (self._size,) or not np.isfinite(concepts).all():
            raise ValueError(f"concepts must return {self._size} finite numbers (size={self._size}), got {concepts}.")
        return {**(observation if self._is_dict else {OBSERVATION: observation}), CONCEPTS: concepts}


class WithoutConcepts(CombinedExtractor):
    """Features extractor for a policy that must not see the concepts.

    For ``policy_kwargs={"features_extractor_class": WithoutConcepts}``, with ``"MultiInputPolicy"``. ``kwargs`` are
    those of SB3's ``CombinedExtractor``.
    """

    def __init__(self, observation_space: spaces.Dict, **kwargs: Any) -> None:
        seen = {key: space for key, space in observation_space.spaces.items() if key != CONCEPTS}
        super().__init__(spaces.Dict(seen), **kwargs)
