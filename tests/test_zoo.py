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
from sb3_options.options.archive import NAME
from sb3_options.zoo import ZooOptionsWrapper
from tests.support.sb3_helpers import FAST_DISCOVERY, RANDOM, TINY, optioned_rooms, small_rooms


def zoo_rooms(monitor_dir: Path | None, n_envs: int = 1, vec_env_cls: type[VecEnv] | None = None) -> VecEnv:
    """As rl-zoo3 makes them: the wrapper above a ``Monitor`` that writes into the folder of the run."""
    return make_vec_env(
        small_rooms,
        n_envs,
        seed=0,
        wrapper_class=lambda env: ZooOptionsWrapper(env, gamma=0.9),
        monitor_dir=None if monitor_dir is None else str(monitor_dir),
        vec_env_cls=vec_env_cls,  # type: ignore[arg-type]  # SB3 asks for one of two classes
    )


def train(venv: VecEnv, n_timesteps: int = 2500, **kwargs: Any) -> ZooDiscoveryCallback:
    callback = ZooDiscoveryCallback(FAST_DISCOVERY, max_new_options=1, **kwargs)
    model = DQN("MlpPolicy", venv, gamma=0.9, replay_buffer_class=OptionReplayBuffer, **TINY | RANDOM)
    model.learn(n_timesteps, callback=callback)
    venv.close()
    return callback


@pytest.mark.parametrize("vec_env_cls", [None, SubprocVecEnv])
def test_options_are_kept_beside_what_monitor_writes(tmp_path: Path, vec_env_cls: type[VecEnv] | None) -> None:
    callback = train(zoo_rooms(tmp_path, vec_env_cls=vec_env_cls))
    assert len(callback.discoveries) == 1
    assert ZooOptionsWrapper(small_rooms(), options_file=tmp_path / NAME).bank.filled == (0,)


def test_a_search_may_draw_the_discount(tmp_path: Path) -> None:
    """rl-zoo3 draws γ in every search for hyperparameters, which keeps no runs."""
    venv = zoo_rooms(None, 2)
    evaluation = EvalCallback(zoo_rooms(None), eval_freq=20, n_eval_episodes=1)
    model = DQN("MlpPolicy", venv, gamma=0.8, replay_buffer_class=OptionReplayBuffer, **TINY)
    model.learn(50, callback=[ZooDiscoveryCallback(), evaluation])
    assert venv.get_attr("gamma") == [0.8, 0.8]
    assert evaluation.eval_env.get_attr("gamma") == [0.8]
    assert venv.envs[0]._primitive["discount"] == 0.8  # type: ignore[attr-defined]  # a DummyVecEnv


def test_callback_needs_its_wrapper() -> None:
    model = DQN("MlpPolicy", optioned_rooms(), gamma=0.9, replay_buffer_class=OptionReplayBuffer, **TINY)
    with pytest.raises(ValueError, match=r"needs ZooOptionsWrapper, .* write `env_wrapper: sb3_options\.zoo\.Zoo"):
        model.learn(50, callback=ZooDiscoveryCallback())


def test_a_run_without_options_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["rl_zoo3/train.py", "--trained-agent", f"{tmp_path}/Rooms.zip"])
    with pytest.raises(FileNotFoundError, match=r"no options in .*Rooms\.zip, and there is no .* name an options_file"):
        ZooOptionsWrapper(small_rooms())
    DQN("MlpPolicy", optioned_rooms(), gamma=0.9, replay_buffer_class=OptionReplayBuffer, **TINY).save(
        tmp_path / "Rooms.zip"
    )
    with pytest.raises(FileNotFoundError, match=r"no options in .*Rooms\.zip.* Train with Zoo"):
        ZooOptionsWrapper(small_rooms())


def test_a_model_that_was_moved_without_its_options_file_has_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    callback = train(zoo_rooms(tmp_path))
    (tmp_path / NAME).unlink()
    callback.model.save(tmp_path / "A.zip")
    monkeypatch.setattr(sys, "argv", ["rl_zoo3/train.py", "-i", f"{tmp_path}/A.zip"])
    assert ZooOptionsWrapper(small_rooms()).bank.filled == (0,)


def test_a_worker_of_the_short_command_cannot_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["bin/rl_zoo3", "--algo", "dqn"])
    monkeypatch.setattr("multiprocessing.parent_process", lambda: object())
    with pytest.raises(ValueError, match=r"cannot tell which program runs: start `python -m rl_zoo3\.train`"):
        ZooOptionsWrapper(small_rooms())
