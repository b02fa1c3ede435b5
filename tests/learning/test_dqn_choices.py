"""What OptionDQN chooses among, which masks it asks for, and what it needs."""

import math
from collections import Counter
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, VecTransposeImage

from sb3_options import OptionDQN, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import PrimitiveStepsCallback
from sb3_options.learning import heads
from sb3_options.learning.dqn import FASTER_WITH_OPTIONS
from tests.learning import tables
from tests.support.helpers import steady_option
from tests.support.sb3_helpers import (
    RANDOM,
    TINY,
    Corridor,
    corridor_option,
    env_of,
    optioned_rooms,
    places,
    small_rooms,
)


def optioned_corridor(kind: str) -> OptionsWrapper:
    wrapped = OptionsWrapper(Corridor(kind), 1, gamma=tables.GAMMA, feature_map=places)
    wrapped.bank.add(corridor_option())
    return wrapped


class TestOptionDQN:
    def run(self, **kwargs: Any) -> tuple[tables.Task, list[tuple[int, int]]]:
        """States and the augmented actions chosen in them, over thousands of draws; every option is worth 1e3 more."""
        task = tables.random_task(5)
        model = OptionDQN("MlpPolicy", task.env, gamma=tables.GAMMA, **tables.TABULAR | kwargs)
        for layer, _ in heads.option_outputs(model.policy):
            torch.nn.init.constant_(layer.bias[tables.N_PRIMITIVE :], 1e3)
        states = []
        stock = model._sample_action

        def sample(*args: Any, **kwargs: Any) -> Any:
            states.append(int(cast("Any", model._last_obs)[0]))
            return stock(*args, **kwargs)

        model._sample_action = sample  # type: ignore[method-assign]  # a spy
        model.train = lambda gradient_steps, batch_size=100: None  # type: ignore[method-assign]  # choose only
        model.learn(3000)
        assert len(states) == len(task.env.chosen) >= 3000 // 4
        return task, list(zip(states, task.env.chosen, strict=True))

    @pytest.mark.parametrize("kwargs", [{"learning_starts": 10_000}, RANDOM], ids=["warm-up", "epsilon"])
    def test_random_choices_take_every_available_action_and_no_other(self, kwargs: dict[str, Any]) -> None:
        task, draws = self.run(**kwargs)
        taken: dict[int, Counter[int]] = {state: Counter() for state in range(tables.N_STATES)}
        for state, action in draws:
            taken[state][action] += 1
        assert sum(len(c) > 0 for c in taken.values()) >= 6
        for state, counts in taken.items():
            available = tables.available_in(state, task.options)
            assert set(counts) <= set(available)
            if counts.total() > 60:
                assert set(counts) == set(available)
                expected = counts.total() / len(available)
                assert all(abs(n - expected) < 6 * expected**0.5 for n in counts.values())

    def test_greedy_choices_are_the_best_available_ones(self) -> None:
        task, draws = self.run(exploration_initial_eps=0.0, exploration_final_eps=0.0)
        assert all(action in tables.available_in(state, task.options) for state, action in draws)
        for state, action in draws:
            some_option = len(tables.available_in(state, task.options)) > tables.N_PRIMITIVE
            assert (action >= tables.N_PRIMITIVE) == some_option

    def test_epsilon_is_the_share_of_random_choices(self) -> None:
        model = OptionDQN("MlpPolicy", tables.random_task(5).env, gamma=tables.GAMMA, **tables.TABULAR)
        model.exploration_rate = 0.3
        observations = np.zeros(4000, dtype=np.int64)
        greedy = model.predict(observations, deterministic=True)[0][0]
        n_available = int(model._available(observations[:1]).sum())
        share = float(np.mean(model.predict(observations, deterministic=False)[0] != greedy))
        assert abs(share - 0.3 * (1 - 1 / n_available)) < 0.03

    def test_predicts_one_and_a_batch(self) -> None:
        task = tables.random_task(5)
        model = OptionDQN("MlpPolicy", task.env, gamma=tables.GAMMA, **tables.TABULAR)
        for layer, _ in heads.option_outputs(model.policy):
            torch.nn.init.uniform_(layer.weight, -1, 1)
        online, _ = tables.q_tables(model)
        batch, state = model.predict(np.arange(tables.N_STATES), deterministic=True)
        assert state is None
        for s in range(tables.N_STATES):
            one, _ = model.predict(np.array(s), deterministic=True)
            assert one.shape == ()
            assert int(one) == batch[s] == max(tables.available_in(s, task.options), key=lambda a: online[s, a])

    @pytest.mark.parametrize("kind", ["box", "discrete", "dict", "dict_discrete", "image", "normalized"])
    def test_asks_the_wrapper_with_the_observations_it_knows(self, kind: str) -> None:
        venv: VecEnv = DummyVecEnv([lambda: optioned_corridor(kind.replace("normalized", "box"))] * 2)
        venv = VecTransposeImage(venv) if kind in ("image", "dict") else venv
        venv = VecNormalize(venv, gamma=tables.GAMMA) if kind == "normalized" else venv
        policy = {"dict": "MultiInputPolicy", "dict_discrete": "MultiInputPolicy", "image": "CnnPolicy"}.get(
            kind, "MlpPolicy"
        )
        model = OptionDQN(policy, venv, gamma=tables.GAMMA, learning_starts=20, train_freq=8, buffer_size=200, seed=0)
        model.learn(100)
        buffer = model._option_buffer()
        at = places(buffer.next_observations_stored())[:, 0]
        assert buffer.next_available[: buffer.size(), 0].tolist() == ((at >= 2) & (at < 8)).tolist()
        assert buffer.next_available.any()
        seen = cast("Any", model._last_obs)
        now = [cast("Any", c).place for c in venv.unwrapped.get_attr("unwrapped")]
        assert model._available(seen)[:, 2].tolist() == [2 <= p < 8 for p in now]

    def test_masks_of_clipped_observations_are_those_of_the_originals(self) -> None:
        inner = DummyVecEnv([lambda: optioned_corridor("box")] * 2)
        venv = VecNormalize(inner, gamma=tables.GAMMA, clip_obs=0.5, norm_reward=False)
        model = OptionDQN("MlpPolicy", venv, gamma=tables.GAMMA, buffer_size=200, seed=0)
        model.q_net.eval()
        rng, masks = np.random.default_rng(0), []
        observations: Any = venv.reset()
        for _ in range(100):
            masks.append(np.stack(venv.env_method("action_masks")))
            np.testing.assert_array_equal(model._available(observations), masks[-1])
            observations, _, _, _ = venv.step(rng.integers(2, size=2))
        assert {bool(m) for m in np.concatenate(masks)[:, 2]} == {False, True}

    def test_a_replay_buffer_of_dqn_is_masked(self, tmp_path: Path) -> None:
        own = {"replay_buffer_class": OptionReplayBuffer, **tables.TABULAR}
        stock = DQN("MlpPolicy", tables.random_task(5).env, gamma=tables.GAMMA, **own)
        stock.learn(300)
        stock.save_replay_buffer(tmp_path / "buffer")
        task = tables.random_task(5)
        model = OptionDQN("MlpPolicy", task.env, gamma=tables.GAMMA, **tables.TABULAR)
        model.load_replay_buffer(tmp_path / "buffer")
        model.learn(20)
        buffer = model._option_buffer()
        expected = env_of(model).env_method("available", buffer.next_observations_stored())[0][:, tables.N_PRIMITIVE :]
        assert buffer.size() > 300
        assert buffer.next_available[: buffer.size()].tolist() == expected.tolist()
        assert expected.any()

    def test_without_a_callback_it_is_checked_and_closed_all_the_same(self) -> None:
        text = r"OptionsWrapper discounts with gamma=0\.9, OptionDQN with gamma=0\.5: give both the same"
        with pytest.raises(ValueError, match=text):
            OptionDQN("MlpPolicy", optioned_rooms(), gamma=0.5, **TINY).learn(10)
        env = optioned_rooms(2)
        env.bank.add(corridor_option(), 1)
        model = OptionDQN("MlpPolicy", env, gamma=tables.GAMMA, **TINY)
        model.learn(10)
        assert [heads.is_closed(model.policy, 4 + slot) for slot in range(2)] == [True, False]


