"""sb3-contrib's masked categorical distribution without repeated work: its answers are equal bit for bit.

In the forward pass of a small policy, sb3-contrib's ``MaskableCategorical`` takes longer than the network. It
initialises and checks ``torch.distributions.Categorical`` three times if there are masks.
"""

from __future__ import annotations

from typing import Any

import torch
from sb3_contrib.common.maskable import distributions as stock
from torch.distributions import Distribution
from torch.distributions.utils import lazy_property

MASKED = -1e8  # logit of a masked action, as in sb3-contrib


class QuickMaskableCategorical(stock.MaskableCategorical):
    """Categorical distribution over the actions that masks allow, of unnormalised logits (batch, n_actions).

    Raises:
        ValueError: A logit is NaN or infinite.
    """

    def __init__(self, logits: torch.Tensor) -> None:
        total = logits.logsumexp(dim=-1, keepdim=True)
        if not total.isfinite().all():
            raise ValueError("A policy has logits that are NaN or infinite, perhaps from a learning rate too high.")
        self._original_logits = self._masked_logits = self._param = logits - total
        self._num_events = logits.shape[-1]
        self.masks = None
        Distribution.__init__(self, logits.shape[:-1], validate_args=False)

    def apply_masking(self, masks: stock.MaybeMasks) -> None:
        """Allow the actions of ``masks`` alone, (batch, n_actions); None allows all."""
        self.masks, self._masked_logits = None, self._original_logits
        if masks is not None:
            allowed = torch.as_tensor(masks, dtype=torch.bool, device=self._original_logits.device)
            self.masks = allowed.reshape(self._original_logits.shape)
            self._masked_logits = self._original_logits.where(self.masks, MASKED)
        for computed in ("logits", "probs"):
            self.__dict__.pop(computed, None)

    @lazy_property
    def logits(self) -> torch.Tensor:
        """Logarithms of the probabilities, (batch, n_actions)."""
        # Normalised again even without masks, as in sb3-contrib, for equal rounding.
        return self._masked_logits - self._masked_logits.logsumexp(dim=-1, keepdim=True)

    def log_prob(self, value: torch.Tensor) -> torch.Tensor:
        """Return the logarithm of the probability of each action, (batch,)."""
        if value.shape != self._batch_shape:
            return torch.as_tensor(super().log_prob(value))  # type: ignore[no-untyped-call]  # it broadcasts
        return self.logits.gather(-1, value.long().unsqueeze(-1)).squeeze(-1)

    def sample(self, sample_shape: Any = ()) -> torch.Tensor:
        """Return random actions, ``(*sample_shape, batch)``."""
        if sample_shape:
            return torch.as_tensor(super().sample(sample_shape))  # type: ignore[no-untyped-call]
        return self.probs.multinomial(1, True).squeeze(-1)


class QuickMaskableDistribution(stock.MaskableCategoricalDistribution):
    """Makes a `QuickMaskableCategorical` in each forward pass of a policy."""

    def proba_distribution(self, action_logits: torch.Tensor) -> QuickMaskableDistribution:
        """Set the logits, (batch · n_actions) numbers."""
        self.distribution = QuickMaskableCategorical(action_logits.view(-1, self.action_dim))
        return self


def quick(distribution: stock.MaskableDistribution) -> stock.MaskableDistribution:
    """Return a `QuickMaskableDistribution` in place of a stock categorical one, and another one as it is."""
    if type(distribution) is not stock.MaskableCategoricalDistribution:
        return distribution
    return QuickMaskableDistribution(distribution.action_dim)
