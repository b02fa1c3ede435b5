from collections.abc import Callable
from itertools import pairwise
from typing import Any, cast

import numpy as np
import pytest
from sb3_contrib import MaskablePPO
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_options import Option, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import PrimitiveStepsCallback
from sb3_options.execution.above import monitor_primitive_steps
from tests.callbacks.doorway import finds_nothing
from tests.support.helpers import CountingEnv, steady_option
from tests.support.sb3_helpers import RANDOM, StepLog, optioned_rooms, small_rooms

K = 5


def counting(**kwargs: Any) -> OptionsWrapper:
    """Rewards 1, 2, 3, … with an option of `K` steps in slot 0."""
    wrapped = OptionsWrapper(StepLog(CountingEnv(**kwargs)), 2, gamma=0.9)
    wrapped.bank.add(steady_option(max_duration=K))
    return wrapped


def dqn(env: Any, **kwargs: Any) -> DQN:
    return DQN(
        "MlpPolicy", env, gamma=0.9, replay_buffer_class=OptionReplayBuffer, buffer_size=2000, learning_starts=100,
        train_freq=1, gradient_steps=0, policy_kwargs={"net_arch": [8]}, seed=0, **kwargs,
    )  # fmt: skip


def corridor() -> OptionsWrapper:
    """Every episode is 30 steps of −1, for the goal is too far away."""
    return optioned_rooms(map=f"{'#' * 50}\n#S{'.' * 46}G#\n{'#' * 50}", max_steps=30, step_reward=-1.0)


def ones(observations: Any) -> Any:
    return np.ones(len(observations), dtype=np.int64)


def zeros(observations: Any) -> Any:
    return np.zeros(len(observations), dtype=np.int64)


def masked_and_monitored() -> Any:
    """What a worker process calls."""
    rooms = corridor()
    rooms.bank.add(Option(ones, zeros, zeros, max_duration=7))
    return Monitor(ActionMasker(rooms, lambda env: env.get_wrapper_attr("action_masks")()))


class Spy(BaseCallback):
    """Keeps ``num_timesteps`` after each call of step, and the durations that infos report."""

    def __init__(self) -> None:
        super().__init__()
        self.counted: list[int] = []
        self.durations: list[int] = []

    def _on_step(self) -> bool:
        self.counted.append(self.num_timesteps)
        self.durations.append(sum(info["option"]["duration"] for info in self.locals["infos"]))
        return True


class Rollouts(BaseCallback):
    """Keeps how many decisions and primitive steps each rollout had, and how many steps were taken at its end."""

    def __init__(self) -> None:
        super().__init__()
        self.sizes: list[tuple[int, int]] = []
        self.ends: list[int] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        buffer = self.model.rollout_buffer  # type: ignore[attr-defined]  # it is on-policy
        self.sizes.append((buffer.buffer_size, int(buffer.durations.sum())))
        self.ends.append(self.num_timesteps)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("algorithm", ["DQN", "PPO", "A2C"])
def test_counts_the_sum_of_durations(algorithm: str, n_envs: int) -> None:
    venv = DummyVecEnv([lambda: counting(terminate_at=17)] * n_envs)
    kwargs: dict[str, Any] = {"n_steps": 8, "gamma": 0.9, "seed": 0}
    makers: dict[str, Callable[[], BaseAlgorithm]] = {
        "DQN": lambda: dqn(venv, **RANDOM),
        "PPO": lambda: PPO("MlpPolicy", venv, batch_size=8, **kwargs),
        "A2C": lambda: A2C("MlpPolicy", venv, **kwargs),
    }
    model = makers[algorithm]()
    spy = Spy()
    model.learn(500, callback=[PrimitiveStepsCallback(), spy])
    ran = sum(len(log) for log in venv.get_attr("log"))
    assert model.num_timesteps == ran == sum(spy.durations)
    assert spy.counted == np.cumsum(spy.durations).tolist()
    assert max(spy.durations) > n_envs  # an option ran
    if algorithm == "DQN":
        # It stops after the very step that used up the budget.
        assert spy.counted[-2] < 500 <= spy.counted[-1] < 500 + K * n_envs


