"""Targets of DQN, QRDQN and OptionDQN against a table; what OptionDQN chooses among; runs without options."""

from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from sb3_contrib import QRDQN
from sb3_contrib.qrdqn import qrdqn as qrdqn_module
from stable_baselines3 import DQN
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, VecTransposeImage
from torch.nn import functional

from sb3_options import Option, OptionDQN, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback
from sb3_options.learning import dqn as option_dqn_module
from sb3_options.learning import heads
from sb3_options.learning.replay_samples import OptionReplayBufferSamples
from tests.support.helpers import TableEnv, table_option
from tests.support.sb3_helpers import (
    RANDOM,
    TINY,
    ActionLog,
    Corridor,
    Row,
    StepLog,
    TableOption,
    env_of,
    expected_rows,
    optioned_rooms,
    place_condition,
    places,
    small_rooms,
)

GAMMA = 0.9
N_STATES, N_PRIMITIVE, MAX_OPTIONS = 8, 3, 3
N_ACTIONS = N_PRIMITIVE + MAX_OPTIONS
N_QUANTILES = 5
TABULAR: dict[str, Any] = {"policy_kwargs": {"net_arch": []}, "learning_starts": 0, "buffer_size": 5000, "seed": 3}


class Task(NamedTuple):
    """A random MDP with random options in slots 0 and 2, slot 1 being empty, and the logs of what happened."""

    env: ActionLog
    steps: StepLog
    options: dict[int, TableOption]


def random_task(seed: int) -> Task:
    rng = np.random.default_rng(seed)
    base = TableEnv(rng, N_STATES, N_PRIMITIVE)
    base.time_limit, base.terminal = 5, np.arange(N_STATES) == 0
    steps = StepLog(base)
    wrapped = OptionsWrapper(steps, MAX_OPTIONS, gamma=GAMMA)
    options: dict[int, TableOption] = {}
    for slot in (0, 2):
        table = TableOption(
            (rng.random(N_STATES) < 0.7).tolist(),
            rng.integers(N_PRIMITIVE, size=N_STATES).tolist(),
            (rng.random(N_STATES) < 0.2).tolist(),
            max_duration=4,
        )
        options[slot] = table
        wrapped.bank.add(table_option(*table[:3], max_duration=4), slot)
    return Task(ActionLog(wrapped), steps, options)


