"""Searches from starts at other scales than the given one, and a prior that leaves features out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sb3_options.density.arrays import FloatArray
from sb3_options.density.concepts import Point
from sb3_options.density.diverse_density import TOLERANCE, DiverseDensity
from sb3_options.density.evidence import Evidence
from sb3_options.density.lbfgs import BatchedLBFGS


@dataclass(frozen=True, kw_only=True, eq=False)
class FromScales(DiverseDensity):
    """A search whose starts have several scales.

    Attributes:
        start_scales: As factors of `scale`.
        tolerance: Of the ascent, in nats relative to the value.
    """

    start_scales: Sequence[float] = (1.0,)
    tolerance: float = TOLERANCE

    def starts(self, evidence: Evidence, points: FloatArray | None = None) -> Tensor:
        """At every scale the starts of a thorough search."""
        at = super().starts(evidence, points)[: len(evidence.scale)].T
        return torch.cat([self.concept.start(at, scale) for scale in self.start_scales], dim=1)

    def descent(self, theta: Tensor, evidence: Evidence) -> BatchedLBFGS:
        """The ascent, ended by `tolerance`."""
        bounds = self.concept.bounds(len(evidence.scale))
        return BatchedLBFGS(evidence.loss, theta, bounds, tolerance=self.tolerance)


@dataclass(frozen=True)
class FewFeatures(Point):
    """Points with a scale per feature that is normal about 0: a feature counts only as far as the bags say so.

    Attributes:
        width: Standard deviation of the prior, as a factor of the scale given.
    """

    width: float = 0.5

    def log_prior(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """−½ Σ_k s_k² / width², (S,), and its gradient in θ."""
        gradient, scales = torch.zeros_like(theta), theta[len(theta) // 2 :]
        gradient[len(theta) // 2 :] = -scales / self.width**2
        return -scales.square().sum(0) / (2 * self.width**2), gradient
