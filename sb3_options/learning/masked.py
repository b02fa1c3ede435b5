"""`predict` of algorithms that value actions and keep to the available ones."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_options.execution.vec_env import as_wrapper_sees
from sb3_options.experience.observations import BoolArray, FloatArray, batch_of_one, batch_size


def n_actions_of(model: BaseAlgorithm) -> int:
    """Number of augmented actions."""
    return int(cast("spaces.Discrete", model.action_space).n)


class MaskedPrediction(BaseAlgorithm):
    """Base class of `OptionDQN` and `MacroQ`: ε-greedy among the available actions."""

    _n_slots: int
    """Option slots of the environment; 0 where it is not wrapped in `OptionsWrapper`."""

    def predict(
        self,
        observation: npt.NDArray[Any] | dict[str, npt.NDArray[Any]],
        state: tuple[npt.NDArray[Any], ...] | None = None,
        episode_start: npt.NDArray[Any] | None = None,
        deterministic: bool = False,
        action_masks: BoolArray | None = None,
    ) -> tuple[npt.NDArray[Any], tuple[npt.NDArray[Any], ...] | None]:
        """Greedy (or ε-greedy) among the available actions.

        Args:
            observation: One, or a batch.
            state: Passed through.
            episode_start: Unused.
            deterministic: Greedy, without ε, the first of several best.
            action_masks: Which actions may be taken, (n_actions,) or (batch, n_actions); by default asked from the
                model's own environment, by initiation sets alone (without ``max_runs`` or a trial), and every action
                where there is no environment.

        Returns:
            Actions and ``state``.
        """
        values, vectorized = self._action_values(observation)
        if action_masks is None:
            action_masks = self._available(observation if vectorized else batch_of_one(observation))
        masks = np.asarray(action_masks, dtype=bool).reshape(values.shape)
        greedy = np.where(masks, values, -np.inf).argmax(axis=1)
        actions = greedy if deterministic else self._explored(values, masks, greedy)
        return (actions if vectorized else actions[0]), state

    def _available(self, observations: Any) -> BoolArray:
        """Masks for a batch of observations as the algorithm sees them, (batch, n_actions)."""
        if self.env is None or not self._n_slots:
            return np.ones((batch_size(observations), n_actions_of(self)), dtype=bool)
        if self._vec_normalize_env is not None:
            observations = self._vec_normalize_env.unnormalize_obs(observations)
        mask: BoolArray = self.env.env_method("available", as_wrapper_sees(self.env, observations), indices=[0])[0]
        return mask

    def _action_values(self, observation: Any) -> tuple[FloatArray, bool]:
        """Q of every action, (batch, n_actions), and whether ``observation`` was a batch."""
        raise NotImplementedError

    def _explored(self, values: FloatArray, masks: BoolArray, greedy: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """ε-greedy actions, (batch,), given the greedy ones."""
        raise NotImplementedError
