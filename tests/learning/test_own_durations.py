"""MacroQ where the environment's own actions have durations (docs/guide/your-environment.md)."""

from typing import Any

import numpy as np
import pytest

from sb3_options import MacroQ
from sb3_options.callbacks import PrimitiveStepsCallback
from tests.support.helpers import CountingEnv, numbered

GAMMA = 0.9


@pytest.mark.parametrize("k", [8, 2.5, 0.5])
def test_macro_q_discounts_by_the_action_s_own_duration(k: float) -> None:
    """A leg of k steps and no reward, then one of a step and a reward of 1."""

    def step(env: CountingEnv, _: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        duration, over = (k, False) if env.time == 1 else (1, True)
        info = {"option": {"index": -1, "duration": duration, "discount": GAMMA**duration}}
        return np.ones(1), float(over), over, False, info

    model = MacroQ(numbered(CountingEnv(step=step), 2), gamma=GAMMA, learning_rate=0.5, epsilon=1.0, seed=0)
    model.learn(1_000, callback=PrimitiveStepsCallback())
    assert model.policy.table().tolist() == [pytest.approx([GAMMA**k] * 2), pytest.approx([1.0] * 2)]
