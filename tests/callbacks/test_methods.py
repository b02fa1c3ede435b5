"""`SubgoalDiscoveryCallback` with a method other than diverse density: an option is made, used and drawn."""

from collections import Counter
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.density.regions import Region
from sb3_options.discovery.figures import discovery_figures, subgoals_figure
from sb3_options.discovery.methods import DiscoveryMethod, Experience, MethodName, Passage, Proposal
from sb3_options.discovery.methods.eigenoptions import Eigenoptions
from sb3_options.learning.macro_q import MacroQ
from sb3_options.options.option import SubgoalOption

DOORWAY = np.array([10.0, 5.0])


class AtTheDoorway:
    """A user's own method."""

    def update(self, experience: Experience) -> list[Proposal]:
        return [experience.region(DOORWAY)] if experience.success else []


@pytest.mark.parametrize(("method", "n_timesteps"), [(AtTheDoorway(), 8_000), ("betweenness", 45_000)])
def test_an_option_is_made_of_what_a_method_proposes(
    tmp_path: Path, method: MethodName | DiscoveryMethod, n_timesteps: int
) -> None:
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"), 4, gamma=0.97)
    callback = SubgoalDiscoveryCallback(method=method, max_new_options=1)
    callback.save_path = tmp_path / "options.safetensors"
    model = DQN(
        "MlpPolicy",
        env,
        gamma=0.97,
        replay_buffer_class=OptionReplayBuffer,
        learning_starts=45_000,
        buffer_size=45_000,
        tensorboard_log=str(tmp_path),
        seed=0,
        device="cpu",
    )
    model.learn(n_timesteps, callback=callback)
    (found,) = callback.discoveries
    assert np.abs(found.subgoal - DOORWAY).sum() <= 1
    assert np.isnan(found.log_density)
    assert callback.discovery is not None
    assert set(discovery_figures(callback.discovery, callback.bank)) == {
        "first_visits",
        "initiation_set",
        "option_policy",
    }
    assert subgoals_figure(callback.discovery, callback.bank).axes
    fresh = OptionsWrapper(
        gym.make("sb3_options/TwoRooms-v0"), 4, gamma=0.97, options_file=tmp_path / "options.safetensors"
    )
    assert len(fresh.bank) == 1


class FromTheFirstRoom:
    """A user's own method that proposes another kind of option than to reach a region."""

    def update(self, experience: Experience) -> list[Proposal]:
        room = Region(experience.features[experience.features[:, 0] < DOORWAY[0]], experience.scale, experience.radius)
        return [Passage(experience.region(DOORWAY), room)] if experience.success else []


@pytest.mark.parametrize("method", [Eigenoptions(min_trajectories=3), FromTheFirstRoom()], ids=["climbs", "passage"])
def test_options_of_other_kinds_run_to_their_ends(method: DiscoveryMethod) -> None:
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"), 2, gamma=0.97)
    settings = {"grow": True}  # of options that reach a region; these stay as they are
    callback = SubgoalDiscoveryCallback({"capacity": 20}, settings, method=method, max_new_options=1)
    model = MacroQ(env, gamma=0.97, seed=0)
    model.learn(9_000, callback=callback)
    (option,) = [option for option in callback.bank.slots if option is not None]
    assert isinstance(option, SubgoalOption)
    assert option.fixed
    ended = Counter()  # type: ignore[var-annotated]  # of how runs ended
    chosen = env.bank.n_primitive + callback.discoveries[0].slot
    env.reset(seed=1)
    for _ in range(300):
        may = env.action_masks()[chosen]
        _, _, terminated, truncated, info = env.step(chosen if may else int(env.np_random.integers(4)))
        if may:
            ended[info["option"]["termination"]] += 1
        if terminated or truncated:
            env.reset()
    assert ended["subgoal"] > 0.9 * ended.total() > 0
    if isinstance(method, FromTheFirstRoom):
        assert option.initiation_set.points[:, 0].max() < DOORWAY[0]


def test_methods_are_told_of_failures_whatever_bags_there_are() -> None:
    class Counting:
        told = 0

        def update(self, experience: Experience) -> list[Proposal]:
            del experience
            self.told += 1
            return []

    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", max_episode_steps=20), 1, gamma=0.97)
    callback = SubgoalDiscoveryCallback({"negative_bags": False}, method=(method := Counting()))
    MacroQ(env, gamma=0.97, seed=0).learn(200, callback=callback)
    assert method.told == callback.episodes >= 10
