"""Rollouts of so many primitive steps: `PrimitiveStepsCallback(primitive_rollouts=True)`."""

from typing import Any, cast

import numpy as np
import pytest
from sb3_contrib import RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_options.callbacks import PrimitiveStepsCallback
from sb3_options.learning.rollout_buffer import n_decisions
from tests.callbacks.test_primitive_steps import Rollouts, counting


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_rollouts_of_so_many_primitive_steps(algorithm: Any) -> None:
    """A third of the uniform choices take 5 steps, so that 60 decisions take about 120 steps."""
    some = {"batch_size": 12, "n_epochs": 1} if algorithm is PPO else {}
    model = algorithm("MlpPolicy", counting(), gamma=0.9, n_steps=60, learning_rate=0.0, seed=0, device="cpu", **some)
    rollouts = Rollouts()
    model.learn(2400, callback=[PrimitiveStepsCallback(primitive_rollouts=True), rollouts])
    sizes, steps = np.array(rollouts.sizes).T
    assert sizes[0] == 60
    assert sizes[1] == pytest.approx(60 * 60 / steps[0], abs=12)  # as long as the first promised
    assert 40 < steps[1:].mean() < 80
    if algorithm is PPO:
        assert set(sizes % 12) == {0}  # minibatches are full
    assert model.n_steps == 60
    model.learn(100, callback=PrimitiveStepsCallback())
    assert model.rollout_buffer.buffer_size == 60


def test_a_rollout_of_another_length_keeps_every_lstm_state_at_its_row() -> None:
    """RecurrentPPO's buffer has an LSTM state for each row, one environment after the other."""

    class Seen(BaseCallback):
        wrong, lengths = 0, set[int]()

        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            buffer = self.model.rollout_buffer  # type: ignore[attr-defined]  # it is on-policy
            stored, observed = buffer.hidden_states_pi.copy(), buffer.observations.copy()
            self.lengths.add(buffer.buffer_size)
            next(buffer.get(batch_size=4))  # which lays all out, one environment after the other
            for row in range(2 * buffer.buffer_size):
                step, env = row % buffer.buffer_size, row // buffer.buffer_size
                assert np.array_equal(buffer.observations[row], observed[step, env])
                self.wrong += not np.array_equal(buffer.hidden_states_pi[row, 0], stored[step, 0, env])

    seen = Seen()
    envs = DummyVecEnv([counting] * 2)
    model = RecurrentPPO("MlpLstmPolicy", envs, gamma=0.9, n_steps=48, batch_size=12, n_epochs=1, seed=0, device="cpu")
    model.learn(800, callback=[PrimitiveStepsCallback(primitive_rollouts=True), seen])
    assert len(seen.lengths) > 1
    assert seen.wrong == 0


@pytest.mark.parametrize("first", [True, False])
def test_a_model_saved_meanwhile_has_the_n_steps_that_it_was_made_with(first: bool, tmp_path: Any) -> None:
    """Whichever callback comes first."""
    model = PPO("MlpPolicy", counting(), gamma=0.9, n_steps=60, batch_size=12, n_epochs=1, seed=0, device="cpu")
    shorter: list[int] = []

    class Saves(BaseCallback):
        def _on_step(self) -> bool:
            buffer: Any = cast("PPO", self.model).rollout_buffer
            if buffer.buffer_size < 60 and buffer.pos in (0, 20):
                shorter.append(self.num_timesteps)
                self.model.save(tmp_path / f"{self.num_timesteps}.zip")
            return True

    callbacks = [PrimitiveStepsCallback(primitive_rollouts=True), Saves()]
    model.learn(600, callback=callbacks if first else callbacks[::-1])
    assert len(shorter) > 3
    for steps in shorter:
        loaded = PPO.load(tmp_path / f"{steps}.zip", env=counting())
        assert (loaded.n_steps, loaded.rollout_buffer.buffer_size) == (60, 60)
    rollouts = Rollouts()
    loaded.learn(600, callback=[PrimitiveStepsCallback(), rollouts])
    assert {size for size, _ in rollouts.sizes} == {60}


def test_decisions_for_primitive_steps() -> None:
    durations = np.array([[1.0, 3.0], [5.0, 3.0]])  # 3 in the mean
    assert n_decisions(128, durations) == 43
    assert n_decisions(128, durations, multiple=16) == 48
    assert n_decisions(128, np.ones((4, 2)), multiple=16) == 128
    assert n_decisions(128, np.full((4, 2), 1000.0), multiple=16) == 16
    assert n_decisions(100, np.ones((4, 2)), multiple=16) == 96
    assert n_decisions(12, durations, multiple=16) == 4
    assert n_decisions(12, np.full((4, 2), 1000.0), multiple=16) == 1
    assert n_decisions(12, np.full((4, 2), 1000.0), multiple=16, least=2) == 2
