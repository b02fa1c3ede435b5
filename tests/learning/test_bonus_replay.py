"""Sampled rewards with a bonus, against returns that are worked out from the primitive steps alone."""

import pickle
from typing import Any, cast

import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import VecNormalize

from tests.learning.test_n_step import Decision, assert_samples, buffer_for, episodes_of, expected
from tests.learning.test_replay_buffer import GAMMA, corridors, place_in
from tests.support.sb3_helpers import places

WORTH = np.random.default_rng(1).random(12)
"""The bonus of each place."""


def bonus(observations: Any) -> Any:
    return WORTH[places(observations)[:, 0].astype(int)]


def with_bonus(episodes: list[list[Decision]]) -> list[list[Decision]]:
    """The same as if the environment had rewarded it."""

    def step_with(step: Any) -> Any:
        return step._replace(reward=step.reward + WORTH[place_in(step.next_state)])

    return [[d._replace(steps=[step_with(step) for step in d.steps]) for d in episode] for episode in episodes]


@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize(("kind", "n"), [("box", 1), ("discrete", 1), ("box", 5), ("dict", 3), ("image", 3)])
def test_an_option_has_the_bonus_of_the_steps_inside(kind: str, n: int, n_envs: int, rng: np.random.Generator) -> None:
    venv = corridors(kind, n_envs)
    buffer = buffer_for(venv, 3000, n)
    episodes = episodes_of(venv, buffer, 400 // n_envs, rng)
    plain, returns = expected(episodes, n, macro_q=True), expected(with_bonus(episodes), n, macro_q=True)
    rows = sorted(returns)
    assert any(r.action == 2 and r.discount < GAMMA**2 for r in returns.values())
    buffer.bonus = bonus
    assert_samples(buffer, rows, [returns[row] for row in rows])
    buffer.bonus = None
    assert_samples(buffer, rows, [plain[row] for row in rows])


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("size", [3, 7, 37])
def test_the_same_where_the_oldest_rows_are_overwritten(size: int, n: int, rng: np.random.Generator) -> None:
    for n_steps in range(5, 45):
        venv = corridors("box", 2)
        buffer = buffer_for(venv, size, n)
        buffer.bonus = bonus
        returns = expected(with_bonus(episodes_of(venv, buffer, n_steps, rng)), n, macro_q=True)
        kept = range(max(0, len(returns) - size), len(returns))
        assert_samples(buffer, [row % size for row in kept], [returns[row] for row in kept])


def test_a_row_that_was_an_options_has_the_bonus_of_what_took_its_place(rng: np.random.Generator) -> None:
    venv = corridors("box")
    buffer = buffer_for(venv, 3000, 1)
    returns = expected(with_bonus(episodes_of(venv, buffer, 200, rng)), 1, macro_q=True)
    buffer.forget_action(2)
    buffer.bonus = bonus
    removed = [row for row, r in returns.items() if r.action == 2]
    assert len(removed) > 10
    assert_samples(buffer, removed, [returns[row + 1] for row in removed])  # the first step of the run


def test_bonuses_are_not_divided_by_what_rewards_are(rng: np.random.Generator) -> None:
    venv = VecNormalize(corridors("box"), norm_obs=False, gamma=GAMMA, clip_reward=np.inf)
    buffer = buffer_for(venv, 3000, 3)
    episodes_of(cast("Any", venv), buffer, 100, rng)
    rows = np.arange(buffer.size())
    plain = buffer._get_samples(rows, venv).rewards
    raw = buffer._get_samples(rows).rewards
    assert not np.allclose(plain, raw)
    buffer.bonus = bonus
    added = buffer._get_samples(rows, venv).rewards - plain
    np.testing.assert_allclose(added, buffer._get_samples(rows).rewards - raw, atol=1e-5)


def test_a_bonus_is_not_pickled(rng: np.random.Generator) -> None:
    venv = corridors("box")
    buffer = buffer_for(venv, 100, 1)
    episodes_of(venv, buffer, 20, rng)
    rows = np.arange(buffer.size())
    plain = buffer._get_samples(rows).rewards
    buffer.bonus = lambda observations: bonus(observations)  # not to be pickled
    loaded = pickle.loads(pickle.dumps(buffer))
    assert torch.equal(loaded._get_samples(rows).rewards, plain)
    loaded.bonus = bonus
    assert torch.equal(loaded._get_samples(rows).rewards, buffer._get_samples(rows).rewards)
