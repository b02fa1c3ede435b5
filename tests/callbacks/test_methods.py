"""`SubgoalDiscoveryCallback` with a method other than diverse density: an option is made, used and drawn."""

from pathlib import Path

import gymnasium as gym
import numpy as np
from stable_baselines3 import DQN

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.density.regions import Region
from sb3_options.discovery.figures import map_figure
from sb3_options.discovery.methods import Experience
from sb3_options.learning.macro_q import MacroQ

DOORWAY = np.array([10.0, 5.0])


class AtTheDoorway:
    """A user's own method."""

    def update(self, experience: Experience) -> list[Region]:
        return [experience.region(DOORWAY)] if experience.success else []


def test_an_option_is_made_of_what_a_method_proposes(tmp_path: Path) -> None:
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"), 4, gamma=0.97)
    callback = SubgoalDiscoveryCallback(method=AtTheDoorway(), max_new_options=1)
    callback.save_path = tmp_path / "options.safetensors"
    model = DQN(
        "MlpPolicy",
        env,
        gamma=0.97,
        replay_buffer_class=OptionReplayBuffer,
        learning_starts=5_000,
        buffer_size=5_000,
        tensorboard_log=str(tmp_path),
        seed=0,
        device="cpu",
    )
    model.learn(5_000, callback=callback)
    (found,) = callback.discoveries
    assert np.abs(found.subgoal - DOORWAY).sum() <= 1
    assert np.isnan(found.log_density)
    assert callback.discovery is not None
    assert map_figure(callback.discovery, callback.bank) is not None
    fresh = OptionsWrapper(
        gym.make("sb3_options/TwoRooms-v0"), 4, gamma=0.97, options_file=tmp_path / "options.safetensors"
    )
    assert len(fresh.bank) == 1


def test_methods_are_told_of_failures_whatever_bags_there_are() -> None:
    class Counting:
        told = 0

        def update(self, experience: Experience) -> list[Region]:
            del experience
            self.told += 1
            return []

    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", max_episode_steps=20), 1, gamma=0.97)
    callback = SubgoalDiscoveryCallback({"negative_strength": 0}, method=(method := Counting()))
    MacroQ(env, gamma=0.97, seed=0).learn(200, callback=callback)
    assert method.told == callback.episodes >= 10
