"""`MiniGridWrapper`: observations of MiniGrid as one vector of zeros and ones, and φ of them."""

from __future__ import annotations

import itertools
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.utils import RecordConstructorArgs

from sb3_options.envs.minigrid.retina import FEATURES, concept_groups, retina
from sb3_options.envs.minigrid.view import see_quickly

OBJECTS, COLOURS, STATES = 11, 6, 4
"""How many values the three numbers of a cell take: objects, colours, and states of doors or directions of agents."""

DEPTH = OBJECTS + COLOURS + STATES

MAX_MISSIONS = 4096
"""Most missions of one environment that are told apart."""

Vector = npt.NDArray[np.uint8]


class MiniGridWrapper(
    gym.ObservationWrapper[Vector, Any, dict[str, Any]],
    RecordConstructorArgs,
):
    """Makes an environment of MiniGrid ready for Stable-Baselines3 and `OptionsWrapper`.

    The observation is one vector of zeros and ones, for an ``MlpPolicy``: of every cell in view its object, colour and
    state, one-hot, and of the mission its variable words, where it has any (a colour, say). `concept_features` is the
    retina, and `concept_groups` says which of its features belong together. At the end of an episode
    ``info["is_success"]`` says whether it ended with a reward above 0.

    Put it right around the environment that ``gymnasium.make`` gives.

    Args:
        env: An environment of MiniGrid; its observations have an ``image`` (v, v, 3) and a ``mission``.
        mission: Whether the words of the mission are in the observation. Without them a model can go on in a task whose
            missions are others.

    Raises:
        TypeError: ``env`` has other observations.
        ValueError: Its missions cannot be listed, because they are too many.
    """

    feature_names = FEATURES

    def __init__(self, env: gym.Env[Any, Any], *, mission: bool = True) -> None:
        RecordConstructorArgs.__init__(self, mission=mission)
        gym.ObservationWrapper.__init__(self, env)
        space = env.observation_space
        image = space["image"] if isinstance(space, gym.spaces.Dict) and "image" in space.spaces else None
        if not isinstance(space, gym.spaces.Dict) or image is None or image.shape is None or image.shape[2:] != (3,):
            raise TypeError(
                "MiniGridWrapper needs observations of MiniGrid, a Dict with an image (v, v, 3) and a mission, got "
                f"{space}. Put it right around gymnasium.make(...), beneath other wrappers."
            )
        self._view = int(image.shape[0])
        self._missions = _missions(space["mission"] if mission and "mission" in space.spaces else None)
        self._n_cells = self._view**2 * DEPTH
        n_words = len(next(iter(self._missions.values()), ()))
        self.observation_space: gym.Space[Any] = gym.spaces.Box(0, 1, (self._n_cells + n_words,), np.uint8)

    def observation(self, observation: dict[str, Any]) -> Vector:
        """The vector of an observation."""
        image = np.asarray(observation["image"])
        cells = np.concatenate([_EYES[i][image[..., i]] for i in range(3)], axis=-1).ravel()
        if not self._missions:
            return cells
        words = self._missions.get(observation["mission"])
        if words is None:
            raise ValueError(
                f"The mission {observation['mission']!r} is none that {self.unwrapped} lists. Leave it out by "
                "mission=False."
            )
        return np.concatenate([cells, words])

    def step(self, action: Any) -> tuple[Vector, SupportsFloat, bool, bool, dict[str, Any]]:
        """As the environment's, with ``is_success`` at the end of an episode."""
        observation, reward, terminated, truncated, info = super().step(action)
        if terminated or truncated:
            info = {**info, "is_success": terminated and float(reward) > 0}
        return observation, reward, terminated, truncated, info

    def images(self, observations: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        """The images (batch, v, v, 3) in a batch of observations (batch, n)."""
        flat = np.asarray(observations)[:, : self._n_cells].reshape(-1, self._view, self._view, DEPTH)
        ends = (OBJECTS, OBJECTS + COLOURS)
        parts = [part.argmax(axis=-1) for part in np.split(flat, ends, axis=-1)]
        return np.stack(parts, axis=-1).astype(np.uint8)

    def concept_features(self, observations: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """φ of a batch of observations: the `retina` of their images, (batch, 27)."""
        return retina(self.images(observations))

    def concept_groups(self) -> list[dict[str, Any]]:
        """Which features of φ make a concept together."""
        return concept_groups()


_EYES = tuple(np.eye(n, dtype=np.uint8) for n in (OBJECTS, COLOURS, STATES))


def _missions(space: Any) -> dict[str, Vector]:
    """The one-hot code of the variable words of every mission; empty where there is only one mission."""
    placeholders = getattr(space, "ordered_placeholders", None)
    if not placeholders:
        return {}
    words = [sorted(set(place)) for place in placeholders]
    n = int(np.prod([len(place) for place in words]))
    if n > MAX_MISSIONS:
        raise ValueError(f"The environment has {n} missions, at most {MAX_MISSIONS} can be told apart.")
    eyes = [np.eye(len(place), dtype=np.uint8) for place in words]
    return {
        space.mission_func(*chosen): np.concatenate(
            [eye[place.index(word)] for eye, place, word in zip(eyes, words, chosen, strict=True)]
        )
        for chosen in itertools.product(*words)
    }


def make(env_id: str, *, mission: bool = True, **kwargs: Any) -> MiniGridWrapper:
    """An environment of MiniGrid by its id, in a `MiniGridWrapper`. It computes what it sees quicker (`see_quickly`).

    Args:
        env_id: Such as ``MiniGrid-DoorKey-5x5-v0``.
        mission: As `MiniGridWrapper` has it.
        **kwargs: Of ``gymnasium.make``.

    Raises:
        ModuleNotFoundError: The package ``minigrid`` is not installed.
    """
    require()
    env = gym.make(env_id, **kwargs)
    see_quickly(env.unwrapped)
    return MiniGridWrapper(env, mission=mission)


def require() -> None:
    """Import ``minigrid``, which registers its environments.

    Raises:
        ModuleNotFoundError: It is not installed; the text names the extra.
    """
    try:
        import minigrid  # noqa: F401  # registers them
    except ModuleNotFoundError as error:
        if error.name != "minigrid":
            raise
        raise ModuleNotFoundError(
            'MiniGrid is not installed: pip install "sb3-options[minigrid]"', name="minigrid"
        ) from error
