"""Which actions are available, and a `predict` that chooses only these."""

from typing import Any, cast

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import maybe_transpose
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_options.execution.vec_env import as_wrapper_sees
from sb3_options.experience.observations import BoolArray, FloatArray, batch_of_one, batch_size, take
from sb3_options.learning.replay_buffer import OptionReplayBuffer

AVAILABILITY_CHUNK = 4096  # stored observations are sent to the environment in batches of this many


def n_actions_of(model: BaseAlgorithm) -> int:
    """Return the number of augmented actions."""
    return int(cast("spaces.Discrete", model.action_space).n)


def unnormalized(normalizer: VecNormalize, observations: Any) -> Any:
    """Return a batch of observations as it was before ``VecNormalize``, except for clipped numbers.

    Clipped numbers of the environment's current observations are recovered, too.
    """
    original = normalizer.old_obs  # empty before the first reset
    if len(original) and _equal(normalizer.normalize_obs(original), observations):
        return original
    return normalizer.unnormalize_obs(observations)


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return all(np.array_equal(part, other[key]) for key, part in one.items())
    return np.array_equal(one, other)


def stored_availability(buffer: OptionReplayBuffer, venv: VecEnv) -> BoolArray:
    """Return which augmented actions may start in each stored next observation, (size, n_actions)."""
    stored = buffer.next_observations_stored()
    chunks = [
        as_wrapper_sees(venv, take(stored, slice(start, start + AVAILABILITY_CHUNK)))
        for start in range(0, buffer.size(), AVAILABILITY_CHUNK)
    ]
    return np.concatenate([venv.env_method("available", chunk, indices=[0])[0] for chunk in chunks])


def _channels_first(observations: Any, space: spaces.Space[Any]) -> Any:
    """Return a batch with image channels where the algorithm has them: SB3 also accepts the environment's order."""
    if isinstance(space, spaces.Dict):
        return {key: maybe_transpose(part, space[key]) for key, part in observations.items()}
    return maybe_transpose(observations, space)


class MaskedPrediction(BaseAlgorithm):
    """Base class of `OptionDQN` and `MacroQ`: ε-greedy among the available actions."""

    _n_slots: int
    """Option slots of the environment; 0 without `OptionsWrapper`."""

    def predict(
        self,
        observation: npt.NDArray[Any] | dict[str, npt.NDArray[Any]],
        state: tuple[npt.NDArray[Any], ...] | None = None,
        episode_start: npt.NDArray[Any] | None = None,
        deterministic: bool = False,
        action_masks: BoolArray | None = None,
    ) -> tuple[npt.NDArray[Any], tuple[npt.NDArray[Any], ...] | None]:
        """Choose greedily (or ε-greedily) among the available actions; ``state`` is passed through.

        ``action_masks``, (n_actions,) or (batch, n_actions), come by default from the model's own environment, by
        initiation sets alone (without ``max_runs``). Without an environment every action is available.
        """
        values, vectorized = self._action_values(observation)
        if action_masks is None:
            action_masks = self._available(observation if vectorized else batch_of_one(observation))
        masks = np.asarray(action_masks).reshape(values.shape)
        greedy = np.where(masks, values, -np.inf).argmax(axis=1)
        actions = greedy if deterministic else self._explored(values, masks, greedy)
        return (actions if vectorized else actions[0]), state

    def _available(self, observations: Any) -> BoolArray:
        """Return masks for a batch of observations as the algorithm sees them, (batch, n_actions)."""
        if self.env is None or not self._n_slots:
            return np.ones((batch_size(observations), n_actions_of(self)), dtype=bool)
        observations = _channels_first(observations, self.observation_space)
        if self._vec_normalize_env is not None:
            observations = unnormalized(self._vec_normalize_env, observations)
        return np.asarray(self.env.env_method("available", as_wrapper_sees(self.env, observations), indices=[0])[0])

    def _action_values(self, observation: Any) -> tuple[FloatArray, bool]:
        """Return Q of every action, (batch, n_actions), and whether ``observation`` was a batch."""
        raise NotImplementedError

    def _explored(self, values: FloatArray, masks: BoolArray, greedy: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return ε-greedy actions, (batch,), given the greedy ones."""
        raise NotImplementedError
