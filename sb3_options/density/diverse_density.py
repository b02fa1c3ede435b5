"""Diverse density of a point over bags of instances, and the search for its peaks.

A concept is a point t with a scale s (one over its width) per feature, in the feature space of the instances.
Its diverse density is high where many positive bags, and no negative bag, have an instance nearby.
Sources: Maron and Lozano-Pérez, "A framework for multiple-instance learning" (1998); McGovern and Barto,
"Accelerating reinforcement learning through the discovery of useful subgoals" (2001), section 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from sb3_options.checked import is_number, whole
from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags, distinct, held_by_all
from sb3_options.density.checks import check_finite, positive_scale, real_array, refuse
from sb3_options.density.concepts import Point
from sb3_options.density.energies import Columns, Likelihood
from sb3_options.density.layout import Workspace
from sb3_options.density.objective import evaluate
from sb3_options.density.one_hot import is_one_hot, one_hot_log_density
from sb3_options.density.peaks import best_apart
from sb3_options.density.search import ConceptSearch, Solution
from sb3_options.state import storable

ARRIVED = 1e-5
"""An ascent has arrived when two steps running raise the log density by less than this share of it, or of 1 nat."""

APART = 0.9
"""Where instances that were visited one after the other lie so many widths apart, no other point ties with them."""

TRIED_PAIRS = 1 << 20
"""(Instances × points) that a search evaluates at once where there is little evidence."""

SHORTLIST = 4
"""Times the number of starts: how many points are evaluated on all bags, or more where there is little evidence."""


def _columns(t: Tensor, s: Tensor) -> Columns:
    """Points relative to the origin of the bags, and scales, (S, d), as the kernels read them."""
    t, squares = t.T, s.T.square()
    return Columns(torch.cat([(squares * t * t).sum(0, keepdim=True), -2 * squares * t, squares]), t, exact=True)


class _LogDiverseDensity(torch.autograd.Function):
    """The objective's value and closed-form gradient as a function of points and scales, for autograd."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, scales: Tensor, bags: Bags, likelihood: Likelihood) -> Tensor:
        at = evaluate(_columns(points, scales), bags.segments, likelihood, Workspace())
        constant, first, second = (part.T for part in torch.split(at.gradient, [1, points.shape[1], points.shape[1]]))
        near_first, near_second = (part.T for part in at.near.chunk(2))
        # Sums of the weights times x − t and (x − t)².
        pull = first - points * constant + near_first
        spread = second - points * (2 * first - points * constant) + near_second
        ctx.save_for_backward(-2 * scales.square() * pull, 2 * scales * spread)
        return at.log_density

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None, None]:
        by_point, by_scale = ctx.saved_tensors
        return grads[0][:, None] * by_point, grads[0][:, None] * by_scale, None, None


def log_diverse_density(
    points: ArrayLike | Tensor,
    scales: ArrayLike | Tensor,
    bags: Bags,
    *,
    negative_strength: float = 1.0,
    leak: float = 0.0,
) -> Tensor:
    """Log diverse density log DD(t, s) = Σ_i log Pr(t | B_i⁺) + Σ_i log Pr(t | B_i⁻), at most 0 (`objective`).

    Differentiable once in points and scales. Finite at any distance, and −inf just where a point hits an
    instance of a negative bag at full strength. An instance that is hit adds nothing to the gradient. The error is
    below 1e-9 of the value, plus the rounding of the sum.

    Args:
        points: (S, d) concepts t, in the units of the features.
        scales: (S, d), (d,) or a number: one over the width of the concept.
        bags: The evidence.
        negative_strength: η in (0, 1]: below 1 a negative instance does not rule a point out.
        leak: λ in [0, 1): the probability that a bag is positive for a reason other than the concept, as in a leaky
            noisy-or (Henrion 1989): Pr(t | B⁺) = λ + (1 − λ) (1 − Π_j (1 − p_j)). Above 0, a bag without the concept
            costs no more than log λ, however far it is.

    Returns:
        Shape (S,), in nats and in the precision of the bags.

    Raises:
        ValueError: Shapes that do not fit the bags, values not finite, scales, strength or leak out of range.
    """
    if not (is_number(negative_strength) and 0 < negative_strength <= 1):
        raise ValueError(f"negative_strength must lie in (0, 1], got {negative_strength}")
    if not (is_number(leak) and 0 <= leak < 1):
        raise ValueError(f"leak must lie in [0, 1), got {leak}")
    t, s = (
        (x if isinstance(x, Tensor) else torch.from_numpy(real_array(name, x))).to(bags.instances)
        for name, x in (("points", points), ("scales", scales))
    )
    if t.ndim != 2 or t.shape[1] != bags.n_features:
        raise ValueError(f"points must have shape (S, {bags.n_features}) as in the bags, got {tuple(t.shape)}")
    if s.shape not in (t.shape, t.shape[1:], ()):
        raise ValueError(f"scales must be a number, (d,) or (S, d) = {tuple(t.shape)}, got {tuple(s.shape)}")
    check_finite("one of the points", t.detach().cpu().numpy())
    if not positive_scale(s.detach().flatten().cpu()):
        raise ValueError("scales must be positive and finite: a scale is one over a width")
    t, s, likelihood = t - bags.origin, s.expand_as(t), Likelihood("gaussian", negative_strength, leak)
    if torch.is_grad_enabled() and (t.requires_grad or s.requires_grad):
        value: Tensor = _LogDiverseDensity.apply(t, s, bags, likelihood)  # type: ignore[no-untyped-call]  # torch's
    else:
        value = evaluate(_columns(t, s), bags.segments, likelihood, Workspace(), gradient=False).log_density
    return value.to(bags.dtype)


