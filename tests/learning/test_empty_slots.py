"""Slots that stay empty change nothing of what PPO learns from the same rollout."""

from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import set_random_seed

from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback
from tests.support.sb3_helpers import optioned_rooms, small_rooms

STEPS = 256
STORED = ("observations", "actions", "rewards", "episode_starts", "log_probs", "values")
KWARGS: dict[str, Any] = {"gamma": 0.9, "n_steps": STEPS, "ent_coef": 0.01, "seed": 0, "device": "cpu"}


class FirstRollout(BaseCallback):
    """Keeps the weights before the first update, and the rollout that it is made from."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        self.weights = {name: weight.clone() for name, weight in model.policy.state_dict().items()}
        self.rollout = {name: getattr(model.rollout_buffer, name).copy() for name in (*STORED, "advantages")}
        self.last_values, self.dones = self.locals["values"].clone().flatten(), np.array(self.locals["dones"])
        set_random_seed(1)  # the next draws are those of the batches


@pytest.mark.parametrize("callback", [PrimitiveStepsCallback, lambda: SubgoalDiscoveryCallback(max_new_options=0)])
def test_the_update_is_that_of_the_stock_algorithm(callback: Any) -> None:
    """With episodes that are cut off by time, so that values are bootstrapped."""
    ours: Any = PPO("MlpPolicy", optioned_rooms(4, max_steps=40), **KWARGS)
    first = FirstRollout()
    ours.learn(STEPS, callback=[first, callback()])

    stock: Any = PPO("MlpPolicy", small_rooms(max_steps=40), **KWARGS)
    stock._setup_learn(STEPS)
    n = int(stock.action_space.n)
    narrow = {name: w[:n] if name.startswith("action_net") else w for name, w in first.weights.items()}
    stock.policy.load_state_dict(narrow)
    buffer = stock.rollout_buffer
    for name in STORED:
        getattr(buffer, name)[:] = first.rollout[name].reshape(getattr(buffer, name).shape)
    buffer.pos, buffer.full = STEPS, True
    buffer.compute_returns_and_advantage(first.last_values, first.dones)
    np.testing.assert_allclose(buffer.advantages, first.rollout["advantages"], atol=1e-6)
    set_random_seed(1)
    stock.train()

    learned = stock.policy.state_dict()
    assert any(not torch.equal(learned[name], narrow[name]) for name in learned)
    for name, weight in ours.policy.state_dict().items():
        same = weight[:n] if name.startswith("action_net") else weight
        torch.testing.assert_close(same, learned[name], atol=1e-5, rtol=1e-4)
