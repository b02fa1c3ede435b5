"""Forgetting: what a model has learned of an option goes when the option's slot is emptied.

The values of an empty slot are closed (`heads`) or 0 (`MacroQ`), and no stored transition names it. Otherwise updates
would go on moving the closed values, and with them what all actions share.
"""

from __future__ import annotations

import logging

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_options.learning import heads
from sb3_options.learning.macro_q import MacroQ
from sb3_options.learning.replay_buffer import OptionReplayBuffer

logger = logging.getLogger("sb3_options")


def forget_slot(model: BaseAlgorithm, slot: int, n_primitive: int) -> bool:
    """Remove values, moments of the optimizer and stored transitions of a slot, which is empty now.

    Args:
        model: Of any algorithm; of one whose heads are not known the stored transitions alone.
        slot: Which.
        n_primitive: Number of primitive actions.

    Returns:
        Whether it had values, so that its head was not closed, or the table of `MacroQ` not 0.
    """
    action, had_values = n_primitive + slot, False
    if isinstance(model, MacroQ):
        had_values = bool(model.policy.table()[:, action].any())
        model.forget_action(action)
    elif heads.has_heads(model.policy):
        had_values = not heads.is_closed(model.policy, action)
        heads.close_head(model.policy, action)
        if had_values:
            heads.forget_moments(model.policy, action)
    buffer = getattr(model, "replay_buffer", None)
    if isinstance(buffer, OptionReplayBuffer):
        buffer.forget_action(action)
        buffer.set_next_available(slot, False)
    return had_values


def forget_empty(model: BaseAlgorithm, slot: int, n_primitive: int) -> None:
    """`forget_slot` of a slot that is empty when training starts, with a warning if the model had learned of it."""
    had_values = forget_slot(model, slot, n_primitive)
    if had_values and (isinstance(model, MacroQ) or getattr(model, "_n_updates", 0) > 0):
        logger.warning(
            "Slot %d is empty, and the model has learned what an option there is worth: that is forgotten now. If "
            "the options of an earlier training were meant to be there, load them first: "
            "sb3_options.load_options(FILE, env).",
            slot,
        )
