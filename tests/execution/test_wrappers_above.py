"""What may stand above `OptionsWrapper`: refused before training starts, in this process and in another."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback
from tests.support.helpers import CountingEnv, steady_option
from tests.support.sb3_helpers import ActionLog, make_optioned_rooms, optioned_rooms

Wrap = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]


class Shaped(gym.Wrapper[Any, Any, Any, Any]):
    """A user's own."""

    def step(self, action: Any) -> Any:
        observation, reward, *others = self.env.step(action)
        return observation, float(reward) - 0.01, *others


class Named(gym.Wrapper[Any, Any, Any, Any]):
    """A user's own, which leaves steps alone."""

    def name(self) -> str:
        return "mine"


def counting() -> OptionsWrapper:
    inner = CountingEnv(truncate_at=50)
    inner.observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)  # as after NormalizeObservation
    env = OptionsWrapper(inner, 2, gamma=0.9)
    env.bank.add(steady_option(1, max_duration=5))
    return env


def tenth(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return wrappers.TransformReward(env, lambda r: r / 10)  # type: ignore[operator]  # SupportsFloat


def limited(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return wrappers.TimeLimit(env, 10)


CHANGES: list[Wrap] = [tenth, limited, wrappers.NormalizeObservation, wrappers.NormalizeReward, Shaped]
KEEPS: list[Wrap] = [
    Monitor, wrappers.OrderEnforcing, wrappers.RecordEpisodeStatistics, Named,
    ActionLog, lambda env: ActionMasker(env, lambda e: e.get_wrapper_attr("action_masks")()),
]  # fmt: skip


@pytest.mark.parametrize("wrap", CHANGES)
@pytest.mark.parametrize("callback", [PrimitiveStepsCallback, SubgoalDiscoveryCallback])
def test_what_changes_steps_is_refused(wrap: Wrap, callback: Any) -> None:
    model = PPO("MlpPolicy", Named(wrap(counting())), n_steps=16, batch_size=16, gamma=0.9)
    text = r"^In <.+<OptionsWrapper<.+ above OptionsWrapper may change rewards, .+: put it beneath, for ins.+True\.$"
    with pytest.raises(ValueError, match=text):
        model.learn(16, callback=callback())


@pytest.mark.parametrize("wrap", KEEPS)
def test_what_leaves_them_alone_may_stay(wrap: Wrap) -> None:
    model = PPO("MlpPolicy", wrap(counting()), n_steps=16, batch_size=16, gamma=0.9)
    model.learn(16, callback=PrimitiveStepsCallback())
    assert model.num_timesteps >= 16


@pytest.mark.parametrize("wrap", CHANGES)
def test_beneath_it_may_stand(wrap: Wrap) -> None:
    env = OptionsWrapper(wrap(CountingEnv(truncate_at=50)), 2, gamma=0.9)
    PPO("MlpPolicy", env, n_steps=16, batch_size=16, gamma=0.9).learn(16, callback=PrimitiveStepsCallback())


def limited_rooms() -> gym.Env[Any, Any]:
    """What a worker process calls."""
    return limited(make_optioned_rooms())


@pytest.mark.parametrize("venv", [DummyVecEnv, SubprocVecEnv])
def test_one_of_several_environments_is_enough(venv: Any) -> None:
    env = venv([optioned_rooms, limited_rooms])
    model = DQN("MlpPolicy", env, gamma=0.9, replay_buffer_class=OptionReplayBuffer, buffer_size=100)
    with pytest.raises(ValueError, match=r"^In <TimeLimit<OptionsWrapper<.+ put it beneath"):
        model.learn(10, callback=SubgoalDiscoveryCallback())
    env.close()


def test_a_time_limit_beneath_counts_primitive_steps() -> None:
    """The remedy does what was meant: the option ends where the limit is met."""
    env = OptionsWrapper(limited(CountingEnv()), 1, gamma=0.9)
    env.bank.add(steady_option(1, max_duration=7))
    env.reset(seed=0)
    assert env.step(2)[4]["option"]["duration"] == 7
    *_, truncated, info = env.step(2)
    assert (truncated, info["option"]["duration"], info["option"]["termination"]) == (True, 3, "truncated")
    assert np.all(env.action_masks() == [True, True, True])