def filled(algorithm: type[OffPolicyAlgorithm], task: Task, macro_q: bool, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A model over Q tables drawn at random, whose buffer its own `learn` has filled with random actions."""
    quantiles = {"n_quantiles": N_QUANTILES} if algorithm is QRDQN else {}
    model = algorithm(
        "MlpPolicy", task.env, gamma=GAMMA, replay_buffer_class=OptionReplayBuffer,
        replay_buffer_kwargs={"macro_q": macro_q},
        **TABULAR | RANDOM | {"policy_kwargs": {"net_arch": [], **quantiles}},
    )  # fmt: skip
    monkeypatch.setattr(model, "train", lambda gradient_steps, batch_size: None)
    model.learn(400)
    monkeypatch.undo()
    for layer, _ in heads.option_outputs(model.policy):
        torch.nn.init.uniform_(layer.weight, -1, 1)
        torch.nn.init.uniform_(layer.bias, -1, 1)
        with torch.no_grad():
            layer.bias.view(-1, N_ACTIONS)[:, N_PRIMITIVE:] += torch.tensor(
                [0.5, 1.5, 1.5]
            )  # so that what is available often matters
    return model


def tables(model: Any) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """What the online and the target network give in each state, in float64, (states, outputs)."""
    layers = [layer for layer, _ in heads.option_outputs(model.policy)]
    both = [(layer.weight.detach().double().T + layer.bias.detach().double()).numpy() for layer in layers]
    return both[0], both[1]


def train_on_all_rows(
    model: Any, loss: tuple[Any, str], monkeypatch: pytest.MonkeyPatch
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """One gradient step on every stored row in order; what the algorithm handed to its loss: (predicted, target)."""
    handed: list[list[npt.NDArray[np.float64]]] = []
    module, name = loss
    stock = getattr(module, name)

    def spy(predicted: torch.Tensor, target: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
        handed.append([predicted.detach().double().numpy(), target.detach().double().numpy()])
        return cast("torch.Tensor", stock(predicted, target, *args, **kwargs))

    buffer = model.replay_buffer
    monkeypatch.setattr(buffer, "sample", lambda n, env=None: buffer._get_samples(np.arange(buffer.size()), env))
    monkeypatch.setattr(module, name, spy)
    model.train(1, buffer.size())
    monkeypatch.undo()
    assert len(handed) == 1
    return handed[0][0], handed[0][1]


def rows_lived_through(task: Task, macro_q: bool) -> list[Row]:
    return expected_rows(task.steps.log, task.env.chosen, task.options, N_PRIMITIVE, GAMMA, macro_q=macro_q)


def available_in(state: int, options: dict[int, TableOption]) -> list[int]:
    return [*range(N_PRIMITIVE), *(N_PRIMITIVE + i for i, o in options.items() if o.initiation[state])]


def target_of(row: Row, next_values: npt.NDArray[np.float64], actions: list[int]) -> float:
    """r + γᵏ max over ``actions`` of Q(s', a), or r at the end of an episode."""
    return row.reward + (0.0 if row.terminal else row.discount * float(max(next_values[a] for a in actions)))


@pytest.mark.parametrize("macro_q", [True, False])
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("algorithm", [DQN, OptionDQN])
def test_targets_are_exact(
    algorithm: type[OffPolicyAlgorithm], seed: int, macro_q: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = random_task(seed)
    model = filled(algorithm, task, macro_q, monkeypatch)
    rows = rows_lived_through(task, macro_q)
    online, target_table = tables(model)
    module = (functional, "smooth_l1_loss")
    predicted, target = train_on_all_rows(model, module, monkeypatch)

    every = list(range(N_ACTIONS))
    masked = algorithm is OptionDQN
    expected = [
        target_of(r, target_table[r.next_state], available_in(r.next_state, task.options) if masked else every)
        for r in rows
    ]
    np.testing.assert_allclose(target[:, 0], expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(predicted[:, 0], [online[r.state, r.action] for r in rows], rtol=0, atol=1e-6)

    # Without these the comparison would say little.
    assert len(rows) > 200
    # Stock DQN chose the empty slot, and what it ran was stored.
    assert (N_PRIMITIVE + 1 in task.env.chosen) != masked
    assert N_PRIMITIVE + 1 not in [r.action for r in rows]
    ended = {(r.terminal, round(r.discount, 6)) for r in rows if r.action >= N_PRIMITIVE}
    assert {terminal for terminal, _ in ended} == {True, False}
    assert len({discount for _, discount in ended}) >= 3
    if masked:
        unmasked = [target_of(r, target_table[r.next_state], every) for r in rows]
        assert np.abs(np.subtract(unmasked, expected)).max() > 0.1


def test_timeouts_inside_options_bootstrap(monkeypatch: pytest.MonkeyPatch) -> None:
    task = random_task(0)
    model = filled(DQN, task, True, monkeypatch)
    truncated = {(s.state, s.action, s.next_state) for s in task.steps.log if s.truncated and not s.terminated}
    assert truncated
    flagged = model.replay_buffer.timeouts[: model.replay_buffer.size()] == 1
    assert (model.replay_buffer.actions[: len(flagged)][flagged] >= N_PRIMITIVE).any()
    assert not model.replay_buffer._get_samples(np.flatnonzero(flagged)).dones.any()


@pytest.mark.parametrize("macro_q", [True, False])
@pytest.mark.parametrize("seed", [0, 1])
def test_quantile_targets_are_exact(seed: int, macro_q: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    task = random_task(seed)
    model = filled(QRDQN, task, macro_q, monkeypatch)
    rows = rows_lived_through(task, macro_q)
    _, target_table = tables(model)
    quantiles = target_table.reshape(N_STATES, N_QUANTILES, N_ACTIONS)
    _, target = train_on_all_rows(model, (qrdqn_module, "quantile_huber_loss"), monkeypatch)
    greedy = quantiles.mean(axis=1).argmax(axis=1)
    for row, seen in zip(rows, target, strict=True):
        best = quantiles[row.next_state, :, greedy[row.next_state]]
        np.testing.assert_allclose(seen, row.reward + (not row.terminal) * row.discount * best, rtol=0, atol=1e-6)
    assert {round(r.discount, 6) for r in rows if r.action >= N_PRIMITIVE} >= {0.9, 0.81}


def test_targets_stay_exact_for_transitions_stored_before_an_option_was_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An option that moves in while the agent trains counts in the targets of everything lived through already."""
    model = OptionDQN("MlpPolicy", optioned_rooms(2), gamma=GAMMA, **TINY | RANDOM)
    callback = SubgoalDiscoveryCallback({"min_positive": 3, "goal_radius": 3.0, "decay": 0.5}, max_new_options=1)
    checked = []
    stock_train = model.train

    def train(gradient_steps: int, batch_size: int = 100) -> None:
        buffer = model._option_buffer()
        assert env_of(model).env_method("available", buffer.next_observations_stored())[0][:, 4:].tolist() == (
            buffer.next_available[: buffer.size()].tolist()
        )
        checked.append(bool(buffer.next_available.any()))
        stock_train(gradient_steps, batch_size)

    monkeypatch.setattr(model, "train", train)
    model.learn(2500, callback=callback)
    assert callback.discoveries
    assert checked[-1]
    assert not checked[0]


class TestWithoutOptions:
    """No slots, no options: the same weights, bit for bit, as stock SB3 on the bare environment."""

    kwargs: dict[str, Any] = TINY | {"train_freq": 4, "target_update_interval": 50, "gamma": GAMMA}

    def weights(self, algorithm: type[OffPolicyAlgorithm], env: gym.Env[Any, Any], **kwargs: Any) -> dict[str, Any]:
        callback = kwargs.pop("callback", None)
        if algorithm is QRDQN:
            kwargs["policy_kwargs"] = {"net_arch": [16], "n_quantiles": 8}
        model = algorithm("MlpPolicy", env, **self.kwargs | kwargs)
        model.learn(1000, callback=callback)
        assert cast("Any", model)._n_updates > 200
        return model.policy.state_dict()

    @pytest.mark.parametrize("callback", [False, True])
    @pytest.mark.parametrize("algorithm", [DQN, QRDQN])
    def test_learns_the_same(self, algorithm: type[OffPolicyAlgorithm], callback: bool) -> None:
        bare = self.weights(algorithm, small_rooms())
        wrapped = self.weights(
            algorithm,
            optioned_rooms(0),
            replay_buffer_class=OptionReplayBuffer,
            callback=SubgoalDiscoveryCallback() if callback else None,
        )
        assert bare.keys() == wrapped.keys()
        for name, value in bare.items():
            assert torch.equal(value, wrapped[name]), name

    def test_a_buffer_that_wraps_around_learns_the_same_too(self) -> None:
        bare = self.weights(DQN, small_rooms(), buffer_size=130)
        wrapped = self.weights(DQN, optioned_rooms(0), buffer_size=130, replay_buffer_class=OptionReplayBuffer)
        assert all(torch.equal(value, wrapped[name]) for name, value in bare.items())


class TestOptionDQN:
    def run(self, **kwargs: Any) -> tuple[Task, list[tuple[int, int]]]:
        """States and the augmented actions chosen in them, over thousands of draws; every option is worth 1e3 more."""
        task = random_task(5)
        model = OptionDQN("MlpPolicy", task.env, gamma=GAMMA, **TABULAR | kwargs)
        for layer, _ in heads.option_outputs(model.policy):
            torch.nn.init.constant_(layer.bias[N_PRIMITIVE:], 1e3)
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
        taken: dict[int, Counter[int]] = {state: Counter() for state in range(N_STATES)}
        for state, action in draws:
            taken[state][action] += 1
        assert sum(len(c) > 0 for c in taken.values()) >= 6
        for state, counts in taken.items():
            available = available_in(state, task.options)
            assert set(counts) <= set(available)
            if counts.total() > 60:
                assert set(counts) == set(available)
                expected = counts.total() / len(available)
                assert all(abs(n - expected) < 6 * expected**0.5 for n in counts.values())

    def test_greedy_choices_are_the_best_available_ones(self) -> None:
        task, draws = self.run(exploration_initial_eps=0.0, exploration_final_eps=0.0)
        assert all(action in available_in(state, task.options) for state, action in draws)
        for state, action in draws:
            some_option = len(available_in(state, task.options)) > N_PRIMITIVE
            assert (action >= N_PRIMITIVE) == some_option

    def test_epsilon_is_the_share_of_random_choices(self) -> None:
        model = OptionDQN("MlpPolicy", random_task(5).env, gamma=GAMMA, **TABULAR)
        model.exploration_rate = 0.3
        observations = np.zeros(4000, dtype=np.int64)
        greedy = model.predict(observations, deterministic=True)[0][0]
        n_available = int(model._available(observations[:1]).sum())
        share = float(np.mean(model.predict(observations, deterministic=False)[0] != greedy))
        assert abs(share - 0.3 * (1 - 1 / n_available)) < 0.03

    def test_predicts_one_and_a_batch(self) -> None:
        task = random_task(5)
        model = OptionDQN("MlpPolicy", task.env, gamma=GAMMA, **TABULAR)
        for layer, _ in heads.option_outputs(model.policy):
            torch.nn.init.uniform_(layer.weight, -1, 1)
        online, _ = tables(model)
        batch, state = model.predict(np.arange(N_STATES), deterministic=True)
        assert state is None
        for s in range(N_STATES):
            one, _ = model.predict(np.array(s), deterministic=True)
            assert one.shape == ()
            assert int(one) == batch[s] == max(available_in(s, task.options), key=lambda a: online[s, a])

    def test_given_masks_win(self) -> None:
        model = OptionDQN("MlpPolicy", random_task(5).env, gamma=GAMMA, **TABULAR)
        for action in range(N_ACTIONS):
            mask = np.arange(N_ACTIONS) == action
            for deterministic in (True, False):
                assert model.predict(np.array(2), deterministic=deterministic, action_masks=mask)[0] == action

    @pytest.mark.parametrize("kind", ["box", "dict", "image", "normalized"])
    def test_asks_the_wrapper_with_the_observations_it_knows(self, kind: str) -> None:
        def make() -> OptionsWrapper:
            wrapped = OptionsWrapper(Corridor(kind.replace("normalized", "box")), 1, gamma=GAMMA, feature_map=places)
            wrapped.bank.add(corridor_option())
            return wrapped

        venv: VecEnv = DummyVecEnv([make, make])
        venv = VecTransposeImage(venv) if kind in ("image", "dict") else venv
        venv = VecNormalize(venv, gamma=GAMMA) if kind == "normalized" else venv
        policy = {"dict": "MultiInputPolicy", "image": "CnnPolicy"}.get(kind, "MlpPolicy")
        model = OptionDQN(policy, venv, gamma=GAMMA, learning_starts=20, train_freq=8, buffer_size=200, seed=0)
        model.learn(100)
        buffer = model._option_buffer()
        at = places(buffer.next_observations_stored())[:, 0]
        assert buffer.next_available[: buffer.size(), 0].tolist() == ((at >= 2) & (at < 8)).tolist()
        assert buffer.next_available.any()
        seen = cast("Any", model._last_obs)
        now = [cast("Any", c).place for c in venv.unwrapped.get_attr("unwrapped")]
        assert model._available(seen)[:, 2].tolist() == [2 <= p < 8 for p in now]

    def test_goes_on_with_masks_after_loading_without_an_environment(self, tmp_path: Path) -> None:
        task = random_task(5)
        OptionDQN("MlpPolicy", task.env, gamma=GAMMA, **TABULAR).save(tmp_path / "model.zip")
        model = OptionDQN.load(tmp_path / "model.zip")
        assert model.predict(np.arange(N_STATES), deterministic=True)[0].shape == (N_STATES,)  # all counts as available
        model.set_env(random_task(5).env)
        model.learn(100)
        assert model._option_buffer().next_available[: model._option_buffer().size()].any()

    def test_masks_of_clipped_observations_are_those_of_the_originals(self, caplog: pytest.LogCaptureFixture) -> None:
        def make() -> OptionsWrapper:
            wrapped = OptionsWrapper(Corridor("box"), 1, gamma=GAMMA, feature_map=places)
            wrapped.bank.add(corridor_option())
            return wrapped

        venv = VecNormalize(DummyVecEnv([make, make]), gamma=GAMMA, clip_obs=0.5, norm_reward=False)
        model = OptionDQN("MlpPolicy", venv, gamma=GAMMA, buffer_size=200, seed=0)
        model.q_net.eval()
        rng, masks = np.random.default_rng(0), []
        observations: Any = venv.reset()
        for _ in range(100):
            masks.append(np.stack(venv.env_method("action_masks")))
            np.testing.assert_array_equal(model._available(observations), masks[-1])
            observations, _, _, _ = venv.step(rng.integers(2, size=2))
        assert {bool(m) for m in np.concatenate(masks)[:, 2]} == {False, True}
        assert caplog.text == ""
        model._available(observations[::-1])  # no longer the environment's own
        assert "An observation was clipped by VecNormalize" in caplog.text

    def test_a_replay_buffer_of_dqn_is_masked(self, tmp_path: Path) -> None:
        own = {"replay_buffer_class": OptionReplayBuffer, **TABULAR}
        stock = DQN("MlpPolicy", random_task(5).env, gamma=GAMMA, **own)
        stock.learn(300)
        stock.save_replay_buffer(tmp_path / "buffer")
        task = random_task(5)
        model = OptionDQN("MlpPolicy", task.env, gamma=GAMMA, **TABULAR)
        model.load_replay_buffer(tmp_path / "buffer")
        model.learn(20)
        buffer = model._option_buffer()
        expected = env_of(model).env_method("available", buffer.next_observations_stored())[0][:, N_PRIMITIVE:]
        assert buffer.size() > 300
        assert buffer.next_available[: buffer.size()].tolist() == expected.tolist()
        assert expected.any()

    def test_a_stock_replay_buffer_is_refused(self) -> None:
        model = OptionDQN("MlpPolicy", optioned_rooms(), gamma=GAMMA, **TINY)
        model.replay_buffer = ReplayBuffer(100, model.observation_space, model.action_space)
        with pytest.raises(ValueError, match="OptionDQN needs an OptionReplayBuffer, got ReplayBuffer: set model"):
            model.learn(10)

    def test_without_a_callback_it_is_checked_and_closed_all_the_same(self) -> None:
        text = r"OptionsWrapper discounts with gamma=0\.9, OptionDQN with gamma=0\.5: give both the same"
        with pytest.raises(ValueError, match=text):
            OptionDQN("MlpPolicy", optioned_rooms(), gamma=0.5, **TINY).learn(10)
        env = optioned_rooms(2)
        env.bank.add(corridor_option(), 1)
        model = OptionDQN("MlpPolicy", env, gamma=GAMMA, **TINY)
        model.learn(10)
        assert [heads.is_closed(model.policy, 4 + slot) for slot in range(2)] == [True, False]

    def test_needs_the_wrapper(self) -> None:
        with pytest.raises(ValueError, match="The environment of OptionDQN is not wrapped in OptionsWrapper: use"):
            OptionDQN("MlpPolicy", small_rooms())

    def test_needs_the_buffer(self) -> None:
        with pytest.raises(ValueError, match=r"needs replay_buffer_class=OptionReplayBuffer, got ReplayBuffer"):
            OptionDQN("MlpPolicy", optioned_rooms(), replay_buffer_class=cast("Any", ReplayBuffer))

    def test_one_seed_one_result(self) -> None:
        def weights() -> dict[str, torch.Tensor]:
            model = OptionDQN("MlpPolicy", random_task(5).env, gamma=GAMMA, **TINY)
            model.learn(600)
            return model.policy.state_dict()

        first, second = weights(), weights()
        assert all(torch.equal(first[name], second[name]) for name in first)


def corridor_option() -> Option:
    return Option(
        place_condition(lambda p: (p >= 2) & (p < 8)),
        place_condition(lambda p: np.ones(len(p), dtype=int)),
        place_condition(lambda p: p == 8),
    )


def test_smdp_target_keeps_to_what_is_available() -> None:
    values = torch.tensor([[1.0, 2.0, 9.0, 5.0]] * 3)
    samples: Any = {
        "observations": None, "actions": torch.zeros(3, 1), "next_observations": None,
        "rewards": torch.tensor([[0.5], [0.5], [0.5]]), "discounts": torch.tensor([[0.9], [0.81], [0.9]]),
        "dones": torch.tensor([[0.0], [0.0], [1.0]]),
    }  # fmt: skip
    available = torch.tensor([[False, False], [False, True], [True, True]])
    masked = option_dqn_module.smdp_target(values, OptionReplayBufferSamples(**samples, next_available=available))
    torch.testing.assert_close(masked, torch.tensor([[0.5 + 0.9 * 2], [0.5 + 0.81 * 5], [0.5]]))
    unmasked = option_dqn_module.smdp_target(values, OptionReplayBufferSamples(**samples, next_available=None))
    torch.testing.assert_close(unmasked, torch.tensor([[0.5 + 0.9 * 9], [0.5 + 0.81 * 9], [0.5]]))


@pytest.mark.parametrize("callback", [None, PrimitiveStepsCallback])
def test_stock_dqn_without_a_callback_says_what_is_missing(callback: Any, caplog: pytest.LogCaptureFixture) -> None:
    """Nobody closes the heads of its empty slots, and nobody counts primitive steps."""
    model = DQN("MlpPolicy", optioned_rooms(), gamma=GAMMA, replay_buffer_class=OptionReplayBuffer, **TINY | RANDOM)
    model.learn(50, callback=None if callback is None else callback())
    assert caplog.text.count("pass PrimitiveStepsCallback() or SubgoalDiscoveryCallback() to learn()") == (not callback)
