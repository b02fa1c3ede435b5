"""What the slots of an environment hold, and what others ask and set."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import OptionsWrapper
from tests.options.banks import along_row_5
from tests.support.helpers import CountingEnv, equal, steady_option, table_option


def with_two_options() -> OptionsWrapper:
    env = OptionsWrapper(CountingEnv(), max_options=3)
    env.bank.add(table_option([1, 0, 1, 0, 1], [0] * 5, [0] * 5), 0)
    env.bank.add(table_option([0, 0, 1, 1, 1], [0] * 5, [0] * 5), 2)
    return env


def test_action_masks_follow_the_episode() -> None:
    env = with_two_options()
    env.reset(seed=0)
    masks = [env.action_masks()]
    for _ in range(3):
        env.step(0)
        masks.append(env.action_masks())
    np.testing.assert_array_equal(masks, env.available(np.arange(4.0)[:, None]))
    env.reset()
    assert equal(env.action_masks(), masks[0])
    env.bank.remove(0)
    assert env.action_masks().tolist() == [True, True, False, False, False]


def test_info_has_what_is_available_for_who_asks_once_there_are_options() -> None:
    env = with_two_options()
    env.reset(seed=0)
    assert "available" not in env.step(0)[4]["option"]
    env.set_slots(report_availability=True)
    env.reset(seed=0)
    assert env.step(0)[4]["option"]["available"].tolist() == [[False, False, False]]
    empty_slot = env.step(3)[4]["option"]
    assert (empty_slot["index"], empty_slot["available"].tolist()) == (-1, [[True, False, True]])
    for slot in (0, 2):
        env.set_option(slot, None)
    assert "available" not in env.step(0)[4]["option"]
    env.set_option(1, steady_option(max_duration=2))
    assert env.step(3)[4]["option"]["available"].tolist() == [[False, True, False]] * 2


def test_options_of_a_file_are_there_from_the_start(tmp_path: Path) -> None:
    path = tmp_path / "options.safetensors"
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"))
    env.bank.add(along_row_5(10.0, 0, 10, 3), 1)
    env.bank.save(path)
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", success_probability=1.0), options_file=str(path))
    assert env.bank.filled == (1,)
    env.reset(options={"start": (2, 5)})
    assert env.action_masks().tolist() == [True] * 4 + [False, True, False, False]
    observation, _, _, _, info = env.step(5)
    assert (info["option"]["duration"], info["option"]["termination"]) == (8, "subgoal")
    assert env.concept_features(observation[None]).tolist() == [[10.0, 5.0]]


@pytest.mark.parametrize(
    "space", [spaces.Box(-1.0, 1.0, (2,)), spaces.MultiDiscrete([2, 2]), spaces.Discrete(3, start=1)]
)
def test_action_space_must_be_discrete(space: Any) -> None:
    env = CountingEnv()
    env.action_space = space
    with pytest.raises(TypeError, match=r"^OptionsWrapper needs a Discrete action space that starts at 0, got"):
        OptionsWrapper(env)


def test_an_environment_of_the_old_gym_is_to_be_converted() -> None:
    with pytest.raises(TypeError, match=r"^OldEnv is no gymnasium\.Env\. Convert .+ shimmy\.GymV21CompatibilityV0"):
        OptionsWrapper(type("OldEnv", (), {"action_space": spaces.Discrete(2)})())


NO_FEATURES: list[Callable[[Any], Any]] = [
    lambda obs: np.zeros(len(obs)),
    lambda obs: np.zeros((2, 1)),
    lambda obs: 0.5,
    lambda obs: np.zeros((len(obs), 0)),
    lambda obs: np.full((len(obs), 1), "here"),
    lambda obs: np.zeros((len(obs), 1), complex),
    lambda obs: np.zeros((len(obs), len(obs))),
]


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("gamma", [0.0, -0.1, 1.0001, float("nan"), float("inf")], r"^gamma must be in \(0, 1\], got"),
        ("max_runs", [0, 1.5], "^max_runs must be a whole number, at least 1, .+ got"),
        ("feature_map", [3], r"^feature_map must be a function from a batch.+got 3\.$"),
        ("feature_map", NO_FEATURES, r"^feature_map must return real numbers of shape \(batch, d\), d ≥ 1; it gave"),
    ],
)
def test_arguments_out_of_range(name: str, values: list[Any], message: str) -> None:
    for value in values:
        with pytest.raises(TypeError if value == 3 else ValueError, match=message):
            OptionsWrapper(CountingEnv(), **{name: value})


def test_masks_of_an_environment_without_options_warn_once(caplog: pytest.LogCaptureFixture) -> None:
    """A model that was loaded by SB3 would act without its options, and nothing else would tell."""
    env = OptionsWrapper(CountingEnv(), max_options=2)
    env.reset(seed=0)
    env.action_masks()
    env.action_masks()
    assert caplog.text.count("No slot holds an option") == 1
    for quiet in (OptionsWrapper(CountingEnv(), max_options=0), with_two_options(), OptionsWrapper(CountingEnv())):
        quiet.reset(seed=0)
        quiet.set_slots(expect_empty=quiet.bank.max_options > 3)
        quiet.action_masks()
    assert caplog.text.count("No slot holds an option") == 1
