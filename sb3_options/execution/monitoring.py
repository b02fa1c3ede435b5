"""A ``Monitor`` above `OptionsWrapper` that counts primitive steps."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from stable_baselines3.common.monitor import Monitor


class PrimitiveMonitor(Monitor[Any, Any]):
    """Counts the primitive steps inside options, and sums their undiscounted rewards.

    SB3 puts a ``Monitor`` around an environment that has none. Above the options it would count decisions, and sum the
    discounted rewards of their runs. `count_primitive_steps` makes one of these of it where it stands.
    """

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """As the environment's step."""
        if self.needs_reset:
            return super().step(action)  # which refuses
        result = self.env.step(action)
        rewards = result[-1]["option"].get("rewards", [result[1]])
        self.rewards.extend(float(reward) for reward in rewards[:-1])
        self.total_steps += len(rewards) - 1
        environment, self.env = self.env, _Answer((result[0], rewards[-1], *result[2:]))
        try:
            super().step(action)  # which counts the last one, and adds to the info when the episode ends
        finally:
            self.env = environment
        return result


class _Answer(gym.Env[Any, Any]):
    """Gives what was answered already."""

    def __init__(self, result: tuple[Any, ...]) -> None:
        self._result = result

    def step(self, action: Any) -> Any:
        """Give it."""
        del action
        return self._result


def count_primitive_steps(outermost: gym.Env[Any, Any], options: gym.Env[Any, Any]) -> None:
    """Let every ``Monitor`` above the options count primitive steps; those of a user's own class are let be.

    Args:
        outermost: Wrapper around the options, or these.
        options: The `OptionsWrapper`.
    """
    env: Any = outermost
    while env is not options:
        if type(env) is Monitor:
            env.__class__ = PrimitiveMonitor
        env = env.env
