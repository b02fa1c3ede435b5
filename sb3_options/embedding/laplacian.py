"""Eigenvectors and eigenvalues of the Laplacian, by an augmented Lagrangian (ALLO).

Gomez, Bowling & Machado (2024), *Proper Laplacian Representation Learning*: for the Laplacian L = I − P of what
follows what, the smallest eigenvalues and their eigenvectors are the one stable equilibrium of

    max over β, min over u of  Σᵢ ⟨uᵢ, L uᵢ⟩ + Σ_{k ≤ j} β_jk (⟨uⱼ, ⟦u_k⟧⟩ − δ_jk) + b Σ_{k ≤ j} (⟨uⱼ, ⟦u_k⟧⟩ − δ_jk)²

where ⟦·⟧ stops the gradient: each vector makes way for those before it, and for no later one. So they
come in order, each by itself and not as any rotation, without a hyperparameter that breaks the symmetry. β_jj is −2
times the j-th eigenvalue then.

The first eigenvector is constant and not learned: u₀ = 1.
"""

from __future__ import annotations

import torch

BARRIER = 2.0
"""b; the authors' program begins with it, too."""

DUAL_RATE = 0.05
"""Step size of β, which follows the gradient upwards. β comes near its end within 2 b / DUAL_RATE = 80 steps or a few
times as many; the paper's is smaller, for a hundred times as many steps."""


class AugmentedLagrangian:
    """The objective, with its dual variables β.

    Args:
        size: Eigenvectors d besides the constant one.

    Attributes:
        duals: β, lower triangular, (d, d + 1); column 0 is that of the constant eigenvector.
    """

    STATE = ("duals",)

    def __init__(self, size: int) -> None:
        self.duals = torch.zeros(size, size + 1)

    def loss(self, began: torch.Tensor, led: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
        """The objective for a batch; takes a step of β upwards, too.

        Args:
            began: What the encoder makes of x, (n, k), in its first k ≤ d dimensions.
            led: Of what followed it, (n, k).
            others: Of other observations, drawn apart from these, (n, k): the square of a mean wants two samples.

        Returns:
            A number to descend.
        """
        graph_drawing = 0.5 * (began - led).square().mean(dim=0).sum()  # Σ ⟨uᵢ, L uᵢ⟩
        one, two = (_errors(batch) for batch in (torch.cat([began, led]), others))
        errors = 0.5 * (one + two)
        # The slope of b·error² is 2 b·error, each factor from a sample of its own.
        barrier = BARRIER * (one * two.detach() + two * one.detach())
        k = began.shape[1]
        duals = self.duals[:k, : k + 1]
        loss = graph_drawing + (duals * errors + barrier).sum()
        self.duals = self.duals.clone()
        self.duals[:k, : k + 1] = duals + DUAL_RATE * errors.detach()
        return loss

    @property
    def eigenvalues(self) -> torch.Tensor:
        """Of L for the pairs that were learned from, (d,), as the dual variables have them."""
        return -0.5 * self.duals.diagonal(offset=1)


def _errors(batch: torch.Tensor) -> torch.Tensor:
    """⟨uⱼ, ⟦u_k⟧⟩ − δ_jk for k ≤ j, (d, d + 1), the mean over the batch being the inner product; 0 elsewhere."""
    n, size = batch.shape
    before = torch.cat([torch.ones(n, 1), batch.detach()], dim=1)
    products = batch.T @ before / n
    return torch.tril(products - torch.eye(size, size + 1).roll(1, dims=1), diagonal=1)
