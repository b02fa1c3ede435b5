"""Every ``VecEnv`` of SB3, and every wrapper around it: same rollouts, same weights, options in step everywhere."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnv,
    VecFrameStack,
    VecNormalize,
)

from sb3_options import OptionDQN, OptionReplayBuffer, OptionsWrapper
from sb3_options.execution.vec_env import as_wrapper_sees
from sb3_options.options.option import SubgoalOption
from tests.callbacks.doorway import banks, content, discovered
from tests.support.sb3_helpers import RANDOM, TINY, fast_callback, optioned_rooms, small_rooms

SLOT_0 = 4
PPO_TINY: dict[str, Any] = {
    "policy_kwargs": {"net_arch": [16]}, "n_steps": 64, "batch_size": 64, "n_epochs": 1, "ent_coef": 0.05, "seed": 0,
}  # fmt: skip


def make_monitored_rooms() -> gym.Env[Any, Any]:
    """What a worker process calls."""
    return OptionsWrapper(Monitor(small_rooms()), gamma=0.9)


@contextmanager
def rooms(kind: str, n_envs: int) -> Iterator[VecEnv]:
    """``n_envs`` monitored small rooms with options, in this process or in workers."""
    makers: list[Callable[[], gym.Env[Any, Any]]] = [make_monitored_rooms] * n_envs
    venv = SubprocVecEnv(makers, start_method="fork") if kind == "subproc" else DummyVecEnv(makers)
    venv.seed(7)
    try:
        yield venv
    finally:
        venv.close()


def dqn(venv: VecEnv, algorithm: Any = DQN, **kwargs: Any) -> Any:
    keywords = TINY | RANDOM | {"gamma": 0.9, "learning_starts": 50} | kwargs
    if algorithm is not OptionDQN:
        keywords["replay_buffer_class"] = OptionReplayBuffer
    return algorithm("MlpPolicy", venv, **keywords)


def ppo(venv: VecEnv, **kwargs: Any) -> PPO:
    return PPO("MlpPolicy", venv, gamma=0.9, **PPO_TINY | kwargs)


@pytest.fixture(scope="module")
def doorway() -> SubgoalOption:
    """The option that discovery makes of the doorway."""
    callback = fast_callback()
    dqn(DummyVecEnv([optioned_rooms])).learn(1500, callback=callback)
    return discovered(callback.bank).bind(None)


Row = tuple[Any, ...]


def rollout(venv: VecEnv, doorway: SubgoalOption, n_steps: int) -> list[Row]:
    """What comes back for a fixed sequence of actions; the option arrives, changes its slot and leaves on the way."""
    rng = np.random.default_rng(3)
    rows: list[Row] = [(venv.reset(),)]
    for step in range(n_steps):
        if step == n_steps // 4:
            venv.env_method("set_option", 0, doorway)
        if step == n_steps // 2:
            venv.env_method("set_option", 2, doorway)
            venv.env_method("set_option", 0, None)
        observations: Any
        observations, rewards, dones, infos = venv.step(rng.integers(8, size=venv.num_envs))
        ends = [{k: v for k, v in info.get("episode", {}).items() if k != "t"} for info in infos]
        rows.append((np.copy(observations), rewards, dones, [info["option"] for info in infos], ends))
    return rows


@pytest.mark.parametrize("n_envs", [1, 8])
def test_identical_rollouts_in_one_process_and_in_workers(n_envs: int, doorway: SubgoalOption) -> None:
    with rooms("dummy", n_envs) as here, rooms("subproc", n_envs) as workers:
        expected, got = rollout(here, doorway, 400), rollout(workers, doorway, 400)
    for mine, theirs in zip(expected, got, strict=True):
        np.testing.assert_equal(theirs, mine)
    options = [option for row in expected[1:] for option in row[3]]
    assert {option["index"] for option in options} == {-1, 0, 2}
    assert max(option["duration"] for option in options) > 2
    assert any(end for row in expected[1:] for end in row[4])


@pytest.mark.parametrize("algorithm", [OptionDQN, PPO])
def test_same_weights_bit_for_bit(algorithm: Any) -> None:
    weights, discoveries = [], []
    for kind in ("dummy", "subproc"):
        with rooms(kind, 2) as venv:
            model = ppo(venv) if algorithm is PPO else dqn(venv, algorithm)
            callback = fast_callback(option_settings={"grow": True})
            model.learn(2000, callback=callback)
            weights.append({name: value.clone() for name, value in model.policy.state_dict().items()})
            discoveries.append([(d.slot, d.episode, d.timestep, d.subgoal.tolist()) for d in callback.discoveries])
    assert discoveries[0] == discoveries[1]
    assert len(discoveries[0]) == 1
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def stacked(venv: VecEnv) -> VecEnv:
    return VecFrameStack(venv, 3)


def normalized(venv: VecEnv) -> VecEnv:
    return VecNormalize(venv, gamma=0.9, clip_reward=np.inf)


def checked(venv: VecEnv) -> VecEnv:
    return VecCheckNan(normalized(stacked(venv)), True)


@pytest.mark.parametrize(
    ("around", "algorithm"),
    [(normalized, DQN), (checked, OptionDQN), (checked, PPO)],
)
def test_trains_and_discovers_within(around: Callable[[VecEnv], VecEnv], algorithm: Any) -> None:
    with rooms("dummy", 2) as bare:
        venv = around(bare)
        buffer = {"replay_buffer_kwargs": {"macro_q": around is normalized}}
        model: BaseAlgorithm = ppo(venv) if algorithm is PPO else dqn(venv, algorithm, **buffer)
        used: list[int] = []
        callback = fast_callback()
        n_timesteps = 4000 if algorithm is PPO else 2500
        model.learn(n_timesteps, callback=[callback, Spy(lambda spy: used.extend(spy.durations()))])
        assert len(callback.discoveries) == 1
        np.testing.assert_allclose(callback.discoveries[0].subgoal, (4.0, 2.0), atol=1.0)
        assert max(used) > 2
        assert model.num_timesteps >= n_timesteps
        assert all(torch.isfinite(value).all() for value in model.policy.state_dict().values())


class Spy(BaseCallback):
    """Looks on after every step."""

    def __init__(self, look: Callable[["Spy"], Any]) -> None:
        super().__init__()
        self.look = look

    def durations(self) -> list[int]:
        return [info["option"]["duration"] for info in self.locals["infos"] if info["option"]["index"] >= 0]

    def _on_step(self) -> bool:
        self.look(self)
        return True


class TestStackedFrames:
    def test_stored_transitions_know_which_options_may_start(self) -> None:
        with rooms("dummy", 2) as bare:
            model = dqn(stacked(bare), OptionDQN, replay_buffer_kwargs={"macro_q": False})
            callback = fast_callback()
            model.learn(2000, callback=callback)
            buffer = model.replay_buffer
            newest: Any = as_wrapper_sees(model.env, buffer.next_observations_stored())
            assert newest.shape == (buffer.size(), 45)
            expected = bare.env_method("available", newest, indices=[0])[0][:, SLOT_0:]
            np.testing.assert_array_equal(buffer.next_available[: buffer.size()], expected)
            assert 0 < expected[:, 0].sum() < buffer.size()

    def test_macro_q_is_refused_before_training(self) -> None:
        with rooms("dummy", 1) as bare:
            model = dqn(stacked(bare))
            text = r"never stacked by VecFrameStack.*DQN\(\.\.\., replay_buffer_kwargs=\{'macro_q': False\}\), or stack"
            with pytest.raises(ValueError, match=text):
                model.learn(2000, callback=fast_callback())
            assert model.num_timesteps == 0


class TestEvaluationEnvironment:
    @pytest.mark.parametrize(
        ("kind", "around", "algorithm"), [("subproc", lambda venv: venv, DQN), ("dummy", normalized, PPO)]
    )
    def test_has_every_option_at_the_same_decision(self, kind: str, around: Any, algorithm: Any) -> None:
        """Also when options learn further."""
        with rooms(kind, 2) as train_rooms, rooms(kind, 1) as eval_rooms:
            train_env, eval_env = around(train_rooms), around(eval_rooms)
            model: BaseAlgorithm = ppo(train_env) if algorithm is PPO else dqn(train_env)
            evaluation = EvalCallback(eval_env, n_eval_episodes=1, eval_freq=500, verbose=0)
            discovery = fast_callback(option_settings={"grow": True})
            versions: set[str] = set()

            def compare(_: Spy) -> None:
                states = {repr(content(bank)) for bank in (*banks(train_env), *banks(eval_env))}
                assert len(states) == 1
                versions.update(states)

            model.learn(3000, callback=[evaluation, discovery, Spy(compare)])
            assert len(discovery.discoveries) == 1
            assert len(versions) > 2  # none, the first, one that has learned further
