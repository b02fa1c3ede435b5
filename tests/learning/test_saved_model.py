"""Options travel inside ``model.zip``, whoever saves the model and whoever loads it."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sb3_contrib import MaskablePPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_options import MacroQ, OptionBank, OptionDQN, OptionReplayBuffer, OptionsWrapper, load_model, load_options
from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback
from sb3_options.density.regions import Region
from sb3_options.learning import heads
from sb3_options.options.archive import content_in
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from tests.support.helpers import steady_option
from tests.support.sb3_helpers import TINY, env_of, optioned_rooms, small_rooms

SLOT = 2
DQN_KIND = {"replay_buffer_class": OptionReplayBuffer, **TINY}
PPO_KIND = {"n_steps": 32, "batch_size": 32, "n_epochs": 1, "policy_kwargs": {"net_arch": [16]}, "seed": 0}


def option() -> SubgoalOption:
    """To the right, in the left half of the small rooms."""
    inside = np.array([[x, y] for x in range(4) for y in range(5)], dtype=np.float64)
    policy = TabularPolicy(np.eye(45), np.eye(4)[np.full(45, 3)])
    return SubgoalOption(Region(np.array([[4.0, 2.0]]), np.ones(2), 0.0), Region(inside, np.ones(2), 0.0), policy)


def trained(algorithm: Any, env: Any = None, callback: Any = None, steps: int = 200) -> Any:
    """A model that has been trained with the option in its slot."""
    if env is None:
        env = optioned_rooms()
    if not isinstance(env, SubprocVecEnv | DummyVecEnv):
        env.bank.add(option(), SLOT)
    kind = PPO_KIND if algorithm in (PPO, MaskablePPO) else DQN_KIND
    model = MacroQ(env, gamma=0.9, seed=0) if algorithm is MacroQ else algorithm("MlpPolicy", env, gamma=0.9, **kind)
    model.learn(steps, callback=SubgoalDiscoveryCallback(max_new_options=0) if callback is None else callback)
    return model


def held(source: Any) -> tuple[int, ...]:
    """The slots that the options of a file fill."""
    bank = OptionBank(4, 4)
    bank.load(source)
    return bank.filled


def of_env(model: Any) -> tuple[int, ...]:
    return tuple(env_of(model).get_attr("bank", [0])[0].filled)


@pytest.mark.parametrize("algorithm", [DQN, OptionDQN, PPO, MaskablePPO, MacroQ])
def test_a_loaded_model_has_its_options_and_acts_as_before(algorithm: Any, tmp_path: Path) -> None:
    model = trained(algorithm)
    model.save(tmp_path / "model")
    again = load_model(algorithm, tmp_path / "model", optioned_rooms())
    assert of_env(again) == (SLOT,)
    states = np.eye(45, dtype=np.float32)
    masks = {}
    if algorithm is MaskablePPO:
        masks = {"action_masks": env_of(again).env_method("available", states)[0]}
        np.testing.assert_array_equal(masks["action_masks"], env_of(model).env_method("available", states)[0])
    np.testing.assert_array_equal(
        model.predict(states, deterministic=True, **masks)[0], again.predict(states, deterministic=True, **masks)[0]
    )
    again.save(tmp_path / "again.zip")
    assert held(tmp_path / "again.zip") == (SLOT,)


def test_sb3_loads_the_file_and_the_callback_puts_the_options_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    trained(PPO).save(tmp_path / "model.zip")
    for callback in (SubgoalDiscoveryCallback(max_new_options=0), PrimitiveStepsCallback()):
        model = PPO.load(tmp_path / "model.zip", env=optioned_rooms())
        assert of_env(model) == ()
        model.learn(200, callback=callback)
        assert of_env(model) == (SLOT,)
        model.save(tmp_path / "later.zip")
        assert held(tmp_path / "later.zip") == (SLOT,)
    assert caplog.records == []


def test_what_sb3_loads_and_saves_by_itself_keeps_them(tmp_path: Path) -> None:
    """As ``rl_zoo3.push_to_hub`` does."""
    trained(DQN).save(tmp_path / "model.zip")
    DQN.load(tmp_path / "model.zip").save(tmp_path / "pushed.zip")
    assert content_in(tmp_path / "pushed.zip") == content_in(tmp_path / "model.zip")
    assert of_env(load_model(DQN, tmp_path / "pushed.zip", optioned_rooms())) == (SLOT,)


def test_an_option_that_waits_for_a_rollout_is_saved(tmp_path: Path) -> None:
    class Installs(SubgoalDiscoveryCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps >= 10 and not (tmp_path / "model.zip").exists():
                self._keeper.options.install(0, option())
                assert env_of(self.model).get_attr("bank")[0].filled == (SLOT,)
                self.model.save(tmp_path / "model.zip")
            return super()._on_step()

    trained(PPO, callback=Installs(max_new_options=0))
    assert held(tmp_path / "model.zip") == (0, SLOT)


def test_a_model_that_has_none_says_so(tmp_path: Path) -> None:
    DQN("MlpPolicy", optioned_rooms(), **DQN_KIND).save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"model\.zip holds no options: its model was saved without a callback"):
        load_model(DQN, tmp_path / "model.zip", optioned_rooms())
    for name in ("other", "other.zip"):
        with pytest.raises(FileNotFoundError, match=r"No such file or directory: .*other\.zip"):
            load_model(DQN, tmp_path / name, optioned_rooms())


def test_weights_that_are_nan_name_the_file(tmp_path: Path) -> None:
    model = trained(PPO)
    model.policy.value_net.weight.data[0, 0] = np.nan
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"model\.zip holds weights that are NaN or infinite, value_net\.weight"):
        load_model(PPO, tmp_path / "model.zip", optioned_rooms())


def test_environments_without_slots_are_refused(tmp_path: Path) -> None:
    trained(DQN).save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="is not wrapped in OptionsWrapper"):
        load_options(tmp_path / "model.zip", small_rooms())
    with pytest.raises(ValueError, match="The environment is not wrapped in OptionsWrapper"):
        load_options(tmp_path / "model.zip", DummyVecEnv([small_rooms]))


def test_hand_made_options_have_to_be_there(tmp_path: Path) -> None:
    env = optioned_rooms()
    env.bank.add(steady_option(3, name="by hand"), 0)
    trained(PPO, env).save(tmp_path / "model.zip")
    model = PPO.load(tmp_path / "model.zip", env=optioned_rooms())
    with pytest.raises(ValueError, match="slot 0 held the hand-made option 'by hand', which is code"):
        model.learn(64, callback=SubgoalDiscoveryCallback())


def test_closed_options_do_not_come_back(tmp_path: Path) -> None:
    """What was saved once is not what the model carries while it is trained on."""
    model = trained(DQN)
    model.save(tmp_path / "model.zip")
    env_of(model).env_method("set_option", SLOT, None)
    model.learn(50, callback=SubgoalDiscoveryCallback(max_new_options=0))
    assert of_env(model) == ()


@pytest.mark.parametrize("before", ["load_model", "counted"])
@pytest.mark.parametrize("callback", [PrimitiveStepsCallback, lambda: SubgoalDiscoveryCallback(max_new_options=0)])
@pytest.mark.parametrize("algorithm", [DQN, PPO])
def test_they_go_along_into_other_environments(algorithm: Any, callback: Any, before: str, tmp_path: Path) -> None:
    """Whoever has brought them; also into a file that is saved meanwhile."""
    model = trained(algorithm, callback=PrimitiveStepsCallback())
    if before == "load_model":
        model.save(tmp_path / "model.zip")
        model = load_model(algorithm, tmp_path / "model.zip", optioned_rooms())
    model.set_env(optioned_rooms())
    model.save(tmp_path / "meanwhile.zip")
    assert held(tmp_path / "meanwhile.zip") == (SLOT,)
    model.learn(50, callback=callback(), reset_num_timesteps=False)
    assert of_env(model) == (SLOT,)
    assert not heads.is_closed(model.policy, 4 + SLOT)


def save_with_bias(path: Path) -> None:
    """A model whose greedy choice is the option everywhere."""
    model = trained(DQN)
    model.q_net.q_net[-1].bias.data[4 + SLOT] += 10.0
    model.save(path)


def test_predictions_without_the_options_say_so_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save_with_bias(tmp_path / "model.zip")
    caplog.set_level(logging.WARNING)
    lost = DQN.load(tmp_path / "model.zip", env=optioned_rooms())
    evaluate_policy(lost, env_of(lost), n_eval_episodes=2, warn=False)
    (record,) = caplog.records
    assert "Slot 2 was chosen, and it is empty: a primitive action takes its place" in record.message
    caplog.clear()
    found = load_model(DQN, tmp_path / "model.zip", optioned_rooms())
    evaluate_policy(found, env_of(found), n_eval_episodes=2, warn=False)
    assert caplog.records == []


def slow_rooms() -> OptionsWrapper:
    """Episodes of ten steps of −1: the goal is farther away."""
    return optioned_rooms(max_steps=10, step_reward=-1.0)


def test_what_was_loaded_is_evaluated_in_primitive_steps(tmp_path: Path) -> None:
    """SB3's `load` puts a Monitor above the options, which would count decisions."""
    save_with_bias(tmp_path / "model.zip")
    loaded = load_model(DQN, tmp_path / "model.zip", slow_rooms())
    monitored: Any = Monitor(slow_rooms())
    load_options(tmp_path / "model.zip", monitored)
    for env in (env_of(loaded), monitored):
        assert evaluate_policy(loaded, env, 2, return_episode_rewards=True) == ([-10.0] * 2, [10] * 2)
    assert monitored.env.bank.filled == (SLOT,)
