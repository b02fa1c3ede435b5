"""Gymnasium's wrappers above `OptionsWrapper`: which are allowed, and what a ``Monitor`` among them counts.

Wrappers above `OptionsWrapper` do not see the primitive steps inside options. A wrapper that changes rewards,
observations or the ends of episodes would change decisions, but not these steps. An algorithm would then learn from two
environments at once.
"""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import gymnasium as gym
from gymnasium import wrappers
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

UNCHANGED = (  # a ``step`` of their own, which returns the environment's step, apart from additions to ``info``
    Monitor,
    wrappers.HumanRendering,
    wrappers.OrderEnforcing,
    wrappers.PassiveEnvChecker,
    wrappers.RecordEpisodeStatistics,
    wrappers.RecordVideo,
    wrappers.RenderCollection,
)


class PrimitiveMonitor(Monitor[Any, Any]):
    """Counts the primitive steps inside options, and sums their undiscounted rewards.

    SB3 puts a ``Monitor`` around an environment that has none. Above the options it would count decisions, and sum the
    discounted rewards of their runs. `monitor_primitive_steps` turns such a ``Monitor`` into this class in place.
    """

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step of the environment."""
        if self.needs_reset:
            return super().step(action)  # which refuses
        result = self.env.step(action)
        rewards = result[-1]["option"].get("rewards", [result[1]])
        self.rewards.extend(float(reward) for reward in rewards[:-1])
        self.total_steps += len(rewards) - 1
        environment = self.env
        answer = (result[0], rewards[-1], *result[2:])
        self.env = cast("gym.Env[Any, Any]", SimpleNamespace(step=lambda _: answer))
        try:
            super().step(action)  # which counts the last one, and adds to the info when the episode ends
        finally:
            self.env = environment
        return result


def count_primitive_steps(outermost: gym.Env[Any, Any], options: gym.Env[Any, Any]) -> None:
    """Let every ``Monitor`` above the options count primitive steps, except subclasses of ``Monitor``."""
    for env in _above(outermost, options):
        if type(env) is Monitor:
            env.__class__ = PrimitiveMonitor


def names_of_changing(outermost: gym.Env[Any, Any], options: gym.Env[Any, Any]) -> tuple[str, ...]:
    """Return the classes of the wrappers above the options that may change steps, the outermost first.

    A class with a ``step`` of its own may, unless it is among ``UNCHANGED`` or has ``returns_steps_unchanged = True``.
    """
    return tuple(
        type(env).__name__
        for env in _above(outermost, options)
        if type(env).step is not gym.Wrapper.step
        and not (isinstance(env, UNCHANGED) or getattr(env, "returns_steps_unchanged", False))
    )


def changing_steps(venv: VecEnv) -> set[str]:
    """Return the classes of wrappers above `OptionsWrapper` that may change steps, in any environment."""
    venv.env_is_wrapped(Outermost)  # type: ignore[arg-type]  # it asks the outermost wrapper first
    return {name for names in venv.get_attr("above") for name in names}


def monitor_primitive_steps(venv: VecEnv) -> None:
    """Let each ``Monitor`` above `OptionsWrapper`, such as the one that SB3 adds, count primitive steps.

    Environments without `OptionsWrapper` stay unchanged.
    """
    if all(venv.env_is_wrapped(Outermost)):  # type: ignore[arg-type]  # as above
        venv.env_method("set_slots", primitive_monitor=True)


def _above(outermost: Any, options: Any) -> Iterator[Any]:
    while outermost is not options:
        yield outermost
        outermost = outermost.env


class _Kind(type):
    def __instancecheck__(cls, env: Any) -> bool:
        inner = env
        while "slot_state" not in vars(inner):
            if not isinstance(inner, gym.Wrapper):
                return False
            inner = inner.env
        inner.outermost = env
        return True


class Outermost(metaclass=_Kind):
    """Class for ``VecEnv.env_is_wrapped``: its check tells `OptionsWrapper` which wrapper is outermost."""