class Pace(BaseCallback):
    """Counts target updates, by weights that have changed."""

    def __init__(self) -> None:
        super().__init__()
        self.rates: list[tuple[int, float]] = []
        self.targets: list[int] = []
        self.last = 0.0

    def _on_step(self) -> bool:
        weights = float(sum(w.detach().double().sum() for w in cast("Any", self.model).q_net_target.parameters()))
        if not self.targets or weights != self.last:
            self.targets.append(self.num_timesteps)
        self.last = weights
        self.rates.append((self.num_timesteps, cast("Any", self.model).exploration_rate))
        return True


@pytest.mark.parametrize("k", [1, 5])
def test_updates_and_epsilon_keep_their_pace_by_primitive_steps(k: int) -> None:
    env = optioned_rooms(1)
    if k > 1:
        env.bank.add(steady_option(max_duration=k))
    pace = Pace()
    model = OptionDQN(
        "MlpPolicy", env, gamma=0.9, learning_starts=0, train_freq=4, gradient_steps=8, target_update_interval=50,
        buffer_size=5000, exploration_fraction=0.8, exploration_final_eps=0.1, policy_kwargs={"net_arch": []}, seed=0,
    )  # fmt: skip
    assert model._option_buffer().n_steps == 3
    model.learn(400, callback=[PrimitiveStepsCallback(), pace])
    decisions = len(pace.rates)
    assert decisions == model.num_timesteps if k == 1 else decisions < 0.9 * model.num_timesteps
    assert abs(model._n_updates - 2 * model.num_timesteps) <= 8 * k  # the first decisions are not trained on
    assert abs(len(pace.targets) - model.num_timesteps // 50) <= 1
    ends = next(at for at, rate in pace.rates if rate == pytest.approx(0.1))
    assert ends == pytest.approx(320 if k == 1 else 320 / FASTER_WITH_OPTIONS, abs=k + 1)


@pytest.mark.parametrize("force_reset", [None, True, False])
def test_another_environment_is_reset_unless_told_otherwise_and_must_be_wrapped(force_reset: bool | None) -> None:
    model = OptionDQN("MlpPolicy", optioned_rooms(1), gamma=tables.GAMMA, **TINY)
    assert (model._n_slots, model._option_buffer().next_available.shape[1]) == (1, 1)
    model._last_obs = np.zeros((1, 45))
    env = optioned_rooms(1)
    model.set_env(env, **({} if force_reset is None else {"force_reset": force_reset}))
    assert (model._last_obs is None) == (force_reset is not False)
    assert (env_of(model).get_attr("bank"), model._n_slots) == ([env.bank], 1)
    wide = gym.wrappers.TransformAction(small_rooms(), lambda action: action % 4, spaces.Discrete(5))
    with pytest.raises(ValueError, match=r"^The environment of OptionDQN "):
        model.set_env(wide)


def test_a_stock_model_goes_on_and_its_epsilon_with_it(tmp_path: Path) -> None:
    stock = DQN("MlpPolicy", optioned_rooms(1), gamma=0.9, exploration_fraction=1.0, **TINY | {"train_freq": 1})
    stock.learn(50)
    stock.save(tmp_path / "model")
    model = OptionDQN.load(tmp_path / "model", env=optioned_rooms(1), replay_buffer_class=OptionReplayBuffer)
    model.learn(50, reset_num_timesteps=False)
    assert model.num_timesteps == 100
    assert model.exploration_rate == pytest.approx(0.05)
    model._options_since = 7
    for reset, expected in ((False, 7), (True, math.inf)):
        model.learn(5, reset_num_timesteps=reset)
        assert model._options_since == expected
