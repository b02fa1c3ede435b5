"""What an options file says of the observations it was made for, and where it is taken at its word."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_options import OptionBank, OptionsWrapper
from sb3_options.envs import FOUR_ROOMS
from sb3_options.experience.observations import flatten
from sb3_options.options.file import SpaceSignature, check_signature
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import PolicyInput, TabularPolicy
from tests.support.helpers import ball, steady_option


def grid(env_id: str = "TwoRooms", *, feature_map: Any = None, **kwargs: Any) -> OptionsWrapper:
    """A gridworld with coordinates for observations, and slots."""
    env = gym.make(f"sb3_options/{env_id}-v0", **{"observation": "xy", **kwargs})
    return OptionsWrapper(env, feature_map=feature_map)


def option(policy_input: PolicyInput = "observation", size: int = 2) -> SubgoalOption:
    policy = TabularPolicy(np.zeros((1, size)), np.eye(4)[3:])
    return SubgoalOption(ball(10.0, 5.0), ball(2.0, 5.0, radius=8.0), policy, policy_input=policy_input)


def saved(env: OptionsWrapper, path: Path, policy_input: PolicyInput = "observation") -> Path:
    """The file of ``env`` with one option."""
    size = 2 if policy_input == "features" else flatten(env.observation_space.sample()[None]).shape[1]
    env.bank.add(option(policy_input, size))
    env.bank.save(path)
    return path


class TestOtherObservations:
    def test_coordinates_of_other_rooms(self, tmp_path: Path) -> None:
        path, other = saved(grid(), tmp_path / "options"), grid("FourRooms")
        with pytest.raises(ValueError, match=r"made for observations Box\(.+, this task's are Box\(0.0, 12.0, \(2,\)"):
            other.bank.load(path)
        assert len(other.bank) == 0

    @pytest.mark.parametrize("observation", ["xy", "onehot"])
    def test_a_moved_goal_is_no_other_observation(self, observation: str, tmp_path: Path) -> None:
        path = saved(grid(observation=observation), tmp_path / "options")
        moved = grid(observation=observation, goal=(18, 1), success_probability=0.8)
        moved.bank.load(path)
        assert moved.bank.filled == (0,)

    def test_policies_of_features_do_not_mind(self, tmp_path: Path) -> None:
        path = saved(grid(), tmp_path / "options", "features")
        other = grid(map=FOUR_ROOMS, observation="onehot")
        other.bank.load(path)
        assert other.bank.filled == (0,)


class TestOtherFeatures:
    def test_of_another_kind(self, tmp_path: Path) -> None:
        path = saved(grid(feature_map=lambda obs: obs[:, ::-1]), tmp_path / "options", "features")
        other = grid()
        with pytest.raises(ValueError, match=r"of a feature_map that was passed, this task's in the environment's own"):
            other.bank.load(path)

    def test_a_map_that_was_given_is_meant(self, tmp_path: Path) -> None:
        path = saved(grid(), tmp_path / "options")
        other = grid(feature_map=flatten)
        other.bank.load(path)
        assert other.bank.filled == (0,)

    def test_a_learned_one_is_in_the_file(self) -> None:
        name = "temporal-distance"
        there, here = (SpaceSignature("Box", "0", features) for features in (name, "given"))
        with pytest.raises(ValueError, match=rf'with, OptionsWrapper\(env, feature_map="{name}"\)$'):
            check_signature(there, here, {"features"})
        check_signature(there, there, {"features"})

    def test_a_file_without_discovered_options_fits_everywhere(self, tmp_path: Path) -> None:
        bank = grid().bank
        bank.add(steady_option())
        bank.save(tmp_path / "hand_made")
        other = grid("FourRooms", feature_map=None, observation="image")
        other.bank.add(steady_option())
        other.bank.load(tmp_path / "hand_made")
        assert other.bank.filled == (0,)


def test_the_same_options_are_the_same_bytes() -> None:
    bank = OptionBank(4, 4)
    bank.add(option("features"))
    assert len({bank.content() for _ in range(20)}) == 1
    again = OptionBank(4, 4)
    again.load(bank.content())
    assert again.content() == bank.content()
