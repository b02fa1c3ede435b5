"""The last action beside the observation."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation
from stable_baselines3.common.env_checker import check_env

from sb3_options import OptionsWrapper
from sb3_options.envs import LastActionObservation
from sb3_options.envs.minigrid import make
from sb3_options.execution import layers
from tests.support.helpers import equal
from tests.support.sb3_helpers import TAXI, small_rooms

RIGHT = 3


def test_the_last_primitive_action_follows_the_observation() -> None:
    inner = small_rooms()
    env = LastActionObservation(inner)
    check_env(env)
    first, _ = env.reset(seed=3)
    assert equal(first[:-4], inner.reset(seed=3)[0])
    assert not first[-4:].any()
    for action in (RIGHT, 0):
        seen, *_ = env.step(action)
        assert seen[-4:].tolist() == np.eye(4)[action].tolist()
        assert seen[:-4].sum() == 1
    assert not env.reset()[0][-4:].any()


def test_actions_are_counted_from_the_first() -> None:
    class FromFive(gym.Wrapper[Any, Any, Any, Any]):
        def __init__(self) -> None:
            super().__init__(small_rooms())
            self.action_space = spaces.Discrete(4, start=5)

        def step(self, action: Any) -> Any:
            return self.env.step(action - 5)

    env = LastActionObservation(FromFive())
    env.reset(seed=0)
    assert env.step(8)[0][-4:].tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize(
    "make_env", [small_rooms, lambda: make("BabyAI-KeyCorridorS3R3-v0"), lambda: FlattenObservation(gym.make(TAXI))]
)
def test_concept_features_are_those_of_the_environment(make_env: Any) -> None:
    inner = OptionsWrapper(make_env(), 2)
    env = OptionsWrapper(LastActionObservation(make_env()), 2)
    seen, remembered = (each.reset(seed=0)[0][None] for each in (inner, env))
    assert equal(env.concept_features(remembered), inner.concept_features(seen))
    assert env.traits.feature_groups == inner.traits.feature_groups
    assert env.traits.feature_size == inner.traits.feature_size


@pytest.mark.parametrize("env_id", [TAXI, "Pendulum-v1"])
def test_other_environments_are_refused(env_id: str) -> None:
    with pytest.raises(TypeError, match=r"Box of one dimension and Discrete actions.*FlattenObservation"):
        LastActionObservation(gym.make(env_id))


def test_an_episode_goes_on_with_the_action_that_it_remembers() -> None:
    env = LastActionObservation(small_rooms())
    env.reset(seed=0)
    env.step(RIGHT)
    states = layers.states_of(env)
    env.reset(seed=1)
    assert layers.states_of(env) != states
    assert layers.set_states(env, states) is None
    assert layers.states_of(env) == states
