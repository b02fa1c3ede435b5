"""What a user pastes into a pipeline that exists already."""

from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import pytest
from stable_baselines3.common.env_util import make_vec_env

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.callbacks import SubgoalDiscoveryCallback
from tests.support.sb3_helpers import TAXI


def test_six_lines(tmp_path: Path) -> None:
    from stable_baselines3 import DQN

    from sb3_options import OptionReplayBuffer, OptionsWrapper

    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"), max_options=4, gamma=0.99)
    model = DQN(
        "MlpPolicy", env, gamma=0.99, replay_buffer_class=OptionReplayBuffer, tensorboard_log=str(tmp_path / "runs")
    )
    callback = SubgoalDiscoveryCallback()
    model.learn(800, callback=callback)
    assert model.num_timesteps == 800
    assert list((tmp_path / "runs").rglob("events.out.tfevents.*"))


@pytest.mark.filterwarnings("ignore:.*The environment Taxi-v3 is out of date")
@pytest.mark.parametrize("n_envs", [1, 4])
def test_taxi(n_envs: int) -> None:
    """An environment nobody here wrote: observations are numbers, and it does not say ``is_success``."""
    from stable_baselines3 import DQN

    from sb3_options import OptionReplayBuffer, OptionsWrapper

    env: Any = (
        OptionsWrapper(gym.make(TAXI), max_options=2, gamma=0.99)
        if n_envs == 1
        else make_vec_env(TAXI, n_envs, seed=0, wrapper_class=OptionsWrapper)
    )
    model = DQN(
        "MlpPolicy", env, gamma=0.99, replay_buffer_class=OptionReplayBuffer, seed=0, learning_starts=1000,
        train_freq=50, buffer_size=10_000, policy_kwargs={"net_arch": [16]}, exploration_initial_eps=1.0,
        exploration_final_eps=1.0,
    )  # fmt: skip
    # A random taxi never brings anybody anywhere, so its success is to get a long way from where it started.
    callback = SubgoalDiscoveryCallback(
        {
            "min_positive": 2,
            "decay": 0.5,
            "threshold": 0.4,
            "negative_bags": False,
        },
        success=lambda trajectory: len(trajectory.rewards) >= 50,
        max_new_options=1,
    )
    model.learn(6000, callback=callback)
    assert callback.episodes >= 20
    assert model.num_timesteps >= 6000
    assert len(callback.discoveries) == 1
    episodes = [e["l"] for e in cast("Any", model.ep_info_buffer)]
    assert max(episodes) == 200
