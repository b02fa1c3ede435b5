"""A concept space that reads the environment or its infos."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO

from sb3_options import ConceptsInObservation, OptionsWrapper, WithoutConcepts
from sb3_options.callbacks import SubgoalDiscoveryCallback
from tests.support.sb3_helpers import DOORWAY, FAST_DISCOVERY, Corridor, small_rooms


class Blind(gym.Wrapper[Any, Any, Any, Any]):
    """Rooms in which the agent sees how many steps it took; its place stands in ``info``."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = spaces.Box(0.0, np.inf, (1,), np.float32)
        self.place = np.zeros(2)

    def reset(self, **kwargs: Any) -> Any:
        self.place, info = self.env.reset(**kwargs)
        self.steps = 0
        return np.zeros(1, np.float32), {**info, "place": self.place}

    def step(self, action: Any) -> Any:
        self.place, *rest, info = self.env.step(action)
        self.steps += 1
        return np.full(1, self.steps, np.float32), *rest, {**info, "place": self.place}


def blind_rooms() -> gym.Env[Any, Any]:
    return Blind(small_rooms(observation="xy"))


def from_info(env: gym.Env[Any, Any], info: dict[str, Any]) -> Any:
    return info["place"]


def from_env(env: gym.Env[Any, Any], info: dict[str, Any]) -> Any:
    return env.get_wrapper_attr("place")


def test_discovers_a_doorway_that_no_observation_shows() -> None:
    env = OptionsWrapper(ConceptsInObservation(blind_rooms(), from_info, size=2), max_options=1, gamma=0.9)
    policy: dict[str, Any] = {"features_extractor_class": WithoutConcepts}
    model = PPO("MultiInputPolicy", env, gamma=0.9, n_steps=256, seed=0, ent_coef=0.1, policy_kwargs=policy)
    callback = SubgoalDiscoveryCallback(FAST_DISCOVERY, {"policy_input": "features"}, max_new_options=1)
    model.learn(1_500, callback=callback)
    assert [np.abs(found.subgoal - DOORWAY).max() <= 1 for found in callback.discoveries] == [True]


@pytest.mark.parametrize("source", [from_info, from_env])
def test_reads_infos_or_the_environment(source: Any) -> None:
    inner = blind_rooms()
    env = ConceptsInObservation(inner, source, size=2)
    env.reset(seed=0)
    observation, *_ = env.step(0)
    np.testing.assert_array_equal(observation["concepts"], inner.get_wrapper_attr("place"))
    np.testing.assert_array_equal(observation["observation"], [1.0])


def test_the_network_need_not_see_the_concepts() -> None:
    space = ConceptsInObservation(blind_rooms(), from_info, size=2).observation_space
    assert isinstance(space, spaces.Dict)
    extractor = WithoutConcepts(space)
    one = {"observation": torch.ones(1, 1), "concepts": torch.zeros(1, 2)}
    other = one | {"concepts": torch.ones(1, 2)}
    assert extractor.features_dim == 1
    assert torch.equal(extractor(one), extractor(other))


@pytest.mark.parametrize("inner", [blind_rooms, lambda: Corridor("dict")])
def test_concepts_are_one_more_part_of_the_observation(inner: Any) -> None:
    env = ConceptsInObservation(inner(), lambda *_: [7, -7], size=2)
    own = inner().observation_space
    parts = dict(own.spaces) if isinstance(own, spaces.Dict) else {"observation": own}
    assert env.observation_space == spaces.Dict(parts | {"concepts": spaces.Box(-np.inf, np.inf, (2,), np.float32)})
    assert env._saved_kwargs == {"concepts": env._concepts, "size": 2}
    for observation in (env.reset(seed=0)[0], env.step(0)[0]):
        assert env.observation_space.contains(observation)
        inside = {key: value for key, value in observation.items() if key != "concepts"}
        plain = inside if isinstance(own, spaces.Dict) else inside["observation"]
        assert own.contains(plain)
        features = env.concept_features({"concepts": observation["concepts"][None]})
        assert (features.tolist(), str(features.dtype)) == ([[7.0, -7.0]], "float64")


def test_concepts_are_copied() -> None:
    place = np.zeros(2, np.float32)
    env = ConceptsInObservation(blind_rooms(), lambda *_: place, size=2)
    observation, _ = env.reset(seed=0)
    place += 1
    np.testing.assert_array_equal(observation["concepts"], [0.0, 0.0])


@pytest.mark.parametrize(
    ("source", "size", "message"),
    [(from_info, 3, "must return 3 finite numbers"), (lambda *_: [0.0, np.nan], 2, "must return 2 finite numbers")],
)
def test_refuses_other_features(source: Any, size: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ConceptsInObservation(blind_rooms(), source, size=size).reset(seed=0)
