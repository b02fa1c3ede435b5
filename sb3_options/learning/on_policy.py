"""Putting a rollout buffer that knows options into a model that was built without one."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer

from sb3_options.learning.rollout_buffer import (
    OptionDictRolloutBuffer,
    OptionRolloutBuffer,
    SMDPAdvantages,
)


def option_rollout_buffer(model: BaseAlgorithm) -> SMDPAdvantages | None:
    """The model's rollout buffer, made into one that discounts with γᵏ where it was a stock one.

    Args:
        model: Any; before training starts.

    Returns:
        The buffer that is the model's from now on; None for an algorithm without rollouts.

    Raises:
        ValueError: The buffer is a class that is not known here.
    """
    buffer = getattr(model, "rollout_buffer", None)
    if buffer is None:
        return None
    return buffer if isinstance(buffer, SMDPAdvantages) else _made_anew(model, buffer)


def _made_anew(model: BaseAlgorithm, buffer: Any) -> SMDPAdvantages:
    sibling = _siblings(type(buffer)).get(type(buffer))
    if sibling is None:
        raise ValueError(
            f"{type(model).__name__} was built with {type(buffer).__name__}, which discounts an option of k steps with "
            f"γ instead of γᵏ: derive a class from (SMDPAdvantages, {type(buffer).__name__}) and pass it as "
            "rollout_buffer_class."
        )
    shape = {"hidden_state_shape": buffer.hidden_state_shape} if hasattr(buffer, "hidden_state_shape") else {}
    made: SMDPAdvantages = sibling(
        buffer.buffer_size,
        buffer.observation_space,
        buffer.action_space,
        device=buffer.device,
        gae_lambda=buffer.gae_lambda,
        gamma=buffer.gamma,
        n_envs=buffer.n_envs,
        **shape,
    )
    model.rollout_buffer = made  # type: ignore[attr-defined]  # it had one
    return made


def _siblings(stock: type[Any]) -> dict[type[Any], Any]:
    """Buffers that know options, by the stock ones they take the place of."""
    siblings: dict[type[Any], Any] = {RolloutBuffer: OptionRolloutBuffer, DictRolloutBuffer: OptionDictRolloutBuffer}
    if stock.__module__.startswith("sb3_contrib."):
        from sb3_options.learning import contrib_buffers as contrib

        for sibling in (
            contrib.OptionMaskableRolloutBuffer,
            contrib.OptionMaskableDictRolloutBuffer,
            contrib.OptionRecurrentRolloutBuffer,
            contrib.OptionRecurrentDictRolloutBuffer,
        ):
            siblings[sibling.__bases__[1]] = sibling
    return siblings
