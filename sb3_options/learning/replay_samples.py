"""What a replay buffer over options gives an algorithm."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch


class OptionReplayBufferSamples(NamedTuple):
    """`ReplayBufferSamples` with what options add.

    Attributes:
        observations: (batch, ...).
        actions: Augmented actions, (batch, 1).
        next_observations: (batch, ...).
        dones: 1 where nothing follows; a timeout is not such an end. (batch, 1).
        rewards: Σ γⁱ rᵢ over the k primitive steps, (batch, 1).
        discounts: γᵏ, (batch, 1).
        next_available: Which option slots may start in the next observation, (batch, max_options); None where the
            buffer does not track availability.
    """

    observations: Any
    actions: torch.Tensor
    next_observations: Any
    dones: torch.Tensor
    rewards: torch.Tensor
    discounts: torch.Tensor
    next_available: torch.Tensor | None
