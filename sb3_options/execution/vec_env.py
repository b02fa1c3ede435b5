"""Converts observations as an algorithm sees them into observations as `OptionsWrapper` sees them."""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecFrameStack, VecNormalize, VecTransposeImage
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations


def as_wrapper_sees(venv: VecEnv, observations: Any, *, normalized: bool = False) -> Any:
    """Undo the changes of SB3's wrappers to observations, from the outermost inwards.

    ``VecTransposeImage`` moves the channels of images to the front. ``VecFrameStack`` joins the last frames, of which
    the wrapper sees the newest. With ``normalized`` the changes of ``VecNormalize`` are undone too, except clipping.
    """
    while isinstance(venv, VecEnvWrapper):
        if normalized and isinstance(venv, VecNormalize):
            observations = venv.unnormalize_obs(observations)
        if isinstance(venv, VecTransposeImage):
            observations = _channels_last(venv, observations)
        if isinstance(venv, VecFrameStack):
            observations = _newest_frame(venv.stacked_obs, observations)
        venv = venv.venv
    return observations


def _channels_last(venv: VecTransposeImage, observations: Any) -> Any:
    if venv.skip:
        return observations
    if isinstance(observations, dict):
        images = venv.image_space_keys
        return {key: np.moveaxis(v, 1, -1) if key in images else v for key, v in observations.items()}
    return np.moveaxis(observations, 1, -1)


def _newest_frame(stack: StackedObservations[Any], observations: Any) -> Any:
    if isinstance(observations, dict):
        return {key: _newest_frame(stack.sub_stacked_observations[key], v) for key, v in observations.items()}
    size = observations.shape[stack.stack_dimension] // stack.n_stack
    return observations[:, -size:] if stack.channels_first else observations[..., -size:]
