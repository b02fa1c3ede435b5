"""Diverse density of a concept over bags of instances, and the search for its peaks.

A concept is a point t with a scale s (one over its width) per feature, in the feature space of the instances.
Its diverse density is high where many positive bags, and no negative bag, have an instance nearby.
Sources: Maron and Lozano-Pérez, "A framework for multiple-instance learning" (1998); McGovern and Barto,
"Accelerating reinforcement learning through the discovery of useful subgoals" (2001), section 4.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags, Layout, distinct

# (points × instances) held at once: bounds the memory; larger arrays leave the cache, smaller ones cost calls.
MAX_PAIRS = 1 << 17
# Up to this many features plain differences are faster than a matrix product and its corrections.
MAX_BROADCAST_FEATURES = 4
# Times the number of starts: how many of the points tried are evaluated in full.
SHORTLIST = 4
# A start whose step is shorter than this, in widths of the concept or e-folds of the scale, has arrived.
ARRIVED = 1e-3
# Longest step of the scale, in e-folds.
LOG_SCALE_STEP = 0.25


def _log2_membership(points: Tensor, scales: Tensor, layout: Layout) -> Tensor:
    """log₂ Pr(B_ij ∈ c) = −log₂(e) D_ij with D_ij = Σ_k (s_k (x_ijk − t_k))²; shape (S, places).

    Exactly 0 on a hit. In powers of two because `torch.exp2` takes a fraction of the time of `torch.exp`.
    """
    roots = scales * math.sqrt(math.log2(math.e))
    d = points.shape[1]
    features = layout.powers[1 : d + 1]
    if d <= MAX_BROADCAST_FEATURES:
        difference = (features - points[..., None]).mul_(roots[..., None])
        return layout.padding - difference.square_().sum(1)
    squares = roots.square()
    size = squares @ layout.powers[d + 1 :] + (squares * points.square()).sum(1, keepdim=True)
    out = torch.addmm(layout.padding, squares * points, features, alpha=2).sub_(size)
    # The products round relative to the size of the coordinates: close pairs are done again by differences.
    close = out > size.mul_(-(torch.finfo(out.dtype).eps ** 0.375))
    for pairs in torch.split(close.nonzero(), max(1, MAX_PAIRS // d)):
        point, place = pairs.T
        difference = (features[:, place] - points[point].T).mul_(roots[point].T)
        out[point, place] = -difference.square_().sum(0)
    return out


def _noisy_or(log2_p: Tensor, layout: Layout, leak: float = 0.0) -> tuple[Tensor, Tensor]:
    """Σ_i log Pr(t | B_i⁺) = Σ_i log(1 − Π_j (1 − p_ij)), shape (S,), and weights −∂/∂D_ij, (S, places).

    The weight p_ij Π_{k≠j} (1 − p_ik) / Pr(t | B_i⁺) lies in [0, 1] and tends to the soft-max of −D_ij as the
    bag recedes. The bag's largest p is factored out, so nothing underflows at any distance. Where it is small,
    1 − Π would cancel, and Π (1 − p_j) = exp(−Σ p_j − Σ p_j² / 2 − …) takes its place; the cube root of the
    precision balances the two errors. With a leak λ, Pr is λ + (1 − λ) (1 − Π). Overwrites its argument.
    """
    precision = torch.finfo(log2_p.dtype)
    floor = math.log2(precision.tiny) / 2  # keeps squares above the subnormal numbers, which are slow
    log2_p = log2_p.view(len(log2_p), *layout.rows)
    top = layout.per_bag(log2_p.amax(-1), "amax")
    # Kept below 1: on a hit 1 − p = 0 would make the weight 0/0.
    largest = torch.exp2(top).clamp_(2.0**floor, 1 - precision.eps)
    minus = -largest
    share = log2_p.sub_(layout.per_row(top)).clamp_(min=floor).exp2_()
    linear = layout.per_bag(share.sum(-1), "sum")
    quadratic = layout.per_bag(torch.linalg.vecdot(share, share), "sum")
    miss = (share * layout.per_row(minus)).add_(1)
    all_miss = layout.per_bag(miss.prod(-1), "prod")
    series = torch.addcmul(linear, quadratic, largest, value=0.5).mul_(minus)
    minus_hit = torch.where(largest > precision.eps ** (1 / 3), all_miss - 1, series.expm1_())
    hit_share = minus_hit.div_(minus)  # Pr(t | B⁺) over the largest p: at least 1 on a hit, which the clamp makes log 1
    log_hit = hit_share.log().add_(top, alpha=math.log(2)).clamp_(max=0)
    ratio = all_miss.div_(hit_share)
    if leak:
        hit = log_hit.exp().mul_(1 - leak)
        log_hit = (hit + leak).log()
        ratio.mul_(hit.div_(hit + leak))
    if layout.bag_weights is not None:
        log_hit, ratio = log_hit * layout.bag_weights, ratio * layout.bag_weights
    weights = share.div_(miss).mul_(layout.per_row(ratio))
    return log_hit.sum(1), weights.flatten(1)


def _noisy_nor(log2_p: Tensor, strength: float, bag_weights: Tensor | None) -> tuple[Tensor, Tensor]:
    """Σ_i log Pr(t | B_i⁻) = Σ_ij log(1 − η p_ij), shape (S,), and weights ∂/∂D_ij, (S, places).

    The weight is η p_ij / (1 − η p_ij). An instance that is hit has weight 0: its distance is at its minimum,
    and the gradient stays finite.
    """
    p = torch.exp2(log2_p).mul_(strength)
    miss = (1 - strength) - strength * torch.expm1(log2_p * math.log(2))
    log_miss = torch.where(p < 0.5, torch.log1p(-p), miss.log())
    # Below the square of the precision a distance is noise, and its weight would only overflow.
    weights = p * (miss > 0) / miss.clamp(min=torch.finfo(p.dtype).eps ** 2)
    if bag_weights is not None:
        log_miss, weights = log_miss * bag_weights, weights * bag_weights
    return log_miss.sum(1), weights


def _by_nearest(points: Tensor, scale: Tensor, layout: Layout, n: int, leak: float = 0.0) -> Tensor:
    """Indices of `n` points by Σ_i max_j log Pr(B_ij ∈ c) over positive bags: a fifth of the work of a noisy-or.

    A bag that leaks counts for no less than the log of its leak.
    """
    if len(points) <= n or not layout.n_bags:
        return torch.arange(len(points), device=points.device)
    d, n_places = len(scale), math.prod(layout.rows)
    features, squares = layout.powers[1 : d + 1, :n_places], layout.powers[d + 1 :, :n_places]
    offset = layout.padding[:n_places] - scale.square() @ squares
    bounds = []
    for t in torch.split(points * scale.square(), max(1, MAX_PAIRS // n_places)):
        nearest = torch.addmm(offset, t, features, alpha=2).view(-1, *layout.rows).amax(-1)
        nearest = layout.per_bag(nearest, "amax")
        if leak:
            nearest = torch.maximum(nearest, (t / scale).square().sum(1, keepdim=True) + math.log(leak))
        bounds.append(nearest.sum(1))
    bound = torch.cat(bounds) - layout.n_bags * (points * scale).square().sum(1)
    return bound.topk(n).indices


class _Densities(NamedTuple):
    """Log densities (S,) and moments (S, 1 + 2 d): sums over instances of the weight times 1, x_k and x_k².

    The weight is −∂/∂D of the log density in `net`, negative for an instance that repels; in `total` it has no
    sign.
    """

    log_density: Tensor
    net: Tensor
    total: Tensor


def _evaluate(points: Tensor, scales: Tensor, layout: Layout, strength: float, leak: float = 0.0) -> _Densities:
    """Evaluate points and scales (S, d), relative to the origin, as many at once as `MAX_PAIRS` allows."""
    at_once = max(1, MAX_PAIRS // len(layout.padding))
    if len(points) > at_once:
        chunks = zip(torch.split(points, at_once), torch.split(scales, at_once), strict=True)
        parts = [_evaluate(t, s, layout, strength, leak) for t, s in chunks]
        return _Densities(*map(torch.cat, zip(*parts, strict=True)))
    n = math.prod(layout.rows)
    log2_p = _log2_membership(points, scales, layout)
    log_density, weights = _noisy_or(log2_p[:, :n], layout, leak)
    attract = weights @ layout.powers[:, :n].T
    if n == len(layout.padding):
        return _Densities(log_density, attract, attract)
    log_none, weights = _noisy_nor(log2_p[:, n:], strength, layout.negative_weights)
    repel = weights @ layout.powers[:, n:].T
    return _Densities(log_density.add_(log_none), attract - repel, attract + repel)


def _pull(moments: Tensor, points: Tensor) -> Tensor:
    """Σ w (x − t), shape (S, d): half the gradient of the log density in t, at scale 1."""
    return torch.addcmul(moments[:, 1 : points.shape[1] + 1], points, moments[:, :1], value=-1)


def _spread(moments: Tensor, points: Tensor) -> Tensor:
    """Σ w (x − t)², shape (S, d): minus half the gradient of the log density in s, at scale 1."""
    first, second = moments[:, 1 : points.shape[1] + 1], moments[:, points.shape[1] + 1 :]
    return second - points * (first + _pull(moments, points))


class _LogDiverseDensity(torch.autograd.Function):
    """The closed-form gradient for autograd; no (points × instances) array outlives the forward pass."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, scales: Tensor, layout: Layout, strength: float, leak: float) -> Tensor:
        log_density, net, _ = _evaluate(points, scales, layout, strength, leak)
        ctx.save_for_backward(2 * scales.square() * _pull(net, points), -2 * scales * _spread(net, points))
        return log_density

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None, None, None]:
        by_point, by_scale = ctx.saved_tensors
        return grads[0][:, None] * by_point, grads[0][:, None] * by_scale, None, None, None


