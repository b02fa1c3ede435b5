"""EM-DD: expectation maximisation in place of the noisy-or (Zhang & Goldman, "EM-DD: an improved multiple-instance
learning technique", 2001).

Each bag is represented by the one instance most likely in the concept. Selecting those (E) and fitting the concept to
them as labelled instances (M) take turns until the likelihood no longer grows. A positive bag contributes the energy
of its instance, log p = −z, which grows without limit as the bag recedes, and so does the noisy-or's; what differs is
the negatives: only the nearest instance of each bag counts.
"""  # noqa: D205

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from sb3_options.density.bags import Bags
from sb3_options.density.concepts import Concept, Point
from sb3_options.density.diverse_density import TOLERANCE, DiverseDensity, Peak
from sb3_options.density.evidence import Evidence
from sb3_options.density.lbfgs import BatchedLBFGS


@dataclass(frozen=True, kw_only=True, eq=False)
class ExpectationMaximisation:
    """EM-DD from the starts of a thorough `DiverseDensity`.

    Attributes:
        search: Gives the concept, scaled features, starts, and the radius within which peaks
            are merged. Its `negative_strength` multiplies p of negative instances.
        rounds: Most selections of instances.
        steps: Most evaluations of a fit between two selections.

    Raises:
        ValueError: An argument out of its range.
    """

    search: DiverseDensity = field(default_factory=lambda: DiverseDensity(concept=Point()))
    rounds: int = 20
    steps: int = 50

    def __post_init__(self) -> None:
        """Refuse arguments out of range."""
        for name in ("rounds", "steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")

    def fit(self, bags: Bags) -> list[Peak]:
        """Peaks of the likelihood of the most likely instances, most probable first.

        ``Peak.log_density`` is that likelihood in logarithm; `converged` says whether the selection came to rest.

        Raises:
            ValueError: As `DiverseDensity.search`.
        """
        evidence = self.search.evidence(bags)
        theta = self.search.starts(evidence)
        likelihood = MostLikely(bags, evidence, self.search.concept, self.search.negative_strength)
        selected = likelihood.select(theta)
        rested = torch.zeros(theta.shape[1], dtype=torch.bool, device=theta.device)
        for _ in range(self.rounds):
            loss, _ = likelihood.loss(theta, selected)
            descent = BatchedLBFGS(
                lambda t, chosen=selected: likelihood.loss(t, chosen),  # type: ignore[misc]  # mypy 2: default of lambda
                theta,
                self.search.concept.bounds(len(evidence.scale)),
                tolerance=TOLERANCE,
            )
            descent.run(self.steps)
            again = likelihood.select(descent.theta)
            grown = likelihood.loss(descent.theta, again)[0] < loss - TOLERANCE * loss.abs().clamp(min=1)
            # Zhang & Goldman end as soon as a round makes the concept no better, and keep the one before.
            moves = grown & ~rested
            theta = torch.where(moves, descent.theta, theta)
            selected = torch.where(moves, again, selected)
            rested |= ~grown
            if bool(rested.all()):
                break
        loss, _ = likelihood.loss(theta, selected)
        return self.search.peaks(theta, loss, rested, evidence)


class MostLikely:
    """log Π_i p(most likely of B_i⁺) Π_i (1 − η p(most likely of B_i⁻))."""

    def __init__(self, bags: Bags, evidence: Evidence, concept: Concept, strength: float) -> None:
        x = torch.from_numpy(evidence.scaled(bags.instances.numpy()))
        self._powers = torch.cat([torch.ones_like(x[:, :1]), x, x * x], dim=1)
        self._bags = torch.split(torch.arange(len(x), device=x.device), list(bags.lengths))
        self._n_positive = bags.n_positive
        self._concept, self._strength = concept, strength

    def select(self, theta: Tensor) -> Tensor:
        """The instance of smallest energy in every bag for every start, (bags, S)."""
        energy = self._powers @ self._concept.coefficients(theta)
        return torch.stack([bag[energy[bag].argmin(0)] for bag in self._bags])

    def loss(self, theta: Tensor, selected: Tensor) -> tuple[Tensor, Tensor]:
        """Its negative logarithm less the log prior, (S,), and the gradient in θ (P, S), the selection held fixed."""
        powers = self._powers[selected]  # (bags, S, K)
        energy = torch.einsum("bsk,ks->bs", powers, self._concept.coefficients(theta)).clamp(min=0)
        p = self._strength * torch.exp(-energy[self._n_positive :])
        miss = (1 - p).clamp(min=torch.finfo(p.dtype).eps)
        value = torch.cat([energy[: self._n_positive], -miss.log()])
        slope = torch.cat([torch.ones_like(energy[: self._n_positive]), -p / miss])
        prior, pull = self._concept.log_prior(theta)
        gradient = self._concept.pull_back(theta, torch.einsum("bsk,bs->ks", powers, slope))
        return value.sum(0) - prior, gradient - pull
