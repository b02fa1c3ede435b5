"""What may stand above `OptionsWrapper`: refused before training starts, in this process and in another."""

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import EvalCallback
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


CHANGES: list[Wrap] = [
    lambda env: wrappers.TransformReward(env, lambda r: r / 10),  # type: ignore[operator]  # SupportsFloat
    lambda env: wrappers.TimeLimit(env, 10), wrappers.NormalizeObservation, wrappers.NormalizeReward, Shaped,
]  # fmt: skip
KEEPS: list[Wrap] = [
    Monitor, wrappers.OrderEnforcing, wrappers.RecordEpisodeStatistics, Named,
    ActionLog, lambda env: ActionMasker(env, lambda e: e.get_wrapper_attr("action_masks")()),
]  # fmt: skip


@pytest.mark.parametrize("wrap", CHANGES)
@pytest.mark.parametrize("callback", [PrimitiveStepsCallback, SubgoalDiscoveryCallback])
def test_what_changes_steps_is_refused(wrap: Wrap, callback: Any) -> None:
    model = PPO("MlpPolicy", Named(wrap(counting())), n_steps=16, batch_size=16, gamma=0.9)
    text = "above OptionsWrapper may change rewards, observations or episode ends, .*: put it beneath"
    with pytest.raises(ValueError, match=text):
        model.learn(16, callback=callback())


@pytest.mark.parametrize("wrap", KEEPS)
def test_what_leaves_them_alone_may_stay(wrap: Wrap) -> None:
    model = PPO("MlpPolicy", wrap(counting()), n_steps=16, batch_size=16, gamma=0.9)
    model.learn(16, callback=PrimitiveStepsCallback())
    assert model.num_timesteps >= 16


def limited_rooms() -> gym.Env[Any, Any]:
    """What a worker process calls."""
    return wrappers.TimeLimit(make_optioned_rooms(), 10)


@pytest.mark.parametrize("venv", [DummyVecEnv, partial(SubprocVecEnv, start_method="fork")])
def test_one_of_several_environments_is_enough(venv: Any) -> None:
    env = venv([optioned_rooms, limited_rooms])
    model = DQN("MlpPolicy", env, gamma=0.9, replay_buffer_class=OptionReplayBuffer, buffer_size=100)
    with pytest.raises(ValueError, match=r"^(Patched)?TimeLimit above OptionsWrapper"):
        model.learn(10, callback=SubgoalDiscoveryCallback())
    env.close()


@pytest.mark.parametrize("callback", [PrimitiveStepsCallback, lambda: SubgoalDiscoveryCallback(max_new_options=0)])
def test_an_evaluation_beside_a_callback_counts_primitive_steps(callback: Any) -> None:
    """The option is all that the policy chooses."""
    monitor: Any = Monitor(counting())
    evaluation = EvalCallback(monitor, eval_freq=8, n_eval_episodes=1, verbose=0)
    model: Any = PPO("MlpPolicy", counting(), n_steps=16, batch_size=16, gamma=0.9)
    with torch.no_grad():
        model.policy.action_net.bias[2] += 1e3
    model.learn(80, callback=[callback(), evaluation])
    assert evaluation.last_mean_reward == sum(range(1, 51))
    assert set(monitor.get_episode_lengths()) == {50}
