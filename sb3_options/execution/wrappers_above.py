"""Which Gymnasium wrappers may stand above `OptionsWrapper`, and what those count that record episodes.

What options do inside `OptionsWrapper` passes no wrapper above it. One that changes rewards, observations or the ends
of episodes would change decisions and leave the primitive steps inside options as they are: an algorithm would learn
from two environments at once.
"""

from __future__ import annotations

import logging
from typing import Any

import gymnasium as gym
from gymnasium import wrappers
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, is_vecenv_wrapped

from sb3_options.execution.slots import Outermost
from sb3_options.execution.wrapper import OptionsWrapper

logger = logging.getLogger("sb3_options")

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


class _Recording(type):
    def __instancecheck__(cls, env: Any) -> bool:
        return isinstance(env, wrappers.RecordEpisodeStatistics) and is_wrapped(env, OptionsWrapper)


class RecordsDecisions(metaclass=_Recording):
    """A ``RecordEpisodeStatistics`` above `OptionsWrapper`, for ``VecEnv.env_is_wrapped``."""


def monitor_primitive_steps(venv: VecEnv) -> None:
    """Let each ``Monitor`` above the `OptionsWrapper` count primitive steps, wherever it stands.

    SB3 puts one around an environment that has none. ``VecMonitor`` and ``RecordEpisodeStatistics`` cannot do so, and
    there is a warning. Environments without `OptionsWrapper` are let be.
    """
    if not all(venv.env_is_wrapped(OptionsWrapper)):
        return
    # A VecMonitor records an episode before a callback could correct the last step.
    records = {
        "VecMonitor": is_vecenv_wrapped(venv, VecMonitor),
        "RecordEpisodeStatistics": any(venv.env_is_wrapped(RecordsDecisions)),  # type: ignore[arg-type]  # a kind of wrapper
    }
    for name in (name for name, is_there in records.items() if is_there):
        logger.warning(
            "%s above OptionsWrapper counts decisions and sums discounted rewards: leave it out and put a Monitor "
            "beneath, as make_vec_env(..., wrapper_class=OptionsWrapper) does.",
            name,
        )
    venv.env_is_wrapped(Outermost)  # type: ignore[arg-type]  # a kind of wrapper
    venv.env_method("count_primitive_steps")
