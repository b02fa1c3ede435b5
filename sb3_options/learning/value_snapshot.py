"""Copies of a model's action values that environments use to interrupt options, also in other processes."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
    is_vecenv_wrapped,
    unwrap_vec_normalize,
    unwrap_vec_wrapper,
)

from sb3_options.execution.interruption import Interruption
from sb3_options.experience.observations import FloatArray, batch_of_one, flatten
from sb3_options.learning import heads
from sb3_options.learning.families import family_of
from sb3_options.state import declare, restore

declare(VecNormalize, "obs_rms")

REFRESH = 500
"""Primitive steps after which `Interrupter` sends newer values."""


class ValueSnapshot:
    """Q(s, ·) of DQN, OptionDQN or QRDQN (the mean over quantiles) when the snapshot was taken.

    A multilayer perceptron with ReLU over flat observations is evaluated by numpy, which for one observation is
    several times faster than torch; any other network is copied.
    """

    STATE = ("_layers", "_normalizer", "_network")

    def __init__(self, model: BaseAlgorithm, venv: VecEnv | None = None) -> None:
        network = heads.networks(model.policy)[0]
        _, self._outputs = heads.option_outputs(model.policy)[0]
        venv = model.get_env() or venv
        normalizer = unwrap_vec_normalize(venv)  # type: ignore[arg-type]  # None is no wrapper
        self._normalizer = copy.deepcopy(normalizer) if normalizer is not None and normalizer.norm_obs else None
        if self._normalizer is not None:  # what a copy lacks, as it lacks the environments, and is to be copied again
            vars(self._normalizer).update(class_attributes={}, returns=None)
        self._transposed = _transposed_keys(venv, model.observation_space)
        self._layers = _numpy_layers(network, self._outputs)
        self._states = int(model.observation_space.n) if isinstance(model.observation_space, spaces.Discrete) else 0
        self._network = None if self._layers else copy.deepcopy(network).cpu().eval()

    def __call__(self, observation: Any) -> FloatArray:
        """Q(s, ·) of one observation as `OptionsWrapper` sees it, (n_actions,)."""
        batch: Any = batch_of_one(observation)
        parts = batch if isinstance(batch, dict) else {"": batch}
        for key in self._transposed:
            parts[key] = np.moveaxis(parts[key], -1, 1)
        seen: Any = parts.get("", parts)
        if self._normalizer is not None:
            seen = self._normalizer.normalize_obs(seen)
        return self._by_numpy(seen) if self._layers else self._by_torch(seen)

    def _by_numpy(self, batch: Any) -> FloatArray:
        hidden = np.eye(self._states)[np.ravel(batch)] if self._states else flatten(batch)
        for weight, bias in self._layers[:-1]:
            hidden = np.maximum(hidden @ weight + bias, 0.0)
        weight, bias = self._layers[-1]
        values: FloatArray = (hidden @ weight + bias)[0]
        return values

    @torch.no_grad()
    def _by_torch(self, batch: Any) -> FloatArray:
        assert self._network is not None  # there are no layers
        outputs = self._network(obs_as_tensor(batch, torch.device("cpu")))[0].double()
        values: FloatArray = outputs.reshape(self._outputs, -1).mean(dim=0).numpy()
        return values


def interrupt_options(
    model: BaseAlgorithm, venv: VecEnv, *, every_choice: bool = True, values: ValueSnapshot | None = None
) -> bool:
    """Let options end in an environment where the model, as it is now, gives another action a greater value.

    Args:
        model: Gives the values.
        venv: Wrapped in `OptionsWrapper`.
        every_choice: As for `Interruption`; True where the model acts greedily.
        values: Of an earlier time; by default as they are now.

    Returns:
        Whether it can be done. Only DQN, QRDQN and OptionDQN have values of options, and beneath a ``VecFrameStack``
        the wrapper does not see the frames that the values depend on.
    """
    family = family_of(model)
    if not family.has_values or is_vecenv_wrapped(venv, VecFrameStack):
        return False
    values = values or ValueSnapshot(model, venv)
    rule = Interruption(values, masks=family.masks, every_choice=every_choice)
    venv.env_method("set_slots", interruption=rule)
    return True


class Interrupter:
    """Keeps the values in the environments at most `REFRESH` primitive steps behind the model's."""

    STATE = ("_refreshed", "_values")

    def __init__(self, model: BaseAlgorithm, venv: VecEnv, eval_envs: Sequence[VecEnv]) -> None:
        self.model, self.venv, self.eval_envs = model, venv, eval_envs
        self._refreshed: int | None = None
        self._values: ValueSnapshot | None = None

    def refresh(self, *, at_once: bool = False) -> None:
        """Send the model's values if the last ones are too old, or ``at_once``."""
        now = self.model.num_timesteps
        if not at_once and self._refreshed is not None and now - self._refreshed < REFRESH:
            return
        self._refreshed, self._values = now, ValueSnapshot(self.model)
        self._send(self._values)

    def _send(self, values: ValueSnapshot) -> None:
        interrupt_options(self.model, self.venv, every_choice=False, values=values)
        for eval_env in self.eval_envs:
            interrupt_options(self.model, eval_env, values=values)

    def set_state(self, state: dict[str, Any]) -> None:
        """Put the values of a checkpoint into the environments; they are older than the model's."""
        self._values = None if state["_values"] is None else ValueSnapshot(self.model)
        restore(self, state)
        if self._values is not None:
            self._send(self._values)


def _numpy_layers(network: Any, outputs: int) -> list[tuple[FloatArray, FloatArray]]:
    """Weights (inputs, outputs) and biases of a plain perceptron, quantiles averaged; none of any other network."""
    space = network.observation_space
    flat = isinstance(space, spaces.Discrete) or (isinstance(space, spaces.Box) and not is_image_space(space))
    if type(network).__module__.partition(".")[0] not in ("stable_baselines3", "sb3_contrib"):
        return []  # what a network of a user's own computes is its own affair
    modules = list(network.q_net if hasattr(network, "q_net") else network.quantile_net)
    plain = all(isinstance(m, torch.nn.Linear if i % 2 == 0 else torch.nn.ReLU) for i, m in enumerate(modules))
    if not (flat and plain and type(network.features_extractor) is FlattenExtractor):
        return []
    layers = [
        (m.weight.detach().cpu().double().numpy().T.copy(), m.bias.detach().cpu().double().numpy().copy())
        for m in modules[::2]
    ]
    weight, bias = layers[-1]
    layers[-1] = weight.reshape(len(weight), outputs, -1).mean(axis=1), bias.reshape(outputs, -1).mean(axis=0)
    return layers


def _transposed_keys(venv: VecEnv | None, space: spaces.Space[Any]) -> frozenset[str]:
    """The images whose channels are moved to the front, by key; the empty key where observations are no ``Dict``."""
    if venv is None:
        return frozenset()
    inner = unwrap_vec_wrapper(venv, VecTransposeImage)
    if inner is not None:
        return frozenset() if inner.skip else frozenset(getattr(inner, "image_space_keys", [""]))
    seen = venv.observation_space
    here = seen.spaces if isinstance(seen, spaces.Dict) else {"": seen}
    there = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    return frozenset(key for key, part in here.items() if part.shape != there[key].shape)