def log_diverse_density(
    points: ArrayLike | Tensor,
    scales: ArrayLike | Tensor,
    bags: Bags,
    *,
    negative_strength: float = 1.0,
    leak: float = 0.0,
) -> Tensor:
    """Log diverse density log DD(t, s) = Σ_i log Pr(t | B_i⁺) + Σ_i log Pr(t | B_i⁻), at most 0.

    Differentiable once in points and scales. Finite at any distance, and −inf just where a point hits an
    instance of a negative bag at full strength. An instance that is hit adds nothing to the gradient. In double
    precision the error is below 1e-10 of the value, plus the rounding of the sum.

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
    if not 0 < negative_strength <= 1:
        raise ValueError(f"negative_strength must lie in (0, 1], got {negative_strength}")
    if not 0 <= leak < 1:
        raise ValueError(f"leak must lie in [0, 1), got {leak}")
    layout = bags.layout(bags.dtype)
    t, s = (
        (x if isinstance(x, Tensor) else torch.from_numpy(np.array(x, dtype=np.float64))).to(layout.origin)
        for x in (points, scales)
    )
    if t.ndim != 2 or t.shape[1] != bags.n_features:
        raise ValueError(f"points must have shape (S, {bags.n_features}) as in the bags, got {tuple(t.shape)}")
    if s.shape not in (t.shape, t.shape[1:], ()):
        raise ValueError(f"scales must be a number, (d,) or (S, d) = {tuple(t.shape)}, got {tuple(s.shape)}")
    if not bool(t.isfinite().all()):
        raise ValueError("points hold NaN or infinite features")
    if not bool((s.isfinite() & (s > 0)).all()):
        raise ValueError("scales must be positive and finite: a scale is one over a width")
    t, s = (t - layout.origin).to(bags.dtype), s.expand_as(t).to(bags.dtype)
    value = _LogDiverseDensity.apply(t, s, layout, negative_strength, leak)  # type: ignore[no-untyped-call]  # torch's
    return cast(Tensor, value)


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
    """Search for the concepts of highest diverse density.

    "gradient" ascends from the best instances of the smallest positive bags: every positive bag holds an
    instance of the concept, so the smallest are the cheapest complete set of starts. A step is the gradient over
    twice the mass of its weights, which carries a point to the weighted mean of the instances that attract it.
    The ascent runs in single precision; where it ends is compared with its start in the precision of the bags,
    so that no peak is worse than its start. "exhaustive" evaluates a finite set of candidates.

    Attributes:
        scale: Scale s of the concept, a number or (d,): one over its width.
        method: "gradient" or "exhaustive".
        learn_scale: Whether the gradient search learns the scale too. Without negative bags that is degenerate:
            the scale goes to its lower bound.
        scale_bounds: Smallest and largest learned scale, as factors of `scale`.
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
    learn_scale: bool = False
    scale_bounds: tuple[float, float] = (0.1, 10.0)
    n_starts: int = 8
    n_smallest: int = 3
    steps: int = 12
    merge_radius: float = 0.5
    tolerance: float = 1e-9
    negative_strength: float = 1.0
    leak: float = 0.0

    def __post_init__(self) -> None:
        scale = np.asarray(self.scale, dtype=np.float64)
        in_range = scale.ndim < 2 and bool(((scale > 0) & np.isfinite(scale)).all())
        low, high = self.scale_bounds
        checks = {
            "scale": ("positive, finite, a number or (d,)", in_range),
            "method": ('"gradient" or "exhaustive"', self.method in ("gradient", "exhaustive")),
            "learn_scale": ("False in exhaustive search", self.method == "gradient" or not self.learn_scale),
            "scale_bounds": ("finite factors 0 < low <= 1 <= high", 0 < low <= 1 <= high < math.inf),
            "n_starts": ("at least 1", self.n_starts >= 1),
            "n_smallest": ("at least 1", self.n_smallest >= 1),
            "steps": ("at least 1", self.steps >= 1),
            "merge_radius": ("at least 0", self.merge_radius >= 0),
            "tolerance": ("at least 0", self.tolerance >= 0),
            "negative_strength": ("in (0, 1]", 0 < self.negative_strength <= 1),
            "leak": ("in [0, 1)", 0 <= self.leak < 1),
        }
        for name, (expected, holds) in checks.items():
            if not holds:
                raise ValueError(f"{name} must be {expected}, got {getattr(self, name)!r}")

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
        points = np.empty((0, bags.n_features)) if given is None else np.asarray(given, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != bags.n_features or not np.isfinite(points).all():
            raise ValueError(f"{name} must be finite, of shape (m, {bags.n_features}), got {points.shape}")
        if np.ndim(self.scale) and np.shape(self.scale) != (bags.n_features,):
            raise ValueError(f"scale has shape {np.shape(self.scale)}, the bags have {bags.n_features} features")
        if not exhaustive:
            points = np.concatenate([points, bags.smallest_positive(self.n_smallest)])
        elif given is None:
            points = bags.smallest_positive(bags.n_positive)
        if not len(points):
            raise ValueError(f"there is nothing to search from: without positive bags pass {name}")
        points = distinct(points)
        if not exhaustive:
            return self._ascend(points, bags)
        value = self.log_density(points, bags)
        scale = np.broadcast_to(np.asarray(self.scale, dtype=np.float64), points.shape)
        return [
            Peak(points[i].copy(), scale[i].copy(), float(value[i]), True)
            for i in np.flatnonzero(value >= value.max() - self.tolerance)
        ]

    @torch.no_grad()
    def _ascend(self, starts: FloatArray, bags: Bags) -> list[Peak]:
        layout = bags.layout(torch.float32)
        width = np.broadcast_to(np.asarray(self.scale, dtype=np.float64), starts.shape[1:])

        def evaluate(points: Tensor, scales: Tensor) -> _Densities:
            return _evaluate(points, scales, layout, self.negative_strength, self.leak)

        points = (torch.from_numpy(starts).to(layout.origin) - layout.origin).float()
        base = torch.tensor(width, dtype=torch.float32, device=points.device)
        shortlist = _by_nearest(points, base, layout, SHORTLIST * self.n_starts, self.leak)
        value = points.new_full((len(points),), -math.inf)
        value[shortlist] = evaluate(points[shortlist], base.expand_as(points[shortlist])).log_density
        kept = best_apart(starts * width, value.cpu().numpy(), self.merge_radius, self.n_starts)
        starts, points = starts[kept], points[kept]
        scales = base.repeat(len(kept), 1)
        best, best_points, best_scales = points.new_full((len(kept),), -math.inf), points, scales
        moved = points.new_full((len(kept),), math.inf)
        for _ in range(self.steps):
            at = evaluate(points, scales)
            better = at.log_density > best
            best = torch.where(better, at.log_density, best)
            best_points = torch.where(better[:, None], points, best_points)
            best_scales = torch.where(better[:, None], scales, best_scales)
            # Where every bag is satisfied the weights vanish, and so must the step.
            step = _pull(at.net, points) / at.total[:, :1].clamp(min=torch.finfo(points.dtype).eps)
            moved = (step * scales).abs().amax(1)
            if self.learn_scale:
                spread, total = _spread(at.net, points), _spread(at.total, points)
                share = (spread / total.clamp(min=torch.finfo(points.dtype).eps)).clamp(-1, 1)
                widened = scales * torch.exp(-LOG_SCALE_STEP * share)
                widened = torch.clamp(widened, base * self.scale_bounds[0], base * self.scale_bounds[1])
                moved = torch.maximum(moved, (widened / scales).log_().abs_().amax(1))
                scales = widened
            points = points + step
            if bool((moved < ARRIVED).all()):
                break

        ascended = (best_points.double() + layout.origin).cpu().numpy()
        found = np.concatenate([ascended, starts])
        found_scale = np.concatenate([best_scales.double().cpu().numpy(), np.broadcast_to(width, starts.shape)])
        log_density = log_diverse_density(
            found, found_scale, bags, negative_strength=self.negative_strength, leak=self.leak
        )
        values = log_density.double().cpu().numpy().reshape(2, -1)
        # The start itself, to the last bit, unless the ascent did better.
        chosen = np.arange(len(kept)) + len(kept) * (values[0] <= values[1])
        arrived = (moved < ARRIVED).cpu().numpy()
        return [
            Peak(found[j], found_scale[j], float(values.flat[j]), bool(arrived[i]))
            for i in best_apart(found[chosen] * width, values.flat[chosen], self.merge_radius, len(kept))
            for j in [chosen[i]]
        ]


def best_apart(points: FloatArray, values: NDArray[Any], radius: float, n: int) -> list[int]:
    """Indices of up to `n` points, best first, each further than `radius` from every better one."""
    kept: list[int] = []
    left = np.argsort(-values, kind="stable")
    while len(left) and len(kept) < n:
        kept.append(int(left[0]))
        left = left[np.linalg.norm(points[left] - points[left[0]], axis=1) > radius]
    return kept
