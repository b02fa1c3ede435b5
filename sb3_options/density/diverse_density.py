"""The search for concepts of highest diverse density.

A concept is a point t with a scale s (one over its width) per feature, in the feature space of the instances. Its
diverse density is high where many positive bags, and no negative bag, have an instance nearby.
Sources: Maron and Lozano-Pérez, "A framework for multiple-instance learning" (1998); McGovern and Barto,
"Accelerating reinforcement learning through the discovery of useful subgoals" (2001), section 4.
"""

import functools
import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from sb3_options.checked import Field, settings
from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags, distinct, held_by_all, positive_scale, real_array
from sb3_options.density.concepts import Concept, HalfSpace, Point
from sb3_options.density.energies import Likelihood
from sb3_options.density.evidence import Evidence, evenly
from sb3_options.density.lbfgs import BatchedLBFGS
from sb3_options.density.log_density import log_diverse_density
from sb3_options.density.one_hot import is_one_hot, one_hot_log_density
from sb3_options.density.regions import Region
from sb3_options.state import storable

POINT = Point("fixed")

APART = 0.9  # if successive instances lie at least this many widths apart, no other point ties with them
APART_BY = 0.5  # a peak this close to a better one is merged into it, in parameters: for points, in widths
TIED = 1e-9  # points tie if their log densities differ by less than this, in nats
TINY = float(np.finfo(np.float64).tiny)

SMALLEST_BAGS = 3  # positive bags whose instances a gradient search tries; a filter may take the concept out of one
ASCENDING = 8  # points that ascend in a gradient search
ASCENT_STEPS = 12  # its maximum evaluations
SORTING_STEPS = 3  # its evaluations after which close points merge
ARRIVED = 1e-5  # it ends when two successive steps gain less than this share of the log density, or of 1 nat
SHORTLIST = 32  # points that it evaluates on all bags; more as long as instances × points are below `SHORTLIST_PAIRS`
SHORTLIST_PAIRS = 1 << 20
SAMPLED_BAGS = 3  # the shortlist is chosen on this many bags of each sign,
PROMISING = 8  # then one point in this many on this many times more bags
FIRST_STEPS = 20  # a thorough search thins out its starts after every so many evaluations,
SURVIVORS = 4  # keeping one in this many
FINAL_STEPS = 500  # maximum evaluations of the finalists in each precision
TOLERANCE = 1e-8  # of the finalists, in nats relative to the value
TIES = 1e-5  # peaks tie if their losses are this close, relatively or in nats
SAME_PARAMETER = 1e-3  # parameters this close do not order them


@storable
class Peak(NamedTuple):
    """A concept of high diverse density: Pr(x ∈ concept) = exp(−Σ_k (s_k (x_k − t_k))²).

    Attributes:
        point: t, the centre, (d,) in the units of the features.
        scale: s, one over the width, (d,); 0 for a feature that does not count. For a half-space, s is the normal and t
            is on the boundary: Pr(x ∈ concept) = 1 / (1 + exp(−s · (x − t))).
        log_density: Log diverse density at the peak, in nats, without the prior.
        converged: Whether the ascent converged.
        is_half_space: Whether the concept is a half-space.
    """

    point: FloatArray
    scale: FloatArray
    log_density: float
    converged: bool
    is_half_space: bool = False

    def region(self, level: float = 0.5) -> Region:
        """Return the region where Pr(x ∈ concept) ≥ level, in (0, 1): a subgoal that β can test."""
        if self.is_half_space:
            shift = self.scale * math.log(level / (1 - level)) / max(float(self.scale @ self.scale), TINY)
            return Region((self.point + shift)[None], np.ones_like(self.scale), 0.0, normal=self.scale)
        return Region(self.point[None], self.scale, math.sqrt(-math.log(level)))

    def probability(self, instances: ArrayLike) -> FloatArray:
        """Return Pr(x ∈ concept) of instances (n, d), shape (n,)."""
        difference = np.asarray(instances) - self.point
        if self.is_half_space:
            return np.asarray(torch.from_numpy(difference @ self.scale).sigmoid())
        return np.asarray(np.exp(-np.square(difference * self.scale).sum(axis=1)))


