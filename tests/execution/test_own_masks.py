"""Options keep to the masks of the environment that they run in."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_options import OptionsWrapper
from tests.support.helpers import steady_option

LEFT, STAY, RIGHT = 0, 1, 2
GATE = 3


class Gate(gym.Env[Any, int]):
    """A corridor 0 … 6 with a gate at x = 3 that opens on even steps; the clock is no part of the observation."""

    def __init__(self) -> None:
        self.action_space: Any = spaces.Discrete(3)
        self.observation_space: Any = spaces.Box(0.0, 6.0, (1,), np.float32)
        self.x, self.time = 0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.time = 0, 0
        return self._seen(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if not self.legal()[action]:
            raise ValueError(f"action {action} is illegal at x = {self.x}, step {self.time}")
        self.x = min(max(self.x + action - 1, 0), 6)
        self.time += 1
        return self._seen(), float(self.x == 6), self.x == 6, self.time >= 40, {}

    def legal(self) -> list[bool]:
        return [True, True, self.x != GATE or self.time % 2 == 0]

    def action_masks(self) -> list[bool]:
        return self.legal()

    def _seen(self) -> Any:
        return np.array([self.x], dtype=np.float32)


class GateProperty(Gate):
    """Its masks are a property."""

    action_masks = property(Gate.legal)


def wrapped(env: gym.Env[Any, Any], max_options: int = 4) -> OptionsWrapper:
    env = OptionsWrapper(env, max_options, gamma=0.9)
    env.set_slots(options={0: steady_option(RIGHT, max_duration=10)}, expect_empty=True, report_availability=True)
    env.reset(seed=0)
    return env


@pytest.mark.parametrize("make", [Gate, GateProperty])
def test_an_option_ends_before_what_is_masked_and_does_not_start_there(make: type[Gate]) -> None:
    env = wrapped(make())
    assert env.action_masks().tolist() == [True, True, True, True, False, False, False]
    info = env.step(3)[4]  # to the gate, which is closed on step 3
    assert (info["option"]["duration"], info["option"]["termination"]) == (3, "left_initiation")
    assert info["option"]["available"][:, 0].tolist() == [True, True, False]
    assert env.action_masks().tolist() == [True, True, False, False, False, False, False]
    info = env.step(STAY)[4]
    assert info["option"]["available"][:, 0].tolist() == [True]
    assert env.action_masks().tolist() == [True, True, True, True, False, False, False]
    assert env.step(3)[4]["option"]["duration"] >= 3


def test_a_slot_that_is_chosen_all_the_same_runs_a_legal_primitive() -> None:
    env = wrapped(Gate(), 6)
    env.step(3)
    gate: Any = env.unwrapped
    for slot, ran in [(0, LEFT), (1, STAY), (2, LEFT), (5, LEFT)]:
        gate.x, gate.time = GATE, 3
        info = env.step(3 + slot)[4]
        assert (info["option"]["index"], info["option"]["actions"].tolist()) == (-1, [ran])
