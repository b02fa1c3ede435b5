from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import Option, OptionDQN, OptionsWrapper
from sb3_options.learning.masked import unnormalized
from tests.support.helpers import CountingEnv
from tests.support.sb3_helpers import Corridor


@pytest.mark.parametrize("masks", [[0, 0, 1], [[False, False, True]], np.array([0.0, 0.0, 1.0])])
def test_given_masks_win_and_are_truth_values_or_numbers(masks: Any) -> None:
    """The last action is an empty slot, which may not start."""
    model = OptionDQN("MlpPolicy", OptionsWrapper(CountingEnv(), 1), buffer_size=10, seed=0)
    model.exploration_rate = 0.5
    for deterministic in (True, False):
        drawn = [model.predict(np.zeros(1), deterministic=deterministic, action_masks=masks)[0] for _ in range(20)]
        assert {int(action) for action in drawn} == {2}
    assert model._available(np.zeros((3, 1))).tolist() == [[True, True, False]] * 3
    assert model._available(np.zeros((3, 1))).dtype == bool
    everything = [int(model.predict(np.zeros(1))[0]) for _ in range(50)]
    assert set(everything) == {0, 1}
    state = (np.zeros(1),)
    assert model.predict(np.zeros(1), state)[1] is state


def clipping() -> tuple[VecNormalize, dict[str, npt.NDArray[Any]]]:
    """Dict observations of which a number is clipped, and the current ones as the algorithm sees them."""
    normalizer = VecNormalize(DummyVecEnv([lambda: Corridor("dict")]), norm_obs_keys=["place"], clip_obs=0.5)
    normalizer.reset()
    for action in (1, 1, 1, 1):
        seen, *_ = normalizer.step(np.array([action]))
    assert isinstance(seen, dict)
    assert seen["place"].tolist() == [[0.5, 0.5]]
    return normalizer, seen


def test_current_dict_observations_are_recognised() -> None:
    normalizer, seen = clipping()
    assert unnormalized(normalizer, seen) is normalizer.old_obs
    other = {**seen, "picture": seen["picture"] + 1}  # one of two parts differs
    assert unnormalized(normalizer, other) is not normalizer.old_obs


@pytest.mark.parametrize("channels_last", [True, False])
def test_pictures_as_the_environment_gives_them_or_the_algorithm_sees_them(channels_last: bool) -> None:
    seen: list[tuple[int, ...]] = []

    def initiation(observations: Any) -> Any:
        seen.append(observations.shape)
        return np.ones(len(observations), dtype=bool)

    def make() -> OptionsWrapper:
        env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", observation="image"), 1, gamma=0.97)
        env.bank.add(Option(initiation, lambda x: np.zeros(len(x), int), lambda x: np.zeros(len(x)), max_duration=5))
        return env

    model = OptionDQN("CnnPolicy", make(), gamma=0.97, buffer_size=10)
    own, _ = make().reset(seed=0)
    seen.clear()
    given = own if channels_last else own.transpose(2, 0, 1)
    model.predict(given, deterministic=True)
    model.predict(given[None], deterministic=True)
    assert seen == [(1, *own.shape)] * 2