@settings
class DiverseDensity:
    """Search for the concepts of highest diverse density.

    Attributes:
        concept: Class of concepts; by default points of the given scale.
        scale: Factor for every feature, a number or (d,): one over the width of the concept. If scales are learned,
            one over the width at scale 1.
        method: "gradient" evaluates the instances of the smallest positive bags, and the best ascend a few steps. It
            needs points of known scale, and is their default. "thorough" lets all distinct instances of positive bags
            ascend in single precision. The best continue, and the finalists converge in double precision. It also
            allows learned scales and half-spaces. "exhaustive" evaluates a finite set of candidates, by default all
            instances of positive bags. It needs points of known scale.
        max_starts: Maximum starts of a thorough search, evenly spaced among all instances; None for all.
        finalists: Maximum starts that a thorough search climbs to the end.
        negative_strength: η in (0, 1]: each negative instance contributes log(1 − η p).
        leak: λ in [0, 1): the probability that a bag is positive for a reason other than the concept.
    """

    concept: Concept = POINT
    scale: Any = 1.0
    method: Literal["gradient", "thorough", "exhaustive"] | None = None
    max_starts: Annotated[int, Field(ge=1)] | None = 256
    finalists: Annotated[int, Field(ge=1)] = 32
    negative_strength: Annotated[float, Field(gt=0, le=1)] = 1.0
    leak: Annotated[float, Field(ge=0, lt=1)] = 0.0

    def __post_init__(self) -> None:
        """Choose the method that the concept needs; refuse an invalid method or scale."""
        known_scale = self.concept == POINT
        if self.method is None:
            object.__setattr__(self, "method", "gradient" if known_scale else "thorough")
        if not positive_scale(self.scale):
            raise ValueError(f"scale must be positive, finite, a number or (d,), got {self.scale!r}")
        if self.method != "thorough" and not known_scale:
            raise ValueError(f'{self.concept} needs method="thorough", got {self.method!r}')

    def log_density(self, points: ArrayLike, bags: Bags) -> FloatArray:
        """Return the log diverse density (S,) of points (S, d) at the given scale, as `log_diverse_density`."""
        with torch.no_grad():
            value = log_diverse_density(
                points, self.scale, bags, negative_strength=self.negative_strength, leak=self.leak
            )
        return value.double().numpy()

    def search(self, bags: Bags, *, starts: ArrayLike | None = None) -> list[Peak]:
        """Search for peaks, best first.

        Args:
            bags: The evidence.
            starts: Points (m, d), such as the peaks of the last search. A gradient search adds them to its own points.
                Other searches use them instead of the instances of positive bags.

        Returns:
            The peaks, prior included, no two within ``APART_BY``. An exhaustive search returns the points that tie for
            the maximum, in their order.

        Raises:
            ValueError: There is no point to search from, or starts, features or scale do not fit the bags.
        """
        points = np.empty((0, bags.n_features)) if starts is None else real_array("starts", starts)
        if points.ndim != 2 or points.shape[1] != bags.n_features or not np.isfinite(points).all():
            raise ValueError(f"starts must be finite, of shape (m, {bags.n_features}), got {points.shape}")
        if not (len(points) or bags.n_positive):
            raise ValueError("there is nothing to search from: without positive bags pass starts")
        if self.method == "thorough":
            return self._thorough(points, bags)
        if self.method == "exhaustive":
            points = distinct(points) if len(points) else bags.smallest_positive(bags.n_positive)
            return self.best(points, self._exhaustive_values(points, bags))
        return self._quick(distinct(np.concatenate([points, bags.smallest_positive(SMALLEST_BAGS)])), bags)

    def best(self, points: FloatArray, values: FloatArray) -> list[Peak]:
        """Return as peaks the points (m, d) that tie for the largest value (m,), in their order."""
        scale = self._scale(points.shape[1])
        ties = np.flatnonzero(values >= values.max() - TIED)
        return [Peak(points[i].copy(), scale, float(values[i]), True) for i in ties]

    def certain(self, positive: Sequence[FloatArray], starts: FloatArray | None = None) -> list[Peak]:
        """Return peaks that need no search: without negative bags, a point in every bag has the maximum density 1.

        Each positive bag (n_i, d) has its instances in order of visit. From the same starts `search` finds the same
        peaks. The result is empty if instances lie closer than ``APART``: points between them then have density 1 too.
        """
        scale = self._scale(positive[0].shape[1])
        longest = max(positive, key=len)
        if (np.linalg.norm(np.diff(longest, axis=0) * scale, axis=1) < APART).any():
            return []
        exhaustive = self.method == "exhaustive"
        points = positive[0]
        if not exhaustive:
            smallest = sorted(range(len(positive)), key=lambda i: len(positive[i]))[:SMALLEST_BAGS]
            points = positive[min(smallest)]
            points = points if starts is None else np.concatenate([starts, points])
        points = distinct(points)
        points = points[held_by_all(points, positive)]
        if not exhaustive:
            points = points[best_apart(points * scale, np.zeros(len(points)), APART_BY, len(points))]
        return [Peak(point.copy(), scale, 0.0, True) for point in points]

    def evidence(self, bags: Bags) -> Evidence:
        """Return the bags in scaled features, as searches see them."""
        # Relative to the mean, products of features are smallest and lose the fewest digits.
        middle = bags.instances.mean(0).numpy()
        likelihood = Likelihood(self.negative_strength, self.leak, isinstance(self.concept, HalfSpace))
        return Evidence(bags, self.concept, middle, self._scale(bags.n_features), likelihood)

    def starts(self, evidence: Evidence, points: FloatArray | None = None) -> Tensor:
        """Return θ (P, S) of all starts of a thorough search: scaled points (m, d), by default the instances."""
        if points is None:
            instances = evidence.positive_instances()
            points = instances[np.sort(np.unique(instances, axis=0, return_index=True)[1])]
            points = points if self.max_starts is None else evenly(points, self.max_starts)
        return self.concept.start(torch.from_numpy(points), 1.0)

    def descent(self, theta: Tensor, evidence: Evidence) -> BatchedLBFGS:
        """Return the ascent of log density plus log prior from θ (P, S)."""
        return BatchedLBFGS(evidence.loss, theta, self.concept.bounds(len(evidence.scale)), tolerance=TOLERANCE)

    def peaks(
        self, theta: Tensor, loss: Tensor, converged: Tensor, evidence: Evidence, *, rounded: bool = False
    ) -> list[Peak]:
        """Return the merged peaks at θ (P, S), smallest loss (S,) first; the loss is −log density − log prior.

        With ``rounded`` losses, tied peaks are ordered by their parameters, so that no rounding error decides.
        """
        theta = self.concept.canonical(theta)
        density = (-loss - self.concept.log_prior(theta)[0]).tolist()
        rested, losses = converged.tolist(), loss.tolist()
        best = self._best_apart(theta, loss, len(losses))
        if rounded:
            best = ties_in_order(best, theta.T.numpy(), losses)
        points, scales = (part.T for part in self.concept.point_and_scale(theta.numpy()))
        points, scales = points / evidence.scale + evidence.origin, scales * evidence.scale
        half = isinstance(self.concept, HalfSpace)
        return [Peak(points[i].copy(), scales[i].copy(), density[i], rested[i], half) for i in best]

    def _thorough(self, points: FloatArray, bags: Bags) -> list[Peak]:
        evidence = self.evidence(bags)
        theta = self.starts(evidence, distinct(evidence.scaled(points)) if len(points) else None)
        descent = self.descent(theta.float(), evidence)
        n = theta.shape[1]
        while n > self.finalists:
            descent.run(FIRST_STEPS)
            n = max(self.finalists, n // SURVIVORS)
            descent.keep(self._best_apart(descent.theta, descent.value, n), torch.float32)
        descent.run(FINAL_STEPS)
        descent.keep(self._best_apart(descent.theta, descent.value, n), torch.float64)
        descent.run(FINAL_STEPS)
        theta = descent.theta.double()
        return self.peaks(theta, evidence.value(theta), descent.converged, evidence, rounded=True)

    def _quick(self, points: FloatArray, bags: Bags) -> list[Peak]:
        """Evaluate points (m, d) and let the best ascend a few steps. No peak is worse than its start."""
        evidence = self.evidence(bags)
        theta = torch.from_numpy(evidence.scaled(points).T.copy())
        known = {column.tobytes(): point for column, point in zip(theta.T.numpy(), points, strict=True)}
        theta = _shortlist(evidence, theta, max(SHORTLIST, SHORTLIST_PAIRS // len(bags.instances)))
        loss = evidence.value(theta)
        tied = loss <= loss.min() + TIED
        best = self._best_apart(theta, torch.where(tied, loss.min(), loss), max(ASCENDING, int(tied.sum())))
        theta, loss = theta[:, best], loss[best]
        converged = loss <= 0  # nothing is denser than 1
        if loss[0] > 0:
            # Curvature at a point where every bag pulls with full weight: no step is then much too long.
            curvature = 2 * max(1.0, bags.n_positive)
            bounds = self.concept.bounds(bags.n_features)
            descent = BatchedLBFGS(evidence.loss, theta, bounds, tolerance=ARRIVED, curvature=curvature)
            descent.run(SORTING_STEPS)
            kept = self._best_apart(descent.theta, descent.value, ASCENDING)
            descent.keep(kept, theta.dtype)
            descent.run(ASCENT_STEPS - SORTING_STEPS, contest=True)
            better = descent.value < loss[kept]
            theta = torch.where(better, descent.theta, theta[:, kept])
            loss = torch.where(better, descent.value, loss[kept])
            converged = descent.converged
        order = self._best_apart(theta, loss, len(loss))
        found = []
        for i, column in zip(order, theta.T.numpy()[order], strict=True):
            # A start that did not move keeps its exact bits.
            point = known.get(column.tobytes(), column / evidence.scale + evidence.origin)
            found.append(Peak(point, evidence.scale, -float(loss[i]), bool(converged[i])))
        return found

    def _exhaustive_values(self, points: FloatArray, bags: Bags) -> FloatArray:
        """Return `log_density` of points, (m,); one-hot codes need no comparison of features."""
        scale = self._scale(bags.n_features)
        if (scale == scale[0]).all() and is_one_hot(points) and is_one_hot(bags.instances.numpy()):
            return one_hot_log_density(points, float(scale[0]), bags, self.negative_strength, self.leak)
        return self.log_density(points, bags)

    def _best_apart(self, theta: Tensor, loss: Tensor, n: int) -> list[int]:
        points = self.concept.canonical(theta).T.contiguous().numpy()
        return best_apart(points, loss.numpy(), APART_BY, n)

    def _scale(self, n_features: int) -> FloatArray:
        return np.broadcast_to(np.asarray(self.scale, dtype=np.float64), (n_features,)).copy()


def _shortlist(evidence: Evidence, theta: Tensor, n: int) -> Tensor:
    """Return up to ``n`` columns of θ (P, S): the best on a few bags, then the best of these on more bags."""
    for n_bags in (SAMPLED_BAGS, SAMPLED_BAGS * PROMISING):
        if theta.shape[1] > n:
            loss = evidence.sample(n_bags).value(theta.float())
            theta = theta[:, loss.argsort()[: max(n, len(loss) // PROMISING)]]
    return theta[:, :n]


def best_apart(points: FloatArray, loss: FloatArray, radius: float, n: int) -> list[int]:
    """Return rows of up to ``n`` points (S, P), smallest loss first, each beyond ``radius`` of every better one."""
    order = np.argsort(loss, kind="stable")
    points = points[order]
    apart = np.ones(len(order), dtype=bool)
    kept = list[int]()
    for i, number in enumerate(order.tolist()):
        if apart[i]:
            kept.append(number)
            if len(kept) == n:
                break
            difference = points[i + 1 :] - points[i]
            apart[i + 1 :] &= np.einsum("ij,ij->i", difference, difference) > radius**2
    return kept


def ties_in_order(best: list[int], points: FloatArray, losses: Sequence[float]) -> list[int]:
    """Return rows of points (S, P), smallest loss first; ties for it are ordered by their parameters."""
    limit = losses[best[0]] + TIES * max(1.0, abs(losses[best[0]]))
    tied = [i for i in best if losses[i] <= limit]
    key = functools.cmp_to_key(_compare)
    return [*sorted(tied, key=lambda i: key(points[i])), *best[len(tied) :]]


def _compare(one: FloatArray, other: FloatArray) -> int:
    """Compare two points by the first parameter in which they differ."""
    apart = np.flatnonzero(np.abs(one - other) > SAME_PARAMETER)
    return int(np.sign(one[apart[0]] - other[apart[0]])) if len(apart) else 0
