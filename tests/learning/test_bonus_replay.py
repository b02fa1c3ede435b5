"""Sampled rewards with a bonus, against returns that are worked out from the primitive steps alone."""

import io
import pickle
from typing import Any, cast

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_options.learning.bonus_replay import Bonus, set_bonus
from tests.learning.test_n_step import Decision, assert_samples, buffer_for, episodes_of, expected
from tests.learning.test_replay_buffer import GAMMA, corridors, place_in
from tests.support.sb3_helpers import Corridor, StepLog, places

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
    set_bonus(buffer, bonus)
    assert_samples(buffer, rows, [returns[row] for row in rows])
    set_bonus(buffer, None)
    assert_samples(buffer, rows, [plain[row] for row in rows])


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("size", [3, 7, 37])
def test_the_same_where_the_oldest_rows_are_overwritten(size: int, n: int, rng: np.random.Generator) -> None:
    for n_steps in range(5, 45):
        venv = corridors("box", 2)
        buffer = buffer_for(venv, size, n)
        set_bonus(buffer, bonus)
        returns = expected(with_bonus(episodes_of(venv, buffer, n_steps, rng)), n, macro_q=True)
        kept = range(max(0, len(returns) - size), len(returns))
        assert_samples(buffer, [row % size for row in kept], [returns[row] for row in kept])


def test_a_row_that_was_an_options_has_the_bonus_of_what_took_its_place(rng: np.random.Generator) -> None:
    venv = corridors("box")
    buffer = buffer_for(venv, 3000, 1)
    returns = expected(with_bonus(episodes_of(venv, buffer, 200, rng)), 1, macro_q=True)
    buffer.forget_action(2)
    set_bonus(buffer, bonus)
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
    set_bonus(buffer, bonus)
    added = buffer._get_samples(rows, venv).rewards - plain
    np.testing.assert_allclose(added, buffer._get_samples(rows).rewards - raw, atol=1e-5)


def stock_buffer(made: Any, kind: str, size: int, n_steps: int, rng: np.random.Generator) -> tuple[Any, list[Any]]:
    """A buffer of SB3 with random steps of two corridors, and the logs of these."""
    logs = [StepLog(Corridor(kind, 9)), StepLog(Corridor(kind, 13))]
    venv = DummyVecEnv([lambda env=env: env for env in logs])  # type: ignore[misc]  # bound early
    buffer = made(size, venv.observation_space, venv.action_space, "cpu", n_envs=2)
    obs: Any = venv.reset()
    for _ in range(n_steps):
        actions = (rng.random(2) < 0.7).astype(int)
        next_obs: Any
        next_obs, rewards, dones, infos = venv.step(actions)
        ended = {k: v.copy() for k, v in next_obs.items()} if isinstance(next_obs, dict) else next_obs.copy()
        for i in np.flatnonzero(dones):
            final = infos[i]["terminal_observation"]
            for key in ended if isinstance(ended, dict) else [i]:
                if isinstance(ended, dict):
                    ended[key][i] = final[key]
                else:
                    ended[i] = final
        buffer.add(obs, ended, actions, rewards, dones, infos)
        obs = next_obs
    return buffer, [env.log for env in logs]


def draw(buffer: Any, rows: Any, env: Any = None) -> tuple[Any, Any]:
    """Samples, and which environments they are of: the first thing that SB3 draws."""
    np.random.seed(0)  # noqa: NPY002  # SB3's own
    envs = np.random.randint(0, 2, size=len(rows))  # noqa: NPY002
    np.random.seed(0)  # noqa: NPY002
    return buffer._get_samples(rows, env), envs


@pytest.mark.parametrize(("size", "n_steps"), [(400, 60), (80, 110)])
@pytest.mark.parametrize(
    ("made", "kind", "n"),
    [
        (ReplayBuffer, "box", 1),
        (ReplayBuffer, "discrete", 1),
        (DictReplayBuffer, "dict", 1),
        (NStepReplayBuffer, "box", 3),
    ],
)
def test_stock_buffers(made: Any, kind: str, n: int, size: int, n_steps: int, rng: np.random.Generator) -> None:
    buffer, logs = stock_buffer(
        (lambda *args, **kwargs: made(*args, n_steps=n, gamma=GAMMA, **kwargs)) if n > 1 else made,
        kind, size, n_steps, rng,
    )  # fmt: skip
    rows = np.arange(buffer.size())
    plain, envs = draw(buffer, rows)
    set_bonus(buffer, bonus)
    samples, same = draw(buffer, rows)
    assert (envs == same).all()
    time_of = (rows - buffer.pos) % len(rows) + (n_steps - len(rows))  # when each row was written
    added = []
    for t, env in zip(time_of, envs, strict=True):
        total = 0.0
        for i, step in enumerate(logs[env][t : t + n]):
            total += GAMMA**i * WORTH[place_in(step.next_state)]
            if step.terminated or step.truncated:
                break
        added.append(total)
    np.testing.assert_allclose(samples.rewards[:, 0] - plain.rewards[:, 0], added, atol=1e-5)
    assert samples.rewards.dtype == plain.rewards.dtype
    for name in ("actions", "dones", "discounts"):
        before: Any = getattr(plain, name, None)
        after: Any = getattr(samples, name, None)
        assert (before is None and after is None) or torch.equal(before, after)
    set_bonus(buffer, None)
    assert type(buffer) is made
    assert (draw(buffer, rows)[0].rewards == plain.rewards).all()


@pytest.mark.parametrize("options", [True, False])
def test_a_bonus_is_not_pickled(options: bool, rng: np.random.Generator) -> None:
    venv = corridors("box")
    buffer: Any = buffer_for(venv, 100, 1) if options else stock_buffer(ReplayBuffer, "box", 100, 30, rng)[0]
    if options:
        episodes_of(venv, buffer, 20, rng)
    rows = np.arange(buffer.size())
    plain, _ = draw(buffer, rows)
    not_to_be_pickled: Bonus = lambda observations: bonus(observations)  # noqa: E731
    set_bonus(buffer, not_to_be_pickled)
    loaded = pickle.load(io.BytesIO(pickle.dumps(buffer)))
    assert (draw(loaded, rows)[0].rewards == plain.rewards).all()
    set_bonus(loaded, bonus)
    assert (draw(loaded, rows)[0].rewards == draw(buffer, rows)[0].rewards).all()


class Own(ReplayBuffer):
    """A user's class."""


def test_what_cannot_have_a_bonus() -> None:
    box, actions = spaces.Box(0.0, 1.0, (1,)), spaces.Discrete(2)
    with pytest.raises(TypeError, match=r"cannot be added to what Own samples: IntrinsicRewardCallback knows"):
        set_bonus(Own(10, box, actions), bonus)
    thrifty = ReplayBuffer(10, box, actions, optimize_memory_usage=True, handle_timeout_termination=False)
    with pytest.raises(ValueError, match="pass optimize_memory_usage=False"):
        set_bonus(thrifty, bonus)
