"""An environment that calls a test back."""

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from tests.support.helpers import CountingEnv

Register = Callable[..., None]


@pytest.fixture
def register() -> Iterator[Register]:
    """Registers an environment that calls something in its every step, told its number among those of all copies.

    Its episodes end after some steps, each of which is rewarded with 1.
    """

    def register(in_step: Callable[[int], object] = bool, *, ends_after: float = 10, **spec: Any) -> None:
        numbers = itertools.count(1)

        def step(env: CountingEnv, action: int) -> Any:
            in_step(next(numbers))
            return np.array([float(env.time)]), 1.0, env.time >= ends_after, False, {}

        gym.register("Counted-v0", lambda: CountingEnv(step=step), **spec)  # type: ignore[arg-type]  # no arguments

    yield register
    gym.registry.pop("Counted-v0", None)
