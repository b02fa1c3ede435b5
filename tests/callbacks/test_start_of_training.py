"""What both callbacks do, when training starts, with what earlier trainings and users left behind."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sb3_contrib import QRDQN
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_options import MacroQ, OptionDQN, OptionsWrapper
from sb3_options.callbacks import CheckpointCallback, PrimitiveStepsCallback, SubgoalDiscoveryCallback
from sb3_options.checkpoints.file import read
from sb3_options.execution.exploration import CappedActions
from sb3_options.learning import heads
from tests.callbacks.doorway import N_PRIMITIVE, finds_nothing, model_of, with_option
from tests.callbacks.test_checkpoint_resuming import check_resumes
from tests.callbacks.test_installer import option_from
from tests.support.helpers import steady_option
from tests.support.sb3_helpers import env_of, optioned_rooms

both = pytest.mark.parametrize("callback", [PrimitiveStepsCallback, finds_nothing])


def rows_of(model: Any, slot: int = 0) -> int:
    """How many stored transitions name a slot."""
    buffer = model.replay_buffer
    return int((buffer.actions[: buffer.size()] == N_PRIMITIVE + slot).sum())


def go_on(model: Any, callback: BaseCallback, steps: int = 300) -> None:
    model.learn(steps, callback=callback, reset_num_timesteps=False)


def before_the_first_step(model: Any, *callbacks: BaseCallback) -> None:
    """Start training, and end it."""
    model.learn(1, callback=[*callbacks, ConvertCallback(lambda *_: False)], reset_num_timesteps=False)


class TestEmptied:
    """A slot that the user has emptied."""

    @both
    @pytest.mark.parametrize("algorithm", [DQN, QRDQN, OptionDQN])
    def test_is_forgotten(self, algorithm: Any, callback: Any, caplog: pytest.LogCaptureFixture) -> None:
        env = with_option()
        model = model_of(env, algorithm, learning_rate=1e-2)
        model.learn(600, callback=callback())
        assert rows_of(model) > 20
        env.set_option(0, None)
        go_on(model, callback())
        assert "Slot 0 is empty, and the model has learned what an option there is worth" in caplog.text
        assert "Slot 1" not in caplog.text
        assert rows_of(model) == 0
        assert not model.replay_buffer.next_available.any()
        for layer, outputs in heads.option_outputs(model.policy):
            rows = heads.rows_of(layer, outputs, N_PRIMITIVE)
            assert (layer.weight[rows] == 0.0).all()
            assert (layer.bias[rows] == heads.CLOSED_VALUE).all()
        layer, outputs = heads.option_outputs(model.policy)[0]
        rows = heads.rows_of(layer, outputs, N_PRIMITIVE)
        assert (model.policy.optimizer.state[layer.weight]["exp_avg"][rows] == 0.0).all()

    @both
    def test_is_forgotten_by_a_table(self, callback: Any, caplog: pytest.LogCaptureFixture) -> None:
        env = with_option()
        model = MacroQ(env, gamma=0.9, seed=0)
        with torch.no_grad():
            model.policy.weights[:, N_PRIMITIVE] = 1.0
        before_the_first_step(model, callback())
        assert caplog.text == ""
        assert model.policy.table()[:, N_PRIMITIVE].all()
        env.set_option(0, None)
        before_the_first_step(model, callback())
        assert not model.policy.table()[:, N_PRIMITIVE].any()
        assert caplog.text.count("is empty, and the model has learned what an option there is worth") == 1

    @both
    def test_is_explored_no_longer(self, callback: Any) -> None:
        env = with_option()
        model = model_of(env)
        model.learn(50, callback=SubgoalDiscoveryCallback(max_new_options=0, use={"max_option_exploration": 0.0}))
        env.set_option(0, None)
        env.set_option(1, steady_option(2, max_duration=2))
        go_on(model, callback(), 50)
        assert isinstance(model.action_space, CappedActions)
        assert model.action_space.filled == (1,)


@both
def test_a_loaded_model_whose_options_are_put_back_has_forgotten_nothing(callback: Any, tmp_path: Path) -> None:
    """`OptionDQN` closes empty slots too, and before callbacks do anything."""
    env = optioned_rooms(2)
    env.bank.add(option_from(0, 1, 2, 3))
    model = model_of(env, OptionDQN)
    model.learn(1000, callback=callback())
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer")
    again = OptionDQN.load(tmp_path / "model.zip", env=(later := optioned_rooms(2)))
    again.load_replay_buffer(tmp_path / "buffer")
    before_the_first_step(again, callback())
    assert later.bank.filled == (0,)
    assert rows_of(again) == rows_of(model) > 0
    for mine, other in zip(heads.option_outputs(again.policy), heads.option_outputs(model.policy), strict=True):
        assert torch.equal(mine[0].weight, other[0].weight)


class TestCheckpoints:
    @pytest.mark.usefixtures("keep_all")
    @pytest.mark.parametrize("algorithm", [DQN, OptionDQN])
    def test_goes_on_from_a_checkpoint(self, algorithm: Any, tmp_path: Path) -> None:
        def make() -> Any:
            env = with_option()
            env.bank.add(option_from(0, 1))
            return model_of(DummyVecEnv([lambda: env]), algorithm)

        _, files = check_resumes(make, lambda: [PrimitiveStepsCallback()], tmp_path, cuts=(0.6,), steps=900)
        (state,) = (each["own"] for each in read(files[-1])["callbacks"] if each["class"] == "PrimitiveStepsCallback")
        assert state["_installer"].state["slots"][0] == "steady"

    @pytest.mark.usefixtures("keep_all")
    def test_a_checkpoint_is_refused_without_its_hand_made_option(self, tmp_path: Path) -> None:
        model_of(with_option()).learn(200, [PrimitiveStepsCallback(), CheckpointCallback(tmp_path, 100)])
        *_, file = sorted(tmp_path.glob("0*"))
        checkpoints = CheckpointCallback(tmp_path, 100)
        checkpoints.resume_from(read(file))
        with pytest.raises(ValueError, match=r"^Slot 0 held the hand-made option 'steady', which is code"):
            model_of(optioned_rooms(2)).learn(300, [PrimitiveStepsCallback(), checkpoints])


@pytest.mark.parametrize("algorithm", [DQN, PPO])
def test_counting_alone_leaves_the_head_of_an_option_as_it_was_initialised(algorithm: Any) -> None:
    env = with_option()
    model = model_of(env) if algorithm is DQN else PPO("MlpPolicy", env, gamma=0.9, n_steps=64, device="cpu")
    layer, _ = heads.option_outputs(model.policy)[0]
    expected = layer.weight[:5].clone()
    before_the_first_step(model, PrimitiveStepsCallback())
    assert torch.equal(layer.weight[:5], expected)


@both
def test_hand_made_options_stay_in_the_environments_that_they_were_made_for(callback: Any) -> None:
    """They are code, which may know its environment."""
    venv = DummyVecEnv([with_option] * 2)
    before = [bank[0] for bank in venv.get_attr("bank")]
    assert before[0] is not before[1]
    model_of(venv).learn(100, callback=callback())
    assert [bank[0] for bank in venv.get_attr("bank")] == before


@both
def test_environments_with_different_options_are_refused(callback: Any) -> None:
    model = model_of(DummyVecEnv([lambda: optioned_rooms(2), with_option]))
    what = r"options: \[None, None\] in the first, \['steady', None\] in number 1"
    with pytest.raises(ValueError, match=f"^The environments have different {what}"):
        model.learn(50, callback=callback())


@pytest.mark.parametrize(
    ("other", "what"),
    [
        (lambda: OptionsWrapper(optioned_rooms(2).env, 2, gamma=0.9, max_runs=3), "max_runs: None in the first"),
        (lambda: OptionsWrapper(optioned_rooms(2).env, 2, gamma=0.9, feature_map=np.asarray), "feature maps: environm"),
    ],
)
def test_environments_that_differ_are_refused_for_discovery(other: Callable[[], OptionsWrapper], what: str) -> None:
    model = model_of(DummyVecEnv([lambda: optioned_rooms(2), other]))
    model.learn(50, callback=PrimitiveStepsCallback())  # counting needs no more than the same options
    with pytest.raises(ValueError, match=f"^The environments have different {what}"):
        model.learn(50, callback=SubgoalDiscoveryCallback())


def test_training_that_was_refused_ends_too() -> None:
    """rl-zoo3 ends its callbacks also then."""
    callback = PrimitiveStepsCallback()
    model_of(with_option()).learn(50, callback=callback)
    refused = model_of(DummyVecEnv([lambda: optioned_rooms(2), with_option]))
    with pytest.raises(ValueError, match="different options"):
        refused.learn(50, callback=callback)
    callback.on_training_end()
    assert callback._installer is None
    assert not env_of(refused).get_attr("slot_state")[0].expect_empty