def test_schedules_see_primitive_steps() -> None:
    """ε falls over primitive steps: after half of them it is where stock SB3 has it after half of its steps."""
    model = dqn(counting(terminate_at=17), exploration_fraction=1.0)
    rates: list[tuple[int, float]] = []

    class Rates(BaseCallback):
        def _on_step(self) -> bool:
            rates.append((self.num_timesteps, cast("DQN", self.model).exploration_rate))
            return True

    model.learn(600, callback=[PrimitiveStepsCallback(), Rates()])
    for (before, _), (_, rate) in pairwise(rates):
        assert rate == pytest.approx(1.0 - 0.95 * min(before / 600, 1.0), abs=1e-9)


def test_moves_the_progress_bar_along() -> None:
    totals = []

    class Bar(ProgressBarCallback):
        def _on_training_end(self) -> None:
            totals.append((self.pbar.n, self.pbar.total))
            super()._on_training_end()

    model = dqn(counting(terminate_at=17), **RANDOM)
    model.learn(500, callback=[PrimitiveStepsCallback(), Bar()])
    assert totals == [(model.num_timesteps, 500)]


class TestMonitor:
    @pytest.mark.parametrize("subproc", [False, True])
    def test_above_others_and_in_worker_processes(self, subproc: bool) -> None:
        make = [masked_and_monitored] * 2
        venv: VecEnv = SubprocVecEnv(make, start_method="fork") if subproc else DummyVecEnv(make)
        try:
            model = MaskablePPO("MlpPolicy", venv, gamma=0.9, n_steps=64, seed=0, device="cpu")
            model.learn(600, callback=PrimitiveStepsCallback())
            episodes = list(cast("Any", model.ep_info_buffer))
            assert len(episodes) > 5
            assert {episode["l"] for episode in episodes} == {30}
            assert {episode["r"] for episode in episodes} == {-30.0}
        finally:
            venv.close()

    def test_leaves_others_alone(self) -> None:
        bare = DummyVecEnv([lambda: Monitor(small_rooms())])
        monitor = bare.envs[0]
        monitor_primitive_steps(bare)
        assert bare.envs[0] is monitor


@pytest.mark.parametrize("callback", [PrimitiveStepsCallback, finds_nothing])
def test_a_rollout_ends_with_the_budget(callback: Any, caplog: pytest.LogCaptureFixture) -> None:
    """Where SB3's own last rollout would have ended, had every action been one step."""
    env = optioned_rooms(2)
    env.bank.add(steady_option(3, max_duration=40))
    rollouts = Rollouts()
    model = PPO("MlpPolicy", env, gamma=0.9, n_steps=64, batch_size=64, n_epochs=1, seed=0, device="cpu")
    model.learn(3000, callback=[callback(), rollouts])
    assert 3008 <= model.num_timesteps < 3008 + 40  # 47 rollouts of 64 steps
    assert rollouts.ends[-1] <= 3008
    assert model._n_updates == len(rollouts.ends)
    assert caplog.text == ""
    model.learn(100, callback=callback(), reset_num_timesteps=False)
    assert "ended before its first update: its rollouts of n_steps=64 decisions" in caplog.text


@pytest.mark.parametrize("order", [1, -1])
def test_two_callbacks_that_count_count_once(order: int) -> None:
    env = optioned_rooms(2)
    env.bank.add(steady_option(3, max_duration=4))
    model, spy = dqn(env, **RANDOM), Spy()
    both: list[BaseCallback] = [PrimitiveStepsCallback(), finds_nothing()]
    model.learn(300, callback=[*both[::order], spy])
    assert model.num_timesteps == sum(spy.durations)
    assert spy.counted == np.cumsum(spy.durations).tolist()


@pytest.mark.parametrize("algorithm", [DQN, PPO, A2C])
def test_no_schedule_sees_less_than_no_progress(algorithm: Any) -> None:
    """With options of many steps the last rollout, or the last steps of one, lie far beyond the budget."""
    seen: list[float] = []

    def linear(progress_remaining: float) -> float:
        seen.append(progress_remaining)
        return progress_remaining * 1e-3

    env = counting(terminate_at=170)
    env.set_option(0, steady_option(max_duration=20))
    if algorithm is DQN:
        model: Any = dqn(env, learning_rate=linear, **RANDOM)
        model.gradient_steps, model.learning_starts = 1, 10
    else:
        rollouts = {"n_steps": 32} | ({"batch_size": 32} if algorithm is PPO else {})
        model = algorithm("MlpPolicy", env, gamma=0.9, learning_rate=linear, seed=0, device="cpu", **rollouts)
    model.learn(990, callback=PrimitiveStepsCallback())
    assert model.num_timesteps > 990
    assert model._n_updates > 0
    assert min(seen) >= 0.0
