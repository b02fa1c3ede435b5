"""A second training: nothing of the first stays behind in the environments that was not asked for again."""

from pathlib import Path
from typing import Any

import pytest
import torch
from sb3_contrib import TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_options import OptionsWrapper, load_model
from sb3_options.callbacks import PrimitiveStepsCallback
from tests.callbacks.doorway import finds_nothing, model_of, with_option
from tests.support.helpers import CountingEnv, steady_option
from tests.support.sb3_helpers import fast_callback, optioned_rooms


@pytest.mark.parametrize("algorithm", [DQN, PPO])
@pytest.mark.parametrize("callback", [PrimitiveStepsCallback, finds_nothing])
def test_parameters_that_were_set_are_trained_heads(algorithm: Any, callback: Any) -> None:
    """`set_parameters` leaves the number of updates at 0, which is no sign of an untrained model."""

    def make() -> Any:
        env = with_option()
        env.bank.add(steady_option(2, max_duration=3))  # no slot is empty
        rollouts: dict[str, Any] = {"n_steps": 16, "batch_size": 16, "seed": 0, "device": "cpu"}
        return model_of(env) if algorithm is DQN else PPO("MlpPolicy", env, gamma=0.9, **rollouts)

    trained, again = make(), make()
    trained.learn(300, callback=callback())
    again.set_parameters(trained.get_parameters())
    expected = {name: value.clone() for name, value in again.policy.state_dict().items()}
    again.learn(1, callback=[callback(), ConvertCallback(lambda *_: False)])
    assert again._n_updates == 0
    assert all(torch.equal(expected[name], value) for name, value in again.policy.state_dict().items())


def test_a_callback_is_for_one_model(tmp_path: Path) -> None:
    """A model that was loaded with the options that the callback made goes on with it."""
    callback = fast_callback()
    model = model_of(optioned_rooms(2))
    model.learn(3000, callback=callback)
    made = callback.bank.filled
    assert made
    with pytest.raises(ValueError, match=r"^This SubgoalDiscoveryCallback was with another model, .*for each model\.$"):
        model_of(optioned_rooms(2)).learn(100, callback=callback)
    model.save(tmp_path / "model.zip")
    load_model(DQN, tmp_path / "model", optioned_rooms(2)).learn(100, callback=callback, reset_num_timesteps=False)
    assert set(made) <= set(callback.bank.filled)


class LastStates(BaseCallback):
    """Keeps the states of an LSTM after the last step."""

    states: Any = None

    def _on_step(self) -> bool:
        self.states = self.locals.get("lstm_states")
        return True


@pytest.mark.parametrize(
    ("algorithm", "callback"),
    [
        (PPO, finds_nothing),
        (A2C, PrimitiveStepsCallback),
        (TRPO, PrimitiveStepsCallback),
        (MaskablePPO, finds_nothing),
        (RecurrentPPO, PrimitiveStepsCallback),
    ],
)
def test_a_training_that_the_budget_ended_in_a_rollout_goes_on_from_where_the_environments_are(
    algorithm: Any, callback: Any
) -> None:
    def make() -> OptionsWrapper:
        env = OptionsWrapper(CountingEnv(terminate_at=7), 2, gamma=0.9)
        env.bank.add(steady_option(max_duration=3))
        return env

    venv, last, in_rollouts, began = DummyVecEnv([make, make]), LastStates(), 0, 0
    policy = "MlpLstmPolicy" if algorithm is RecurrentPPO else "MlpPolicy"
    model = algorithm(policy, venv, gamma=0.9, n_steps=64, seed=0, device="cpu")
    for _ in range(8):
        model.learn(128, callback=[callback(), last], reset_num_timesteps=False)
        there = [int(env.unwrapped.time) for env in venv.envs]  # type: ignore[attr-defined]  # a CountingEnv
        assert model._last_obs.ravel().tolist() == there
        assert model._last_episode_starts.tolist() == [time == 0 for time in there]
        assert getattr(model, "_last_lstm_states", None) is last.states
        in_rollouts += not model.rollout_buffer.full
        began += 0 in there
    assert in_rollouts == 8
    assert began
