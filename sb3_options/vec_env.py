"""Between what an algorithm sees and what `OptionsWrapper` sees."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecTransposeImage, is_vecenv_wrapped


def as_wrapper_sees(venv: VecEnv, observations: Any) -> Any:
    """Undo what SB3 does to images: it moves their channels to the front.

    Args:
        venv: The algorithm's environment.
        observations: A batch, unnormalised.

    Returns:
        The batch as the environments beneath gave it.
    """
    if not is_vecenv_wrapped(venv, VecTransposeImage):
        return observations
    if isinstance(observations, dict):
        return {key: np.moveaxis(v, 1, -1) if v.ndim == 4 else v for key, v in observations.items()}
    return np.moveaxis(observations, 1, -1)
