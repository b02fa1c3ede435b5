"""What follows, in the replay buffer and in exploration, from options that come, change and go."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from stable_baselines3 import DQN

from sb3_options import OptionDQN
from sb3_options.callbacks.installer import OptionInstaller
from sb3_options.density.regions import Region
from sb3_options.execution.exploration import CappedActions
from sb3_options.options.option import Option, SubgoalOption
from sb3_options.options.policies import TabularPolicy
from tests.callbacks.doorway import N_PRIMITIVE, model_of
from tests.support.helpers import steady_option
from tests.support.sb3_helpers import env_of, optioned_rooms


def option_from(*columns: float) -> SubgoalOption:
    """Leads nowhere, and may start in some columns of the small rooms."""
    inside = np.array([[x, y] for x in columns for y in range(5)], dtype=np.float64)
    policy = TabularPolicy(np.eye(45), np.zeros((45, N_PRIMITIVE)))
    return SubgoalOption(Region(np.array([[8.0, 4.0]]), np.ones(2), 0.0), Region(inside, np.ones(2), 0.0), policy)


def filled(algorithm: Any) -> Any:
    """With transitions of random steps."""
    return model_of(optioned_rooms(2), algorithm).learn(200)


def available(model: Any, slot: int) -> npt.NDArray[Any]:
    """Whether the slot may start in the stored next observations, by the environment."""
    seen = model.replay_buffer.next_observations_stored()
    return np.asarray(env_of(model).env_method("available", seen)[0][:, N_PRIMITIVE + slot])


def test_what_is_stored_knows_where_an_option_may_start_also_after_that_has_changed() -> None:
    model = filled(OptionDQN)
    installer = OptionInstaller(model, env_of(model), None)
    installer.install(0, option_from(0, 1))
    installer.on_rollout_end()
    buffer = model.replay_buffer
    first = buffer.next_available[: buffer.size(), 0].copy()
    np.testing.assert_array_equal(first, available(model, 0))
    installer.replace(0, option_from(2, 3))
    installer.on_rollout_end()
    second = buffer.next_available[: buffer.size(), 0]
    np.testing.assert_array_equal(second, available(model, 0))
    assert first.any()
    assert second.any()
    assert not (first & second).any()


@pytest.mark.parametrize("algorithm", [DQN, OptionDQN])
def test_exploration_chooses_no_option_that_was_removed(algorithm: Any) -> None:
    model = filled(algorithm)
    installer = OptionInstaller(model, env_of(model), None, max_option_exploration=0.5)
    options: list[Option] = [steady_option(), steady_option()]
    for slot, option in enumerate(options):
        installer.install(slot, option)
    space = model.action_space
    assert isinstance(space, CappedActions)
    assert list(space.filled) == [0, 1]
    installer.uninstall(0)
    installer.on_rollout_end()
    assert list(space.filled) == [1]
    space.share = 0.0  # so that it draws for itself, and no option
    assert all(int(space.sample()) < N_PRIMITIVE for _ in range(50))
