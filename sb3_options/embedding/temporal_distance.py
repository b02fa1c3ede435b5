"""Contrastive temporal distance: how long it takes from one observation to another, as a distance in Euclidean space.

Jiang et al. (2025), *Episodic Novelty Through Temporal Distance* (ETD), learn the successor distance of Myers et al.
(2024), d(x, y) = log p(y | y) − log p(y | x) with p the discounted distribution of future states: −log of the mean of
γ to the power of the time until y is reached. Their energy is c(y) − d(x, y), where d is the quasimetric of Liu et al.
(2023), *Metric Residual Networks*: an asymmetric part, plus ‖φ(x) − φ(y)‖.

Here d is the second part alone. Diverse density, radii and static filters measure Euclidean distances in concept
space, which have no direction. What is lost is the difference between there and back.
"""

from __future__ import annotations

import torch
from torch.nn import functional

SOFT = 1e-4
"""Added beneath the root, whose slope at 0 is infinite; above the rounding of the matrix product."""


def energies(began: torch.Tensor, led: torch.Tensor) -> torch.Tensor:
    """c(yⱼ) − ‖φ(xᵢ) − φ(yⱼ)‖ of all pairs, (n, n), from what the encoder makes of x and y, (n, d + 1): φ, then c."""
    x, y = began[:, :-1], led[:, :-1]
    squares = x.square().sum(dim=1)[:, None] + y.square().sum(dim=1) - 2.0 * x @ y.T
    return led[:, -1] - torch.sqrt(squares.clamp(min=0.0) + SOFT)


def contrastive_loss(began: torch.Tensor, led: torch.Tensor) -> torch.Tensor:
    """Symmetric InfoNCE: which y followed which x, and the other way round (Jiang et al. 2025)."""
    logits = energies(began, led)
    same = torch.arange(len(logits))
    return 0.5 * (functional.cross_entropy(logits, same) + functional.cross_entropy(logits.T, same))
