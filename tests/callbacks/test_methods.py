"""`SubgoalDiscoveryCallback` with a method other than diverse density: an option is made, used and drawn."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.discovery.figures import discovery_figures, subgoals_figure
from sb3_options.discovery.methods import DiscoveryMethod, Experience, MethodName, Proposal

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
    callback = SubgoalDiscoveryCallback(method=method, max_new_options=1, save_path=tmp_path / "options.safetensors")
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


def test_an_unknown_method() -> None:
    with pytest.raises(
        ValueError, match=r"^DiscoverySettings: method should be 'diverse-density', .*got 'betweeness'$"
    ):
        SubgoalDiscoveryCallback(method="betweeness")  # type: ignore[arg-type]
