"""Options end where something else is worth more: on known MDPs, and in every kind of environment."""

import pickle
from typing import Any

import numpy as np
import pytest
import torch
from sb3_contrib import QRDQN
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)

from sb3_options import OptionDQN, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.execution.interruption import Interruption
from sb3_options.experience.observations import FloatArray, batch_of_one
from sb3_options.learning import heads
from sb3_options.learning.value_snapshot import ValueSnapshot, interrupt_options
from tests.support.helpers import TableEnv, steady_option, table_option
from tests.support.sb3_helpers import (
    RANDOM,
    TINY,
    Corridor,
    TableOption,
    corridor_option,
    env_of,
    fast_callback,
    make_optioned_rooms,
    optioned_rooms,
    places,
)

GAMMA = 0.9
N_STATES, N_PRIMITIVE = 10, 3


class KnownMDP:
    """A random MDP with one option, whose values are solved exactly."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.env = TableEnv(rng, N_STATES, N_PRIMITIVE)
        self.env.time_limit = 10**9
        self.env.terminal = np.arange(N_STATES) == 0
        self.env.rewards -= 1.0  # so that ways differ
        self.option = TableOption(
            (rng.random(N_STATES) < 0.9).tolist(),
            rng.integers(N_PRIMITIVE, size=N_STATES).tolist(),
            (rng.random(N_STATES) < 0.2).tolist(),
            max_duration=10**6,
        )
        self.primitive = (
            rng.random((N_STATES, N_PRIMITIVE)) / 50
        )  # a policy that knows no better: ties broken at random
        self.q = self.solved()

    def after(self, state: int, action: int, value: FloatArray) -> float:
        """R + γ E[V(s')]."""
        led = self.env.successors[state, action]
        return float(self.env.rewards[state, action] + GAMMA * np.mean([(s != 0) * value[s] for s in led]))

    def goes_on(self, state: int) -> bool:
        return self.option.initiation[state] and not self.option.termination[state]

    def solved(self) -> FloatArray:
        """Q^μ(s, ·) of μ: the option where it may start, else a fixed primitive; (states, actions + option)."""
        begins = np.array(self.option.initiation)
        fixed = self.primitive.argmax(axis=1)
        value, running = np.zeros(N_STATES), np.zeros(N_STATES)
        for _ in range(300):
            onward = np.where([self.goes_on(s) for s in range(N_STATES)], running, value)
            running = np.array([self.after(s, self.option.policy[s], onward) for s in range(N_STATES)])
            value = np.where(begins, running, [self.after(s, fixed[s], value) for s in range(N_STATES)])
        q = np.array([[self.after(s, a, value) for a in range(N_PRIMITIVE)] for s in range(N_STATES)])
        return np.column_stack([q, running])

    def mean_return(
        self, start: int, episodes: int, rule: Interruption | None = None, *, greedy: bool
    ) -> tuple[float, float, set[str]]:
        """From ``start``, of μ or of greedy choices after its first; standard error, how options ended."""
        wrapped = OptionsWrapper(self.env, 1, gamma=GAMMA)
        wrapped.bank.add(table_option(*self.option[:3], max_duration=10**6))
        wrapped.set_slots(interruption=rule)
        fixed, returns, endings = self.primitive.argmax(axis=1), [], set()
        wrapped.reset(seed=int(start))
        for _ in range(episodes):
            wrapped.reset()
            self.env.state, wrapped._observation = start, start
            state, total, discount = start, 0.0, 1.0
            while discount > 1e-3:
                begins = self.option.initiation[state]
                action = N_PRIMITIVE if begins else int(fixed[state])
                if greedy and discount < 1.0:  # after the first choice
                    action = int(np.where(wrapped.action_masks(), self.q[state], -np.inf).argmax())
                state, reward, over, _, info = wrapped.step(action)
                total += discount * float(reward)
                discount *= info["option"]["discount"]
                endings.add(info["option"]["termination"])
                if over:
                    break
            returns.append(total)
        return float(np.mean(returns)), float(np.std(returns) / episodes**0.5), endings


@pytest.mark.parametrize("seed", range(3))
def test_with_interruption_a_policy_is_as_good_everywhere_and_better_somewhere(seed: int) -> None:
    """Sutton, Precup & Singh 1999, Theorem 2: the option of μ from every state of I, interrupted by Q^μ or not."""
    mdp = KnownMDP(seed)
    rule = Interruption(lambda s: mdp.q[int(s)], masks=True, every_choice=True)
    gains, endings = [], set()
    for start in (np.flatnonzero(mdp.option.initiation[1:]) + 1).tolist():
        value = mdp.q[start, N_PRIMITIVE]
        plain, error, ends = mdp.mean_return(start, 60, greedy=False)
        assert abs(plain - value) < 4.5 * error + 0.02  # the values are those of μ
        assert "interrupted" not in ends
        interrupted, error, ends = mdp.mean_return(start, 60, rule, greedy=True)
        assert interrupted > value - 4.5 * error - 0.02
        gains.append(interrupted - value)
        endings |= ends
    assert "interrupted" in endings
    assert max(gains) > 0.3


class TestRule:
    values = np.array([[0.0, 3.0, 2.0, 2.5], [0.0, 1.0, 1.5, 2.0]])

    def falls_behind(self, state: int, action: int, mask: list[bool] | None = None) -> bool:
        rule = Interruption(lambda s: self.values[s], mask is not None)
        return rule.falls_behind(action, state, lambda: np.array(mask))

    def test_compares_with_the_best(self) -> None:
        assert self.falls_behind(0, 2)
        assert not self.falls_behind(1, 3)

    def test_compares_with_what_is_available(self) -> None:
        assert self.falls_behind(0, 2, [True, False, True, True])
        assert not self.falls_behind(0, 2, [True, False, True, False])


def line_of(n: int, option_values: list[float], rule: dict[str, Any]) -> tuple[int, str]:
    """Runs of the option "right" from place 0 on, on a line, by the given values; primitives are worth 1."""
    wrapped = OptionsWrapper(Corridor("discrete"), 2, gamma=GAMMA)
    wrapped.bank.add(table_option([True] * 12, [1] * 12, [False] * 12, max_duration=n), 1)
    wrapped.reset(seed=0)
    wrapped.unwrapped.place = 0  # type: ignore[attr-defined]  # a Corridor
    wrapped._observation = 0
    wrapped.set_slots(interruption=Interruption(lambda s: np.array([0.0, 1.0, 0.0, option_values[int(s)]]), **rule))
    info = wrapped.step(3)[4]["option"]
    return info["duration"], info["termination"]


def test_a_greedy_choice_is_interrupted_where_it_falls_behind() -> None:
    assert line_of(6, [1.0, 1.5, 1.0, 0.9, 0.9, 1.0, 1.0], {}) == (3, "interrupted")


def test_an_exploratory_choice_runs_to_its_end() -> None:
    assert line_of(6, [0.9] * 7, {}) == (6, "max_duration")


def test_an_end_of_its_own_comes_first() -> None:
    assert line_of(3, [1.0, 1.0, 1.0, 0.0], {}) == (3, "max_duration")


class TestSnapshot:
    def model(self, algorithm: Any, env: Any, policy: str = "MlpPolicy", **kwargs: Any) -> Any:
        return algorithm(
            policy, env, gamma=GAMMA, replay_buffer_class=OptionReplayBuffer, buffer_size=300, seed=0,
            learning_starts=10, **kwargs,
        )  # fmt: skip

    def corridor(self, kind: str, *, normalized: bool = False) -> VecEnv:
        def make() -> OptionsWrapper:
            wrapped = OptionsWrapper(Corridor(kind), 1, gamma=GAMMA, feature_map=places)
            wrapped.bank.add(corridor_option())
            return wrapped

        venv: VecEnv = DummyVecEnv([make])
        venv = VecTransposeImage(venv) if kind in ("image", "dict") else venv
        return VecNormalize(venv, gamma=GAMMA) if normalized else venv

    @pytest.mark.parametrize("kind", ["box", "discrete", "dict", "dict_discrete", "image", "box normalized"])
    @pytest.mark.parametrize("algorithm", [DQN, QRDQN, OptionDQN])
    def test_is_the_networks_own_output(self, algorithm: Any, kind: str) -> None:
        kind, _, normalized = kind.partition(" ")
        policy = {"dict": "MultiInputPolicy", "dict_discrete": "MultiInputPolicy", "image": "CnnPolicy"}
        venv = self.corridor(kind, normalized=bool(normalized))
        model = self.model(algorithm, venv, policy.get(kind, "MlpPolicy"))
        model.learn(30)
        snapshot = pickle.loads(pickle.dumps(ValueSnapshot(model)))
        bare = Corridor(kind)
        for place in (0, 3, 9):
            seen = bare.see(place)
            as_batch: Any = batch_of_one(seen)
            if kind == "image":
                as_batch = np.moveaxis(as_batch, -1, 1)
            if kind == "dict":
                as_batch["picture"] = np.moveaxis(as_batch["picture"], -1, 1)
            if isinstance(venv, VecNormalize):
                as_batch = venv.normalize_obs(as_batch)
            with torch.no_grad():
                network = heads.networks(model.policy)[0]
                network.eval()
                out = network(model.policy.obs_to_tensor(as_batch)[0])[0]
            expected = out.mean(dim=0) if algorithm is QRDQN else out
            np.testing.assert_allclose(snapshot(seen), expected.numpy(), rtol=1e-5, atol=1e-5)

    def test_does_not_change_with_the_model(self) -> None:
        model = self.model(DQN, self.corridor("box"))
        snapshot = ValueSnapshot(model)
        before = snapshot(Corridor().see(3))
        for layer, _ in heads.option_outputs(model.policy):
            torch.nn.init.zeros_(layer.weight)
        assert np.array_equal(snapshot(Corridor().see(3)), before)


@pytest.mark.parametrize("workers", [False, True])
def test_reaches_training_and_evaluation(workers: bool) -> None:
    def make() -> OptionsWrapper:
        return optioned_rooms()

    venv: VecEnv = SubprocVecEnv([make_optioned_rooms] * 2) if workers else DummyVecEnv([make, make])
    evaluation: VecEnv = SubprocVecEnv([make_optioned_rooms]) if workers else DummyVecEnv([make])
    model = OptionDQN("MlpPolicy", venv, gamma=GAMMA, **TINY | RANDOM)
    beside = EvalCallback(evaluation, eval_freq=10**6, verbose=0)
    callback = fast_callback()
    model.learn(3000, callback=[callback, beside])
    assert callback.discoveries
    rules = [each.interruption for one in (venv, evaluation) for each in one.get_attr("slot_state")]
    assert [rule.every_choice for rule in rules] == [False, False, True]
    assert all(rule.masks for rule in rules)
    seen = np.eye(45, dtype=np.float32)[7]
    with torch.no_grad():
        expected = model.q_net(torch.as_tensor(seen)[None])[0].numpy()
    assert all(np.allclose(rule.values(seen), expected, atol=1e-5) for rule in rules)
    venv.close()
    evaluation.close()


def test_an_algorithm_without_values_of_options_runs_them_to_their_ends() -> None:
    env = optioned_rooms()
    env.bank.add(steady_option())
    model = PPO("MlpPolicy", env, gamma=GAMMA, n_steps=64, device="cpu")
    model.learn(64, callback=SubgoalDiscoveryCallback(max_new_options=0))
    assert env.slot_state.interruption is None
    assert not interrupt_options(model, env_of(model))


def test_beneath_stacked_frames_options_run_to_their_ends() -> None:
    venv = VecFrameStack(DummyVecEnv([optioned_rooms]), 2)
    model = DQN(
        "MlpPolicy",
        venv,
        gamma=GAMMA,
        replay_buffer_class=OptionReplayBuffer,
        replay_buffer_kwargs={"macro_q": False},
        **TINY | RANDOM,
    )
    model.learn(3000, callback=fast_callback())
    assert len(venv.get_attr("bank")[0]) == 1
    assert venv.get_attr("slot_state")[0].interruption is None
