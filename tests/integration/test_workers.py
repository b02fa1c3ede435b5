"""A worker process of ``SubprocVecEnv`` that is lost: a clear error soon, and nobody left behind."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecNormalize

from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback
from sb3_options.execution.workers import WorkerLostError, end_workers, watch_workers
from tests.support.clusters import wait_until
from tests.support.helpers import CountingEnv
from tests.support.sb3_helpers import TINY, make_optioned_rooms

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc to see who is left behind")


def is_there(pid: int) -> bool:
    """Whether a process runs; one that only waits for its parent to take notice does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def all_gone(pids: list[int]) -> bool:
    wait_until(lambda: not any(is_there(pid) for pid in pids))
    return True


def pids_of(venv: VecEnv) -> list[int]:
    inner = venv.unwrapped
    assert isinstance(inner, SubprocVecEnv)
    return [process.pid for process in inner.processes]


class Kill(BaseCallback):
    """Kills a worker in the middle of training."""

    def __init__(self, pid: int, at_step: int = 50) -> None:
        super().__init__()
        self.pid, self.at_step = pid, at_step

    def _on_step(self) -> bool:
        if self.n_calls == self.at_step:
            os.kill(self.pid, signal.SIGKILL)
        return True


@pytest.fixture
def workers() -> Iterator[list[SubprocVecEnv]]:
    """Whatever a test puts in is ended after it."""
    made: list[SubprocVecEnv] = []
    yield made
    for venv in made:
        end_workers(venv)


def forked(workers: list[SubprocVecEnv], n_envs: int = 3, make: Any = make_optioned_rooms) -> SubprocVecEnv:
    workers.append(SubprocVecEnv([make] * n_envs, start_method="fork"))
    return workers[-1]


def dqn(venv: VecEnv) -> DQN:
    return DQN("MlpPolicy", venv, gamma=0.9, replay_buffer_class=OptionReplayBuffer, **TINY)


@pytest.mark.parametrize(
    ("start_method", "algorithm", "callback"),
    [
        ("fork", "DQN", SubgoalDiscoveryCallback),
        ("fork", "DQN", PrimitiveStepsCallback),
        ("fork", "PPO", SubgoalDiscoveryCallback),
        pytest.param("forkserver", "DQN", SubgoalDiscoveryCallback, marks=pytest.mark.slow),
    ],
)
def test_killed_in_training(
    workers: list[SubprocVecEnv], start_method: str, algorithm: str, callback: type[BaseCallback]
) -> None:
    venv = SubprocVecEnv([make_optioned_rooms] * 3, start_method)
    workers.append(venv)
    pids = pids_of(venv)
    model: BaseAlgorithm = (
        dqn(venv) if algorithm == "DQN" else PPO("MlpPolicy", venv, gamma=0.9, n_steps=32, batch_size=32)
    )
    # Workers that were forked before it hold its pipe open, so that nothing but its end tells of it.
    kill = Kill(pids[-1])
    text = (
        rf"Environment 2 of 3 is gone: its worker process \(pid {pids[-1]}\) was killed by SIGKILL, .*memory runs out"
        r"\. The other workers have been ended too\. Make new environments"
    )
    with pytest.raises(WorkerLostError, match=text):
        model.learn(100_000, callback=[callback(), kill])
    venv.close()
    assert all_gone(pids)
    assert kill.n_calls == kill.at_step


def test_killed_beside_the_training_environment(workers: list[SubprocVecEnv]) -> None:
    training, evaluation = forked(workers, 2), VecNormalize(forked(workers, 2), gamma=0.9, training=False)
    kill = Kill(pids_of(evaluation)[1])
    callbacks = [SubgoalDiscoveryCallback(), kill, EvalCallback(evaluation, eval_freq=60, verbose=0)]
    with pytest.raises(WorkerLostError, match="Environment 1 of 2 is gone"):
        dqn(VecNormalize(training, gamma=0.9, clip_reward=np.inf)).learn(100_000, callback=callbacks)
    assert all_gone(pids_of(evaluation))


def fail_in_the_third_step(env: CountingEnv, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    if env.time == 3:
        raise ZeroDivisionError("the environment's own error")
    return np.array([float(env.time)]), 0.0, False, False, {}


def make_failing_env() -> gym.Env[Any, Any]:
    return OptionsWrapper(CountingEnv(step=fail_in_the_third_step), gamma=0.9)


def test_ended_by_an_error_in_the_environment(workers: list[SubprocVecEnv], capfd: pytest.CaptureFixture[str]) -> None:
    venv = forked(workers, 2, make_failing_env)
    watch_workers(venv)
    venv.reset()
    for _ in range(2):
        venv.step(np.zeros(2, dtype=int))
    text = r"\(pid \d+\) ended with exit code 1; if an error in the environment ended it, that stands above"
    with pytest.raises(WorkerLostError, match=text):
        venv.step(np.zeros(2, dtype=int))
    assert "ZeroDivisionError: the environment's own error" in capfd.readouterr().err


def test_ending_workers_in_the_middle_of_a_step(workers: list[SubprocVecEnv]) -> None:
    """Where an interrupt came between two answers, ``close`` would wait for one that was read already."""
    venv = forked(workers, 2)
    watch_workers(venv)
    venv.reset()
    venv.step_async(np.zeros(2, dtype=int))
    venv.remotes[0].recv()
    end_workers(venv)
    venv.close()
    assert all_gone(pids_of(venv))
