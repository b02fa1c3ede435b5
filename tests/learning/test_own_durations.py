"""MacroQ where the environment's own actions have durations (docs/guide/your-environment.md)."""

from typing import Any

import gymnasium as gym
import pytest

from sb3_options import MacroQ
from sb3_options.callbacks import PrimitiveStepsCallback

GAMMA = 0.9


class TwoLegs(gym.Env[int, int]):
    """A leg of ``duration`` steps and no reward, then one of a step and a reward of 1."""

    def __init__(self, duration: float) -> None:
        self.observation_space: Any = gym.spaces.Discrete(2)
        self.action_space: Any = gym.spaces.Discrete(2)
        self.duration = duration

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.leg = 0
        return 0, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        self.leg += 1
        k = self.duration if self.leg == 1 else 1
        info = {"option": {"index": -1, "duration": k, "discount": GAMMA**k}}
        return 1, float(self.leg == 2), self.leg == 2, False, info


@pytest.mark.parametrize("k", [8, 2.5, 0.5])
def test_macro_q_discounts_by_the_action_s_own_duration(k: float) -> None:
    model = MacroQ(TwoLegs(k), gamma=GAMMA, learning_rate=0.5, epsilon=1.0, seed=0)
    model.learn(1_000, callback=PrimitiveStepsCallback())
    assert model.policy.table().tolist() == [pytest.approx([GAMMA**k] * 2), pytest.approx([1.0] * 2)]
