"""Numbers that no network can learn from are refused once, by the environment's name."""

import re
from typing import Any

import numpy as np
import pytest

from sb3_options import OptionsWrapper
from sb3_options.execution.finite import LARGEST, check_finite
from tests.support.helpers import CountingEnv

BAD = [np.nan, np.inf, -np.inf, 1e300, -1e39]


def gives(observation: Any = 0.0, reward: Any = 0.0, *, at: Any = 3) -> CountingEnv:
    """An environment whose step number ``at`` gives these."""

    def step(env: CountingEnv, action: int) -> Any:
        now = env.time == at
        return np.array([observation if now else 0.0]), reward if now else 0.0, env.time >= 10, False, {}

    return CountingEnv(step=step)


@pytest.mark.parametrize("number", BAD)
@pytest.mark.parametrize("where", ["observation", "reward"])
def test_is_refused(where: str, number: float) -> None:
    env = OptionsWrapper(gives(**{where: number}), check_finite=True)
    env.reset()
    env.step(0)
    env.step(0)
    text = rf"CountingEnv gave (the reward|an observation with) {re.escape(str(number))}"
    with pytest.raises(ValueError, match=text):
        env.step(0)


def test_is_refused_in_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CountingEnv, "reset", lambda *_, **__: (np.array([np.nan]), {}))
    with pytest.raises(ValueError, match="gave an observation with nan as number 0 of 1"):
        OptionsWrapper(CountingEnv(), check_finite=True).reset()


def test_parts_and_types_of_observations() -> None:
    env = CountingEnv()
    fine = {"image": np.full((2, 2), 255, np.uint8), "x": np.array([LARGEST, -LARGEST]), "empty": np.zeros(0)}
    check_finite(env, fine, 1)
    check_finite(env, 3, np.float32(1.0))
    with pytest.raises(ValueError, match="an observation with inf as number 1 of 4 under 'y'"):
        check_finite(env, fine | {"y": np.array([[0.0, np.inf], [np.nan, 0.0]], np.float16)})
