"""Observations and rewards that no network can learn from, refused where they come from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

LARGEST = float(np.finfo(np.float32).max)
"""Networks and buffers of Stable-Baselines3 compute in single precision, in which more than this is infinite."""


def check_finite(env: gym.Env[Any, Any], observation: Any, reward: Any = 0.0) -> None:
    """Refuse NaN, infinity and what single precision cannot hold, of which SB3 would learn a policy of NaN.

    Takes some microseconds; observations of whole numbers, as images are, take none.

    Args:
        env: Where they come from, for the message.
        observation: One, or a mapping of arrays.
        reward: Of the step that led there.

    Raises:
        ValueError: There is such a number.
    """
    if not abs(float(reward)) <= LARGEST:  # NaN compares as false
        raise ValueError(_text(env, f"the reward {reward}"))
    if isinstance(observation, np.ndarray):
        if not _holds(observation):
            raise ValueError(_text(env, f"an observation with {_worst(observation)}"))
    elif isinstance(observation, Mapping):
        for key, part in observation.items():
            if not _holds(np.asarray(part)):
                raise ValueError(_text(env, f"an observation with {_worst(np.asarray(part))} under {key!r}"))


def _holds(array: Any) -> bool:
    return array.dtype.kind != "f" or array.size == 0 or float(np.abs(array).max()) <= LARGEST


def _worst(array: Any) -> str:
    flat = array.ravel().astype(np.float64)  # half precision cannot hold the bound
    index = int(np.argmin(np.abs(flat) <= LARGEST))
    return f"{flat[index]} as number {index} of {array.size}"


def _text(env: gym.Env[Any, Any], what: str) -> str:
    name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    return (
        f"The environment {name} gave {what}. Networks compute in single precision, up to {LARGEST:.3g}, and would end "
        "in NaN: mend the environment, or clip what it gives in a wrapper beneath OptionsWrapper."
    )
