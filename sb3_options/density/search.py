"""Search for concepts of any class: many starts with cheap steps in single precision, then the best to the end.

`DiverseDensity` is the quick search for points of known scale that discovery runs after every episode. This is the
thorough one: scales are learned, the concept may be any `Concept`, and the peaks are exact.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from sb3_options.checked import is_number, whole
from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags, distinct
from sb3_options.density.checks import positive_scale, refuse
from sb3_options.density.concepts import Concept, Frame, Point
from sb3_options.density.energies import Likelihood
from sb3_options.density.evidence import Evidence, evenly
from sb3_options.density.lbfgs import BatchedLBFGS
from sb3_options.density.objective import MAX_PAIRS
from sb3_options.density.peaks import best_apart, ties_in_order
from sb3_options.density.regions import Region

SURVIVORS = 4
"""After every `first_steps` the best quarter of the starts goes on, until `finalists` are left."""

SAMPLE, PROMISING = 3, 8
"""`ConceptSearch.shortlist` judges all by this many positive and negative bags, and one in so many by so many more."""

SORTING_STEPS = 3
"""Steps after which `ConceptSearch.ascend` merges starts that lie close."""


class Solution(NamedTuple):
    """A peak of diverse density.

    Attributes:
        concept: Its class.
        theta: Its parameters (P,), in scaled features.
        frame: What scaled features are.
        log_density: Log diverse density there, in nats, without the prior.
        converged: Whether the ascent had come to rest.
    """

    concept: Concept
    theta: FloatArray
    frame: Frame
    log_density: float
    converged: bool

    def region(self, level: float = 0.5) -> Region:
        """Where Pr(x ∈ concept) ≥ level, in (0, 1): a subgoal that β can test.

        Raises:
            ValueError: ``level`` out of range.
        """
        if not 0 < level < 1:
            raise ValueError(f"level must lie between 0 and 1, got {level}")
        return self.concept.region(self.theta, self.frame, level)

    def probability(self, instances: ArrayLike) -> FloatArray:
        """Pr(x ∈ concept) of instances (n, d), shape (n,).

        Raises:
            ValueError: Instances of another shape.
        """
        given = np.asarray(instances, dtype=np.float64)
        if given.ndim != 2 or given.shape[1] != self.frame.n_features:
            raise ValueError(f"instances must have shape (n, {self.frame.n_features}), got {given.shape}")
        x = (given[:, self.frame.features] - self.frame.origin) * self.frame.scale
        return instance_probabilities(self.concept, self.theta[:, None], x)[:, 0]


def instance_probabilities(concept: Concept, theta: FloatArray, scaled: FloatArray) -> FloatArray:
    """Pr(x ∈ concept) of scaled instances (n, m) under every column of θ (P, S): (n, S)."""
    powers = np.concatenate([np.ones((len(scaled), 1)), scaled, scaled**2], axis=1)
    coefficients = concept.coefficients(torch.from_numpy(np.ascontiguousarray(theta))).numpy()
    energy = powers[:, : len(coefficients)] @ coefficients
    if concept.link == "gaussian":
        return np.asarray(np.exp(-np.maximum(energy, 0)))
    return np.asarray(torch.from_numpy(-energy).sigmoid().numpy())


@dataclass(frozen=True, kw_only=True, eq=False)
class ConceptSearch:
    """Multi-start ascent of log diverse density, plus the log prior of the concept.

    Starts are distinct instances of positive bags, one of which lies in the concept, at each of several scales. All
    climb together in single precision; after every `first_steps` the best quarter goes on, of those that lie apart,
    until `finalists` are left. They climb until they rest, at last in double precision.

    Attributes:
        concept: What is searched for.
        scale: Factor for every feature, 1/width of a concept of scale 1: a number or (d,).
        features: Numbers of the features that count; by default all.
        start_scales: Scales of the starts, as factors of `scale`.
        max_starts: Most instances that are started from, evenly spaced among all; None for all.
        finalists: Most starts that climb to the end.
        first_steps: Evaluations before each cut.
        final_steps: Most evaluations afterwards, in each precision.
        tolerance: Of `BatchedLBFGS`, in nats relative to the value.
        merge_radius: A peak this close to a better one is merged into it, in parameters: for points, in widths.
        negative_strength: η in (0, 1]: log(1 − η p) of every negative instance. For a half-space η multiplies the
            odds of p.
        negative_width: Energies of negative instances are divided by its square: below 1 they reach less far (the
            paper's "decrease the influence of each negative instance through the width of the Gaussians", §8).
        leak: λ in [0, 1): the probability that a bag is positive for a reason other than the concept.
        max_pairs: (instances × starts) held at once; bounds the memory, 4 bytes each.

    Raises:
        ValueError: An argument out of its range.
    """

    concept: Concept = field(default_factory=Point)
    scale: ArrayLike = 1.0
    features: Sequence[int] | None = None
    start_scales: Sequence[float] = (1.0,)
    max_starts: int | None = 256
    finalists: int = 32
    first_steps: int = 20
    final_steps: int = 500
    tolerance: float = 1e-8
    merge_radius: float = 0.5
    negative_strength: float = 1.0
    negative_width: float = 1.0
    leak: float = 0.0
    max_pairs: int = MAX_PAIRS

    def __post_init__(self) -> None:
        """Refuse arguments out of range, by name."""
        features, scales = self.features, self.start_scales
        numbered = features is None or (
            isinstance(features, Collection)
            and all(whole(number, 0) for number in features)
            and len(features) == len(set(features)) > 0
        )
        several = isinstance(scales, Collection) and len(scales) > 0
        refuse(
            self,
            concept=("a Concept", isinstance(self.concept, Concept)),
            scale=("positive, finite, a number or (d,)", positive_scale(self.scale)),
            features=("distinct whole numbers of features, from 0, at least one", numbered),
            start_scales=("positive and finite, at least one", several and all(map(positive_scale, scales))),
            max_starts=(
                "a whole number of at least 1, or None",
                self.max_starts is None or whole(self.max_starts, 1),
            ),
            finalists=("a whole number of at least 1", whole(self.finalists, 1)),
            first_steps=("a whole number of at least 1", whole(self.first_steps, 1)),
            final_steps=("a whole number of at least 1", whole(self.final_steps, 1)),
            tolerance=("above 0", is_number(self.tolerance) and self.tolerance > 0),
            merge_radius=("at least 0", is_number(self.merge_radius) and self.merge_radius >= 0),
            negative_strength=("in (0, 1]", is_number(self.negative_strength) and 0 < self.negative_strength <= 1),
            negative_width=(
                "positive and finite",
                is_number(self.negative_width) and 0 < self.negative_width < math.inf,
            ),
            leak=("in [0, 1)", is_number(self.leak) and 0 <= self.leak < 1),
            max_pairs=("a whole number of at least 1", whole(self.max_pairs, 1)),
        )

    def search(
        self, bags: Bags | Evidence, *, starts: ArrayLike | None = None, warm: Sequence[Solution] = ()
    ) -> list[Solution]:
        """Search for peaks, the most probable first, prior included, no two within `merge_radius`.

        Args:
            bags: The evidence.
            starts: (m, d) points to start from, instead of instances of positive bags.
            warm: Peaks of an earlier search for the same concept, which climb on beside the finalists.

        Raises:
            ValueError: No point to start from, or points, features or a scale that do not fit the bags.
        """
        evidence = bags if isinstance(bags, Evidence) else self.evidence(bags)
        points = self._start_points(evidence, starts)
        theta = [self._in_frame(solution, evidence)[:, None] for solution in warm]
        if len(points):
            theta.append(self._started(points))
        if not theta:
            raise ValueError("there is nothing to search from: without positive bags pass starts or warm")
        descent = self._descent(torch.cat(theta, dim=1).float(), evidence)
        n = descent.theta.shape[1]
        while n > self.finalists:
            descent.run(self.first_steps)
            n = max(self.finalists, n // SURVIVORS)
            descent.keep(self._best_apart(descent.theta, descent.value, n), torch.float32)
        descent.run(self.final_steps)
        descent.keep(self._best_apart(descent.theta, descent.value, n), torch.float64)
        descent.run(self.final_steps)
        return self._solutions(descent, evidence)

    def shortlist(self, evidence: Evidence, theta: Tensor, n: int) -> Tensor:
        """Up to ``n`` columns of θ (P, S): the best by a few of the bags, of which the best by more of them."""
        for n_bags in (SAMPLE, SAMPLE * PROMISING):
            if theta.shape[1] > n:
                loss = evidence.sample(n_bags).value(theta.float())
                theta = theta[:, loss.argsort()[: max(n, len(loss) // PROMISING)]]
        return theta[:, :n]

    def ascend(
        self,
        evidence: Evidence,
        theta: Tensor,
        n: int,
        *,
        steps: int,
        ties: float = 0.0,
        least: float = -math.inf,
    ) -> list[Solution]:
        """Evaluate concepts, and let the best climb a few steps.

        Args:
            evidence: What they are evaluated on.
            theta: (P, S), in the precision in which they climb.
            n: Most that are returned: the best that lie apart.
            steps: Most evaluations of those that climb.
            ties: Concepts this close to the best are as good, and come in the order given.
            least: −log density − log prior that nothing can be below; where one is there already, none climbs.
        """
        # Of a point whose every bag pulls with all its weight: a step is then never much too long.
        curvature = 2 * max(1.0, evidence.positive_weight)
        loss = evidence.value(theta)
        tied = loss <= loss.min() + ties
        best = self._best_apart(theta, torch.where(tied, loss.min(), loss), max(n, int(tied.sum())))
        theta, loss = theta[:, best], loss[best]
        converged = torch.zeros_like(loss, dtype=torch.bool)
        if loss[0] > least:
            descent = self._descent(theta, evidence, curvature=curvature)
            descent.run(min(steps, SORTING_STEPS))
            kept = self._best_apart(descent.theta, descent.value, n)
            descent.keep(kept, theta.dtype)
            descent.run(max(0, steps - SORTING_STEPS), contest=True)
            better = descent.value < loss[kept]
            theta = torch.where(better, descent.theta, theta[:, kept])
            loss = torch.where(better, descent.value, loss[kept])
            converged = descent.converged
        else:
            converged |= loss <= least
        return self.solutions(theta.double(), loss.double(), converged, evidence)

    def starts(self, evidence: Evidence) -> Tensor:
        """θ of every start, (P, S)."""
        return self._started(self._start_points(evidence, None))

    def _started(self, points: Tensor) -> Tensor:
        scales = self.start_scales if self.concept.learns_scale else self.start_scales[:1]
        return torch.cat([self.concept.start(points, scale) for scale in scales], dim=1)

    def climb(self, evidence: Evidence, steps: int) -> FloatArray:
        """Where every start is after ``steps`` evaluations, none dropped and none merged: θ (P, S)."""
        descent = self._descent(self.starts(evidence).float(), evidence)
        descent.run(steps)
        return np.asarray(self.concept.canonical(descent.theta.double()).cpu().numpy())

    def evidence(self, bags: Bags) -> Evidence:
        """The bags as this search sees them, to be searched and extended many times.

        Raises:
            ValueError: Features or a scale that do not fit the bags.
        """
        d = bags.n_features
        if self.features is not None and max(self.features) >= d:
            raise ValueError(f"features names feature {max(self.features)}, the bags have {d} features")
        if np.ndim(self.scale) and np.shape(self.scale) != (d,):
            raise ValueError(f"scale has shape {np.shape(self.scale)}, the bags have {d} features")
        features = np.arange(d) if self.features is None else np.array(self.features, dtype=np.int64)
        scale = np.broadcast_to(np.asarray(self.scale, dtype=np.float64), (d,))[features]
        # In the middle of the data, where products of features are smallest and lose the fewest digits.
        origin = bags.instances.mean(0).cpu().numpy()[features]
        return Evidence(
            bags,
            self.concept,
            Frame(features, origin, scale, d),
            likelihood=Likelihood(self.concept.link, self.negative_strength, self.leak),
            negative_width=self.negative_width,
            max_pairs=self.max_pairs,
        )

    def _start_points(self, evidence: Evidence, starts: ArrayLike | None) -> Tensor:
        """In scaled features, (S, m)."""
        if starts is None:
            instances = evidence.positive_instances()
            points = instances[np.sort(np.unique(instances, axis=0, return_index=True)[1])]
            points = points if self.max_starts is None else evenly(points, self.max_starts)
        else:
            given = np.asarray(starts, dtype=np.float64)
            if given.ndim != 2 or given.shape[1] != evidence.frame.n_features or not np.isfinite(given).all():
                raise ValueError(f"starts must be finite, of shape (m, {evidence.frame.n_features}), got {given.shape}")
            points = distinct(evidence.scaled(given))
        return torch.from_numpy(points).to(evidence.device)

    def _descent(self, theta: Tensor, evidence: Evidence, curvature: float | None = None) -> BatchedLBFGS:
        bounds = self.concept.bounds(len(evidence.frame.features))
        return BatchedLBFGS(evidence.loss, theta, bounds, tolerance=self.tolerance, curvature=curvature)

    def _best_apart(self, theta: Tensor, loss: Tensor, n: int) -> list[int]:
        points = self.concept.canonical(theta).T.contiguous().cpu().numpy()
        return best_apart(points, loss.cpu().numpy(), self.merge_radius, n)

    def _in_frame(self, solution: Solution, evidence: Evidence) -> Tensor:
        if solution.concept != self.concept:
            raise ValueError(f"warm holds a {solution.concept}, this search is for a {self.concept}")
        known, frame = solution.frame, evidence.frame
        if known is not frame and not all(map(np.array_equal, known[:3], frame[:3])):
            raise ValueError(
                "warm comes from other scaled features: keep the evidence of the first search, add bags to it, and "
                "search that"
            )
        return torch.from_numpy(solution.theta).to(evidence.device)

    def _solutions(self, descent: BatchedLBFGS, evidence: Evidence) -> list[Solution]:
        theta = descent.theta.double()
        return self.solutions(theta, evidence.value(theta), descent.converged, evidence, rounded=True)

    def solutions(
        self, theta: Tensor, loss: Tensor, converged: Tensor, evidence: Evidence, *, rounded: bool = False
    ) -> list[Solution]:
        """Solutions at θ (P, S), smallest loss first, merged; the loss is −log density − log prior, (S,).

        Those that tie, ``rounded`` by a climb, come in the order of their parameters: no rounding decides.
        """
        theta = self.concept.canonical(theta)
        density = (-loss - self.concept.log_prior(theta)[0]).tolist()
        columns, rested, losses = theta.T.cpu().numpy(), converged.tolist(), loss.tolist()
        best = self._best_apart(theta, loss, len(columns))
        if rounded:
            best = ties_in_order(best, columns, losses)
        return [Solution(self.concept, columns[i].copy(), evidence.frame, density[i], rested[i]) for i in best]
