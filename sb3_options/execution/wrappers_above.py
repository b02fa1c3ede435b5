"""Which Gymnasium wrappers may stand above `OptionsWrapper`.

What options do inside `OptionsWrapper` passes no wrapper above it. One that changes rewards, observations or the ends
of episodes would change decisions and leave the primitive steps inside options as they are: an algorithm would learn
from two environments at once.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium import wrappers
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor

from sb3_options.execution.wrapper import OptionsWrapper

UNCHANGED = (
    Monitor,
    wrappers.HumanRendering,
    wrappers.OrderEnforcing,
    wrappers.PassiveEnvChecker,
    wrappers.RecordEpisodeStatistics,
    wrappers.RecordVideo,
    wrappers.RenderCollection,
)
"""Wrappers with a ``step`` of their own that returns what the environment's returned, but for additions to ``info``."""


class _Kind(type):
    def __instancecheck__(cls, env: Any) -> bool:
        if isinstance(env, OptionsWrapper) or not is_wrapped(env, OptionsWrapper):
            return False
        own_step = type(env).step is not gym.Wrapper.step
        return own_step and not (isinstance(env, UNCHANGED) or getattr(env, "returns_steps_unchanged", False))


class ChangesSteps(metaclass=_Kind):
    """Any wrapper above `OptionsWrapper` whose ``step`` may return something else than what `OptionsWrapper` returned.

    For ``VecEnv.env_is_wrapped``, which asks every wrapper in the environment's own process. A class with a ``step`` of
    its own counts, unless it is among `UNCHANGED` or has an attribute ``returns_steps_unchanged = True``.
    """
