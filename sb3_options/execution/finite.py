"""Refuses observations and rewards that no network can learn from, where they come from."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

LARGEST = float(np.finfo(np.float32).max)  # networks and buffers of Stable-Baselines3 compute in single precision


def check_finite(env: gym.Env[Any, Any], observation: Any, reward: Any = 0.0) -> None:
    """Refuse NaN, infinity and numbers too large for single precision, which would make SB3's policy NaN."""
    wrong = f"the reward {reward}" if not abs(float(reward)) <= LARGEST else None  # NaN compares as false
    for key, part in (observation if isinstance(observation, Mapping) else {None: observation}).items():
        array = np.asarray(part)
        if array.dtype.kind != "f" or array.size == 0 or float(np.abs(array).max()) <= LARGEST:
            continue
        flat = array.ravel().astype(np.float64)  # half precision cannot hold the bound
        index = int(np.argmin(np.abs(flat) <= LARGEST))
        under = "" if key is None else f" under {key!r}"
        wrong = f"an observation with {flat[index]} as number {index} of {array.size}{under}"
    if wrong is not None:
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"The environment {name} gave {wrong}. Networks compute in single precision, up to {LARGEST:.3g}, and "
            "would end in NaN: mend the environment, or clip what it gives in a wrapper beneath OptionsWrapper."
        )