@storable
class Peak(NamedTuple):
    """A concept of high diverse density.

    Attributes:
        point: (d,) in the units of the features.
        scale: (d,) one over the width.
        log_density: Log diverse density there, in nats.
        converged: Whether the ascent had come to rest.
    """

    point: FloatArray
    scale: FloatArray
    log_density: float
    converged: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class DiverseDensity:
    """Search for the points of highest diverse density, of a known scale.

    "exhaustive" evaluates a finite set of candidates, by default all instances of positive bags. "gradient" evaluates
    the instances of the smallest positive bags, and the best of them ascend (`ConceptSearch.ascend`): every positive
    bag holds an instance of the concept, so the smallest are the cheapest complete set of starts. No peak is worse
    than its start.

    Attributes:
        scale: Scale s of the concept, a number or (d,): one over its width.
        method: "gradient" or "exhaustive".
        n_starts: Number of points that ascend.
        n_smallest: Number of positive bags whose instances are tried; above 1, so that a bag whose instance of
            the concept was filtered away does no harm.
        steps: Largest number of steps.
        merge_radius: A point this close to a better one is merged into it, in widths of the concept.
        tolerance: Candidates this close to the maximum tie with it, in nats.
        negative_strength: η of :func:`log_diverse_density`.
        leak: λ of :func:`log_diverse_density`.

    Raises:
        ValueError: An argument out of its range.
    """

    scale: ArrayLike = 1.0
    method: Literal["gradient", "exhaustive"] = "gradient"
    n_starts: int = 8
    n_smallest: int = 3
    steps: int = 12
    merge_radius: float = 0.5
    tolerance: float = 1e-9
    negative_strength: float = 1.0
    leak: float = 0.0

    def __post_init__(self) -> None:
        """Refuse arguments out of range, by name."""
        refuse(
            self,
            scale=("positive, finite, a number or (d,)", positive_scale(self.scale)),
            method=(
                '"gradient" or "exhaustive"',
                isinstance(self.method, str) and self.method in ("gradient", "exhaustive"),
            ),
            n_starts=("a whole number of at least 1", whole(self.n_starts, 1)),
            n_smallest=("a whole number of at least 1", whole(self.n_smallest, 1)),
            steps=("a whole number of at least 1", whole(self.steps, 1)),
            merge_radius=("at least 0", is_number(self.merge_radius) and self.merge_radius >= 0),
            tolerance=("at least 0", is_number(self.tolerance) and self.tolerance >= 0),
            negative_strength=("in (0, 1]", is_number(self.negative_strength) and 0 < self.negative_strength <= 1),
            leak=("in [0, 1)", is_number(self.leak) and 0 <= self.leak < 1),
        )

    @cached_property
    def concepts(self) -> ConceptSearch:
        """The search for concepts that this one is a face of."""
        return ConceptSearch(
            concept=Point("fixed"),
            scale=self.scale,
            tolerance=ARRIVED,
            merge_radius=self.merge_radius,
            negative_strength=self.negative_strength,
            leak=self.leak,
        )

    def log_density(self, points: ArrayLike, bags: Bags) -> FloatArray:
        """Log diverse density, shape (S,), of points (S, d) at the constructor's scale.

        Raises:
            ValueError: As :func:`log_diverse_density`.
        """
        with torch.no_grad():
            value = log_diverse_density(
                points, self.scale, bags, negative_strength=self.negative_strength, leak=self.leak
            )
        return value.double().cpu().numpy()

    def search(self, bags: Bags, *, starts: ArrayLike | None = None, candidates: ArrayLike | None = None) -> list[Peak]:
        """Search for peaks, best first.

        Args:
            bags: The evidence.
            starts: (m, d) more points to try in a gradient search, such as the peaks of the last search; an
                exhaustive search needs none and ignores them.
            candidates: (m, d) what an exhaustive search evaluates, by default every distinct positive instance.

        Returns:
            The peaks of the gradient search, no two within `merge_radius`; or the candidates that tie for the
            maximum, in their order.

        Raises:
            ValueError: No point to search from, points or a scale that do not fit the bags, or candidates given
                to a gradient search.
        """
        exhaustive = self.method == "exhaustive"
        if candidates is not None and not exhaustive:
            raise ValueError('candidates need method="exhaustive": pass starts to a gradient search')
        name, given = ("candidates", candidates) if exhaustive else ("starts", starts)
        points = np.empty((0, bags.n_features)) if given is None else real_array(name, given)
        if points.ndim != 2 or points.shape[1] != bags.n_features or not np.isfinite(points).all():
            raise ValueError(f"{name} must be finite, of shape (m, {bags.n_features}), got {points.shape}")
        if not exhaustive:
            points = np.concatenate([points, bags.smallest_positive(self.n_smallest)])
        elif given is None:
            points = bags.smallest_positive(bags.n_positive)
        if not len(points):
            raise ValueError(f"there is nothing to search from: without positive bags pass {name}")
        points = distinct(points)
        if not exhaustive:
            return self._ascend(points, bags)
        return self.best(points, self._exhaustive_values(points, bags))

    def best(self, points: FloatArray, values: FloatArray) -> list[Peak]:
        """The points (m, d) that tie for the largest of their values (m,), in their order, as peaks."""
        scale = self._scale(points.shape[1])
        ties = np.flatnonzero(values >= values.max() - self.tolerance)
        return [Peak(points[i].copy(), scale, float(values[i]), True) for i in ties]

    def certain(self, positive: Sequence[FloatArray], starts: FloatArray | None = None) -> list[Peak]:
        """Peaks that take no search: a point in every bag has density 1, the most there is, if no bag is negative.

        Args:
            positive: All bags, (n_i, d) each, at least one, instances in the order in which they were visited.
            starts: As of `search`, (m, d).

        Returns:
            Those points in the order of `search`, which would find no better ones; none where none is in every bag, or
            where instances lie closer than `APART`, so that points between them have density 1 as well.
        """
        scale, longest = self._scale(positive[0].shape[1]), max(positive, key=len)
        if (np.linalg.norm(np.diff(longest, axis=0) * scale, axis=1) < APART).any():
            return []
        exhaustive, points = self.method == "exhaustive", positive[0]
        if not exhaustive:
            smallest = sorted(range(len(positive)), key=lambda i: len(positive[i]))[: self.n_smallest]
            points = positive[min(smallest)]
            points = points if starts is None else np.concatenate([starts, points])
        points = distinct(points)
        points = points[held_by_all(points, positive)]
        if not exhaustive:
            points = points[best_apart(points * scale, np.zeros(len(points)), self.merge_radius, len(points))]
        return [Peak(point.copy(), scale, 0.0, True) for point in points]

    def _exhaustive_values(self, points: FloatArray, bags: Bags) -> FloatArray:
        """`log_density` of points, (m,); where all are one-hot codes, and weigh alike, without comparing features."""
        scale, alike = self._scale(bags.n_features), bags.weights is None
        if alike and (scale == scale[0]).all() and is_one_hot(points) and is_one_hot(bags.instances.cpu().numpy()):
            return one_hot_log_density(points, float(scale[0]), bags, self.negative_strength, self.leak)
        return self.log_density(points, bags)

    def _ascend(self, points: FloatArray, bags: Bags) -> list[Peak]:
        evidence = self.concepts.evidence(bags)
        theta = torch.from_numpy(evidence.scaled(points).T.copy()).to(evidence.device)
        known = {column.tobytes(): point for column, point in zip(theta.T.cpu().numpy(), points, strict=True)}
        theta = self.concepts.shortlist(
            evidence, theta, max(SHORTLIST * self.n_starts, TRIED_PAIRS // evidence.n_instances)
        )
        found = self.concepts.ascend(evidence, theta, self.n_starts, steps=self.steps, ties=self.tolerance, least=0.0)
        # A start that was not left is itself, to the last bit.
        return [
            peak._replace(point=known.get(solution.theta.tobytes(), peak.point))
            for peak, solution in zip(self.peaks(found), found, strict=True)
        ]

    def peaks(self, solutions: Sequence[Solution]) -> list[Peak]:
        """Solutions of `concepts` as peaks."""
        scale = self._scale(len(solutions[0].theta))
        return [Peak(s.theta / s.frame.scale + s.frame.origin, scale, s.log_density, s.converged) for s in solutions]

    def _scale(self, n_features: int) -> FloatArray:
        return np.broadcast_to(np.asarray(self.scale, dtype=np.float64), (n_features,)).copy()
