"""`load_checkpoint` goes on from the newest checkpoint, and refuses those of another training."""

from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_options.callbacks import CheckpointCallback, SubgoalDiscoveryCallback, load_checkpoint
from sb3_options.checkpoints.file import read
from sb3_options.discovery.methods.random_places import RandomPlaces
from sb3_options.discovery.methods.relative_novelty import RelativeNovelty
from tests.callbacks.test_checkpoint_resuming import Callbacks, discovering, model_of, venv_of
from tests.support.sb3_helpers import env_of, optioned_rooms


class TestLoadCheckpoint:
    def test_a_folder_of_another_training_is_refused(self, tmp_path: Path) -> None:
        """Its checkpoints have more steps, so that they would count as newer, and those of this one be removed."""
        model_of("PPO", venv_of()).learn(1000, [discovering(), CheckpointCallback(tmp_path, 500)])
        before = sorted(tmp_path.iterdir())
        model, callbacks = model_of("PPO", venv_of()), [discovering(), CheckpointCallback(tmp_path, 500)]
        with pytest.raises(ValueError, match=r"holds a checkpoint of [\d,]+ primitive steps, of another training"):
            model.learn(500, callbacks)
        load_checkpoint(tmp_path, model, callbacks)
        others = [discovering(), CheckpointCallback(tmp_path, 500)]
        with pytest.raises(ValueError, match=r"with the callbacks that learn\(\) is given\.$"):
            model.learn(500, others)
        assert sorted(tmp_path.iterdir()) == before

    def test_goes_on_in_a_users_own_script(self, tmp_path: Path) -> None:
        def callbacks() -> Callbacks:
            return [discovering(), CheckpointCallback(tmp_path, 500)]

        model_of("PPO", venv_of()).learn(1000, callbacks())
        model, again = model_of("PPO", venv_of()), callbacks()
        steps = load_checkpoint(tmp_path, model, again)
        assert 500 <= steps < 1000
        model.learn(1500, again)
        assert model.num_timesteps >= 1500

    def test_needs_the_callback(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match=r"needs a CheckpointCallback among the callbacks"):
            load_checkpoint(tmp_path, model_of("PPO", venv_of()), discovering())

    @pytest.mark.parametrize(
        ("changed", "text"),
        [
            ({"settings": {"min_positive": 9}}, r"settings min_positive \d+, the present one is 9"),
            ({"option_settings": {"sweeps": 7}}, r"option_settings sweeps \d+, the present one is 7"),
            ({"method": RandomPlaces()}, "method class 'RelativeNovelty', the present one is 'Random"),
            ({"method": None}, "method class 'RelativeNovelty', the present one is 'NoneType'"),
            ({"method": RelativeNovelty(lag=9)}, "method lag 7, the present one is 9"),
        ],
    )
    def test_refuses_other_settings_and_methods(self, changed: dict[str, Any], text: str, tmp_path: Path) -> None:
        method: dict[str, Any] = {"method": RelativeNovelty()}
        written = SubgoalDiscoveryCallback(**method)
        model_of("PPO", venv_of()).learn(64, [written, CheckpointCallback(tmp_path)])
        other: Callbacks = [SubgoalDiscoveryCallback(**method | changed), CheckpointCallback(tmp_path)]
        refuses(tmp_path, model_of("PPO", venv_of()), other, f"written with {text}")

    def test_refuses_what_is_otherwise(self, tmp_path: Path) -> None:
        def others() -> Callbacks:
            return [discovering(), CheckpointCallback(tmp_path)]

        model_of("PPO", venv_of()).learn(64, others())
        with pytest.raises(ValueError, match=r"^The checkpoint is of PPO, the model is A2C\.$"):
            load_checkpoint(tmp_path, model_of("A2C", venv_of()), CheckpointCallback(tmp_path))
        model = model_of("PPO", venv_of())
        model.gamma = 0.5
        env_of(model).set_attr("gamma", 0.5)
        refuses(tmp_path, model, others(), r"^The checkpoint is of training with gamma=.*, the model has gamma=0\.5")
        fewer = model_of("PPO", DummyVecEnv([lambda: optioned_rooms(2)] * 2))
        refuses(tmp_path, fewer, others(), "with 4 slots for options, and this one has 2: pass max_options=4")
        swapped = "with callback 'SubgoalDiscoveryCallback', the present one is 'Check"
        refuses(tmp_path, model_of("PPO", venv_of()), others()[::-1], swapped)
        more = r"^The checkpoint is of 2 environments, here are 4 in DummyVecEnv\.$"
        refuses(tmp_path, model_of("PPO", venv_of(4)), others(), more)


def refuses(folder: Path, model: Any, callbacks: Callbacks, text: str) -> None:
    load_checkpoint(folder, model, callbacks)
    with pytest.raises(ValueError, match=text):
        model.learn(64, callbacks)


@pytest.mark.parametrize("pos", [-1, 10**9, 0.5])
def test_refuses_a_row_outside_the_replay_buffer(pos: Any, tmp_path: Path) -> None:
    model_of("DQN", venv_of()).learn(64, CheckpointCallback(tmp_path))
    (file,) = tmp_path.glob("0*")
    state = read(file)
    state["model"]["replay_buffer"]["counters"] = (pos, *state["model"]["replay_buffer"]["counters"][1:])
    callback = CheckpointCallback(tmp_path / "rest")
    callback.resume_from(state)
    with pytest.raises(ValueError, match=rf"^The checkpoint writes to row {pos} of a buffer of \d+"):
        model_of("DQN", venv_of()).learn(64, callback)
