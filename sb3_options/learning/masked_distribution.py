"""sb3-contrib's masked categorical distribution, equal bit for bit, without checks and repeated work.

In the forward pass of a small policy, sb3-contrib's `MaskableCategorical` takes longer than the network. It initialises
and checks `torch.distributions.Categorical` three times.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import torch
from sb3_contrib.common.maskable.distributions import (
    MaskableCategorical,
    MaskableCategoricalDistribution,
    MaskableDistribution,
    MaybeMasks,
)
from torch.distributions import Distribution

MASKED = -1e8
"""Logit of a masked action, as in sb3-contrib."""


class QuickMaskableCategorical(MaskableCategorical):
    """Categorical distribution over the actions that masks allow.

    Only `sample` refuses NaN, with a `RuntimeError`.

    Args:
        logits: Unnormalised logarithms of probabilities, (batch, n_actions).
    """

    def __init__(self, logits: torch.Tensor) -> None:
        self._original_logits = _normalised(logits)
        self._num_events = logits.shape[-1]
        self.masks = None
        Distribution.__init__(self, logits.shape[:-1], validate_args=False)

    def apply_masking(self, masks: MaybeMasks) -> None:
        """Allow the actions of ``masks`` alone, (batch, n_actions); None allows all."""
        original = self._original_logits
        self.masks = None if masks is None else torch.as_tensor(masks, dtype=torch.bool, device=original.device)
        if self.masks is not None:
            self.masks = self.masks.reshape(original.shape)
        for computed in ("logits", "probs"):
            self.__dict__.pop(computed, None)

    @cached_property
    def logits(self) -> torch.Tensor:
        """Logarithms of the probabilities, (batch, n_actions)."""
        original = self._original_logits
        # Normalised again even without masks, as in sb3-contrib, for equal rounding.
        return _normalised(original if self.masks is None else original.where(self.masks, MASKED))

    @property
    def _param(self) -> torch.Tensor:  # type: ignore[override]  # torch sets it in the constructor, which is not called
        return self.logits

    def log_prob(self, value: torch.Tensor) -> torch.Tensor:
        """Return the logarithm of the probability of each action, (batch,)."""
        return self.logits.gather(-1, value.long().unsqueeze(-1)).squeeze(-1)

    def sample(self, sample_shape: Any = ()) -> torch.Tensor:
        """Return random actions, (*sample_shape, batch)."""
        if sample_shape:
            return torch.as_tensor(super().sample(sample_shape))  # type: ignore[no-untyped-call]
        return self.probs.multinomial(1, True).squeeze(-1)


def _normalised(logits: torch.Tensor) -> torch.Tensor:
    return logits - logits.logsumexp(dim=-1, keepdim=True)


class QuickMaskableDistribution(MaskableCategoricalDistribution):
    """Makes a `QuickMaskableCategorical` in each forward pass of a policy."""

    def proba_distribution(self, action_logits: torch.Tensor) -> QuickMaskableDistribution:
        """Set the logits, (batch · n_actions) numbers."""
        self.distribution = QuickMaskableCategorical(action_logits.view(-1, self.action_dim))
        return self


def quick(distribution: MaskableDistribution) -> MaskableDistribution:
    """Return a `QuickMaskableDistribution` in place of a stock categorical one, and another one as it is."""
    if type(distribution) is not MaskableCategoricalDistribution:
        return distribution
    return QuickMaskableDistribution(distribution.action_dim)
