"""`MiniGridWrapper`: MiniGrid's observations as one vector of zeros and ones, with their φ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.utils import RecordConstructorArgs

from sb3_options.envs.minigrid.cells import COLOURS, DEPTH, OBJECTS, STATES
from sb3_options.envs.minigrid.instructions import Instructions
from sb3_options.envs.minigrid.missions import Missions, things_of
from sb3_options.envs.minigrid.retina import (
    MOST_ASKED,
    OBJECT_FACTOR,
    concept_groups,
    feature_names,
    retina,
    retina_of_codes,
    retina_of_one,
)
from sb3_options.envs.minigrid.view import see_quickly

# Wrappers of MiniGrid whose images are not the agent's view, cell by cell.
OTHER_IMAGES = (
    "FullyObsWrapper", "OneHotPartialObsWrapper", "RGBImgObsWrapper", "RGBImgPartialObsWrapper", "SymbolicObsWrapper",
)  # fmt: skip
# Wrappers of MiniGrid that add a bonus to rewards, so that a death may end with a positive reward.
OTHER_REWARDS = ("ActionBonus", "PositionBonus")

Vector = npt.NDArray[np.uint8]


class MiniGridWrapper(
    gym.ObservationWrapper[Vector, Any, dict[str, Any]],
    RecordConstructorArgs,
):
    """Prepares a MiniGrid environment for Stable-Baselines3 and `OptionsWrapper`.

    The observation is one vector of zeros and ones, for an ``MlpPolicy``. It holds the one-hot object, colour and state
    of every cell in view, and the variable words of the mission, if any (a colour, say). `concept_features` is the
    retina, and `concept_groups` says which of its features belong together. At the end of an episode
    ``info["is_success"]`` says whether it ended with a positive reward. Observations are computed faster than by
    MiniGrid (`see_quickly`).

    Wrap the environment from ``gymnasium.make`` directly.

    Args:
        env: A MiniGrid environment; its observations have an ``image`` (v, v, 3) and a ``mission``.
        mission: Whether the observation includes the words of the mission. Without them a model can continue in a task
            with other missions.
        asked: Whether φ locates the things that the mission names by colour, such as "the red ball". Without the words
            of the mission these features are 0.

    Attributes:
        feature_names: Names of the features of φ, in order.

    Raises:
        TypeError: ``env`` has other observations, or a wrapper beneath changes its rewards.
        ValueError: Its missions cannot be listed, or are too many.
    """

    def __init__(self, env: gym.Env[Any, Any], *, mission: bool = True, asked: bool = True) -> None:
        RecordConstructorArgs.__init__(self, mission=mission, asked=asked)
        gym.ObservationWrapper.__init__(self, env)
        space: Any = env.observation_space
        self._view = _view_of(env)
        _check_rewards(env)
        from minigrid.envs.babyai.core.roomgrid_level import BabyAIMissionSpace  # here, because it may be missing

        missions = space["mission"] if mission and "mission" in space.spaces else None
        self._missions = Instructions() if isinstance(missions, BabyAIMissionSpace) else Missions(missions)
        self._n_asked = self._missions.n_things if asked else 0
        self.feature_names = feature_names(MOST_ASKED if asked else 0)
        see_quickly(env.unwrapped)
        self._n_cells = self._view**2 * DEPTH
        n_numbers = self._n_cells + self._missions.n_words
        self.observation_space: gym.Space[Any] = gym.spaces.Box(0, 1, (n_numbers,), np.uint8)

    def observation(self, observation: dict[str, Any]) -> Vector:
        """Return the vector of an observation."""
        cells = self.vectors(np.asarray(observation["image"]))
        if not self._missions.n_words:
            return cells
        words = self._missions.code(observation["mission"])
        if words is None:
            raise ValueError(
                f"The words of the mission {observation['mission']!r} of {self.unwrapped} are unknown. Leave them out "
                "by mission=False, with train.py --env-kwargs mission:False."
            )
        return np.concatenate([cells, words])

    def vectors(self, images: npt.NDArray[np.uint8]) -> Vector:
        """Return the observations (..., n) of images (..., v, v, 3), without the words of missions."""
        cells = np.concatenate([_EYES[i][images[..., i]] for i in range(3)], axis=-1)
        return cells.reshape(*images.shape[:-3], self._n_cells)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Vector, dict[str, Any]]:
        """Reset the environment."""
        try:
            return super().reset(seed=seed, options=options)
        except FileNotFoundError as error:
            raise FileNotFoundError(
                f"{self.spec.id if self.spec else self.unwrapped} cannot be made: the package minigrid lacks its file "
                f"{error.filename or error}. Choose another task, or install minigrid from its repository."
            ) from error

    def step(self, action: Any) -> tuple[Vector, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the environment, and add ``is_success`` at the end of an episode."""
        observation, reward, terminated, truncated, info = super().step(action)
        if terminated or truncated:
            info = {**info, "is_success": terminated and float(reward) > 0}
        return observation, reward, terminated, truncated, info

    def images(self, observations: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        """Return the images (batch, v, v, 3) of a batch of observations (batch, n)."""
        return _images(np.asarray(observations, dtype=np.uint8)[:, : self._n_cells], self._view)

    def concept_features(self, observations: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """Return φ of a batch of observations: the `retina` of their images and up to three things of the mission.

        Returns:
            (batch, 36); (batch, 27) without ``asked``. Features of things that no mission of the task names are 0.
        """
        observations = np.asarray(observations, dtype=np.uint8)
        n = self._n_cells
        missions = self._missions
        named = [missions.things_in(words.tobytes()) for words in observations[:, n:]] if self._n_asked else []
        if len(observations) != 1:
            return _features(observations[:, :n], named, self._view, len(self.feature_names))
        cells = observations[0, :n].tobytes()
        return _features_of_one(cells, tuple(named), self._view, len(self.feature_names)).copy()

    def concept_groups(self) -> list[dict[str, Any]]:
        """Return which features of φ make a concept together."""
        return concept_groups(self._n_asked)


# Object, colour and state for each position of a cell's code, which is one-hot in each of the three. It is in floating
# point, because numpy multiplies integer matrices without BLAS, which takes three times as long.
_WORTH = np.zeros((DEPTH, 3), dtype=np.float32)
for _channel, _n, _first in ((0, OBJECTS, 0), (1, COLOURS, OBJECTS), (2, STATES, OBJECTS + COLOURS)):
    _WORTH[_first : _first + _n, _channel] = np.arange(_n)
_CODE = _WORTH @ np.array([OBJECT_FACTOR, 0, 1], dtype=np.float32)  # what each adds to the code of a cell


def _images(cells: npt.NDArray[np.uint8], view: int) -> npt.NDArray[np.uint8]:
    """Return the images (batch, v, v, 3) of cells (batch, v·v·21)."""
    return (cells.reshape(-1, DEPTH).astype(np.float32) @ _WORTH).astype(np.uint8).reshape(-1, view, view, 3)


def _features(cells: npt.NDArray[np.uint8], named: Sequence[bytes], view: int, size: int) -> npt.NDArray[np.float64]:
    """Return φ (batch, size) of cells (batch, v·v·21) and things that missions name, which may be empty."""
    if named:
        seen = retina(_images(cells, view), things_of(named))
    else:
        codes = (cells.reshape(-1, DEPTH).astype(np.float32) @ _CODE).astype(np.intp)
        seen = retina_of_codes(codes.reshape(len(cells), view * view), view)
    return np.pad(seen, ((0, 0), (0, size - seen.shape[1])))


@lru_cache(maxsize=1 << 14)
def _features_of_one(cells: bytes, named: tuple[bytes, ...], view: int, size: int) -> npt.NDArray[np.float64]:
    """Return `_features` of one observation, cached: parallel environments often see the same."""
    n_cells = view * view
    if cells.count(1) != 3 * n_cells or cells.count(0) != (DEPTH - 3) * n_cells:  # not of MiniGrid, such as a sample
        return _features(np.frombuffer(cells, np.uint8)[None], named, view, size)
    return retina_of_one(cells, view, size, things_of(named)[0].tolist() if named else ())


_EYES = tuple(np.eye(n, dtype=np.uint8) for n in (OBJECTS, COLOURS, STATES))


def _view_of(env: gym.Env[Any, Any]) -> int:
    """Return the width of the agent's view in cells."""
    space = env.observation_space
    shape = space["image"].shape if isinstance(space, gym.spaces.Dict) and "image" in space.spaces else None
    own = shape is not None and len(shape) == 3 and shape[0] == shape[1] and shape[0] % 2 == 1 and shape[2] == 3
    others = [name for name in (type(each).__name__ for each in _wrappers(env)) if name in OTHER_IMAGES]
    if others or not own:
        instead = f"what {others[0]} shows instead" if others else str(space)
        raise TypeError(
            "MiniGridWrapper needs observations of MiniGrid, a Dict with a mission and an image (v, v, 3) of what the "
            f"agent sees, v odd, got {instead}. Put it right around gymnasium.make(...), beneath other wrappers."
        )
    assert shape is not None  # an image
    return int(shape[0])


def _check_rewards(env: gym.Env[Any, Any]) -> None:
    """Refuse rewards that are not the environment's own, because they define success."""
    for each in _wrappers(env):
        name = type(each).__name__
        if isinstance(each, gym.RewardWrapper) or name in OTHER_REWARDS:
            raise TypeError(
                "MiniGridWrapper needs the rewards of MiniGrid, for an episode that ends with one above 0 is a "
                f"success, got those of {name}. Put {name} above it: {name}(MiniGridWrapper(gymnasium.make(...)), ...)."
            )


def _wrappers(env: gym.Env[Any, Any]) -> Iterator[gym.Wrapper[Any, Any, Any, Any]]:
    """Iterate over the wrappers of an environment, outermost first."""
    while isinstance(env, gym.Wrapper):
        yield env
        env = env.env
