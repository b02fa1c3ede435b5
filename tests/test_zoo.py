"""`ZooOptionsWrapper` and `ZooDiscoveryCallback`, without rl-zoo3 itself."""

import sys
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_options import OptionReplayBuffer
from sb3_options.callbacks import ZooDiscoveryCallback
from sb3_options.zoo import ZooOptionsWrapper
from tests.support.sb3_helpers import FAST_DISCOVERY, RANDOM, TINY, env_of, optioned_rooms, small_rooms


def zoo_rooms(n_envs: int = 1, vec_env_cls: Any = None) -> VecEnv:
    """As rl-zoo3 makes them."""
    return make_vec_env(small_rooms, n_envs, seed=0, wrapper_class=ZooOptionsWrapper, vec_env_cls=vec_env_cls)


def model_of(venv: Any, gamma: float = 0.9) -> DQN:
    return DQN("MlpPolicy", venv, gamma=gamma, replay_buffer_class=OptionReplayBuffer, **TINY | RANDOM)


@pytest.mark.parametrize("vec_env_cls", [None, SubprocVecEnv])
def test_a_model_that_is_played_has_its_options(
    tmp_path: Path, vec_env_cls: type[VecEnv] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = model_of(zoo_rooms(vec_env_cls=vec_env_cls))
    callback = ZooDiscoveryCallback(FAST_DISCOVERY, max_new_options=1)
    model.learn(2500, callback=callback)
    model.save(tmp_path / "A.zip")
    env_of(model).close()
    assert len(callback.discoveries) == 1
    monkeypatch.setattr(sys, "argv", ["rl_zoo3/train.py", "-i", f"{tmp_path}/A.zip"])
    assert ZooOptionsWrapper(small_rooms()).bank.filled == (0,)


def test_environments_discount_as_the_algorithm() -> None:
    """rl-zoo3 draws γ in every search for hyperparameters."""
    venv = zoo_rooms(2)
    evaluation = EvalCallback(zoo_rooms(), eval_freq=20, n_eval_episodes=1)
    model_of(venv, gamma=0.8).learn(50, callback=[ZooDiscoveryCallback(), evaluation])
    assert venv.get_attr("gamma") == [0.8, 0.8]
    assert evaluation.eval_env.get_attr("gamma") == [0.8]
    assert venv.envs[0]._primitive["discount"] == 0.8  # type: ignore[attr-defined]  # a DummyVecEnv


def test_a_model_without_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["rl_zoo3/train.py", "--trained-agent", f"{tmp_path}/Rooms.zip"])
    with pytest.raises(FileNotFoundError, match=r"Rooms\.zip"):
        ZooOptionsWrapper(small_rooms())
    model_of(optioned_rooms()).save(tmp_path / "Rooms.zip")
    with pytest.raises(ValueError, match=r"Rooms\.zip"):
        ZooOptionsWrapper(small_rooms())


def test_a_worker_of_the_short_command_cannot_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["bin/rl_zoo3", "--algo", "dqn"])
    monkeypatch.setattr("multiprocessing.parent_process", lambda: object())
    with pytest.raises(ValueError, match=r"cannot tell which program runs: start `python -m rl_zoo3\.train`"):
        ZooOptionsWrapper(small_rooms())
