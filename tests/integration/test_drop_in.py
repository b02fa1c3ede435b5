"""What a user pastes into a pipeline that exists already."""

from pathlib import Path

import gymnasium as gym

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.callbacks import SubgoalDiscoveryCallback


def test_six_lines(tmp_path: Path) -> None:
    from stable_baselines3 import DQN

    from sb3_options import OptionsWrapper

    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"), max_options=4, gamma=0.99)
    model = DQN("MlpPolicy", env, gamma=0.99, tensorboard_log=str(tmp_path / "runs"))
    callback = SubgoalDiscoveryCallback()
    model.learn(800, callback=callback)
    assert model.num_timesteps == 800
    assert list((tmp_path / "runs").rglob("events.out.tfevents.*"))
