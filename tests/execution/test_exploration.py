"""What share of exploratory choices are options."""

from collections import Counter
from typing import Any, cast

import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import QRDQN
from stable_baselines3 import DQN, PPO

from sb3_options import OptionDQN, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.execution.exploration import CappedActions, cap_option_exploration
from tests.support.helpers import CountingEnv, steady_option
from tests.support.sb3_helpers import RANDOM, TINY, ActionLog

N_DRAWS = 6000


def capped(share: float, n_primitive: int = 2, max_options: int = 6, filled: int = 6) -> CappedActions:
    actions = CappedActions(spaces.Discrete(n_primitive + max_options, seed=0), n_primitive, share)
    actions.filled = tuple(range(filled))
    return actions


def assert_share(chosen: Any, expected: float, n_primitive: int = 2) -> None:
    n = len(chosen)
    share = float(np.mean(np.asarray(chosen) >= n_primitive))
    assert abs(share - expected) < 4 * (expected * (1 - expected) / n) ** 0.5 + 1e-12


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_samples_keep_to_the_share(share: float) -> None:
    space = capped(share)
    draws = [int(space.sample()) for _ in range(N_DRAWS)]
    assert_share(draws, share)
    counts = Counter(draws)
    assert all(abs(counts[a] - N_DRAWS * (1 - share) / 2) < 200 for a in (0, 1))
    assert all(abs(counts[a] - N_DRAWS * share / 6) < 150 for a in range(2, 8))


@pytest.mark.parametrize("filled", [0, 4])
def test_a_primitive_is_drawn_in_the_place_of_an_empty_slot(filled: int) -> None:
    space = capped(0.5, n_primitive=4, filled=filled)
    counts = Counter(int(space.sample()) for _ in range(N_DRAWS))
    assert set(counts) == set(range(4 + filled))
    assert_share(list(counts.elements()), filled / 10, n_primitive=4)
    assert all(abs(counts[a] - N_DRAWS * (1 - filled / 10) / 4) < 150 for a in range(4))


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_choices_among_what_is_allowed_keep_to_the_share(share: float) -> None:
    space = capped(share)
    allowed = np.array([True, True, True, False, True, True, False, False])
    draws = [space.choose(allowed) for _ in range(N_DRAWS)]
    assert_share(draws, min(share, 3 / 5))
    assert set(draws) == {0, 1, 2, 4, 5}


def test_masks_and_probabilities_are_as_for_a_plain_space() -> None:
    space = capped(0.0)
    assert {int(space.sample(mask=np.eye(8, dtype=np.int8)[5])) for _ in range(20)} == {5}
    assert {int(space.sample(probability=np.eye(8)[6])) for _ in range(20)} == {6}


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_where_the_share_is_kept_anyway_choices_are_those_of_a_plain_space(share: float) -> None:
    """Three options of six actions, where half or all may be options."""
    plain, space = spaces.Discrete(6, seed=0), capped(share, n_primitive=3, max_options=3, filled=3)
    assert [space.sample() for _ in range(100)] == [plain.sample() for _ in range(100)]
    uniform, chooser = np.random.default_rng(4), capped(share, n_primitive=3, max_options=3, filled=3)
    chooser._np_random = np.random.default_rng(4)
    assert [chooser.choose(np.ones(6, bool)) for _ in range(50)] == [uniform.choice(np.arange(6)) for _ in range(50)]


def test_a_choice_without_primitives_is_an_option() -> None:
    assert capped(0.1).choose(np.arange(8) == 3) == 3


@pytest.mark.parametrize("algorithm", [DQN, QRDQN, OptionDQN])
def test_a_model_explores_with_the_share(algorithm: Any) -> None:
    wrapped = OptionsWrapper(CountingEnv(truncate_at=50), 6, gamma=0.9)
    wrapped.set_slots(options=dict.fromkeys(range(5), steady_option(max_duration=2)))
    env = ActionLog(wrapped)
    settings = TINY | RANDOM | {"learning_starts": 300}  # warm-up and ε
    model = algorithm("MlpPolicy", env, gamma=0.9, replay_buffer_class=OptionReplayBuffer, **settings)
    model.learn(800, callback=SubgoalDiscoveryCallback(max_new_options=0, use={"max_option_exploration": 0.25}))
    assert_share(env.chosen, 0.25)
    assert cast("Any", model.action_space).filled == tuple(range(5))


def test_an_algorithm_that_explores_otherwise_keeps_its_space() -> None:
    model = PPO("MlpPolicy", OptionsWrapper(CountingEnv(), 2), device="cpu")
    assert cap_option_exploration(model, 2, 0.5) is None
    assert type(model.action_space) is spaces.Discrete
