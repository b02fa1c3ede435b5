"""Concepts: possible shapes of a subgoal, as energies linear in coefficients of 1, x_k and x_k².

All features are scaled: their unit is the width of a concept of scale 1.
"""

import math
from typing import Annotated, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from sb3_options.checked import Field, settings
from sb3_options.density.arrays import FloatArray

SCALE_BOUNDS = (0.1, 10.0)
"""Default smallest and largest learned scale, as factors of the given scale.

Without a lower bound and without negative bags a concept grows for ever, because at scale 0 it holds every instance.
Without an upper bound it may shrink onto one instance.
"""


@settings
class Point:
    """A class of concepts: a point t with scales s, z = Σ_k (s_k (x_k − t_k))² (Maron & Lozano-Pérez 1998).

    The search is in a = s · t and s. There z = Σ_k (s_k x_k − a_k)² is convex, and both kinds of parameters have
    similar curvature. A feature whose scale goes to 0 drops out without moving t_k. Each column of θ holds a, then the
    learned scales, for one start: (n_parameters, S).

    Attributes:
        scales: Learned for "each" feature, "one" for all, or "fixed" at the given scale.
        scale_bounds: Smallest and largest learned scale, as factors of the given scale; (0, inf) for none.
        prior_width: Standard deviation, in e-folds, of a log-normal prior of a learned scale about the given scale;
            None for no prior. It breaks ties in favour of the expected size: in two rooms the doorway otherwise ties
            with a slab across the world.

    Raises:
        ValueError: An argument is out of its range.
    """

    scales: Literal["each", "one", "fixed"] = "each"
    scale_bounds: tuple[Annotated[float, Field(ge=0)], float] = SCALE_BOUNDS
    prior_width: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = 1.0

    def __post_init__(self) -> None:
        """Refuse empty bounds."""
        if not self.scale_bounds[0] < self.scale_bounds[1]:
            raise ValueError(f"scale_bounds must be factors 0 <= low < high, got {self.scale_bounds}")

    def coefficients(self, theta: Tensor) -> Tensor:
        """Return ‖a‖², −2 s a and s², the factors of 1, x_k and x_k²: (2 d + 1, S)."""
        a, s = self._split(theta)
        return torch.cat([(a * a).sum(0, keepdim=True), (a * s).mul_(-2), s * s])

    def pull_back(self, theta: Tensor, gradient: Tensor) -> Tensor:
        """Turn the gradient in coefficients into that in θ: ∂/∂a = 2 (a g₀ − s g_k), ∂/∂s = 2 (s g_kk − a g_k)."""
        a, s = self._split(theta)
        m = len(a)
        first, second = gradient[1 : 1 + m], gradient[1 + m :]
        in_a = (a * gradient[:1]).addcmul_(s, first, value=-1)
        if self.scales == "fixed":
            return in_a.mul_(2)
        in_s = (s * second).addcmul_(a, first, value=-1)
        return torch.cat([in_a, in_s.sum(0, keepdim=True) if self.scales == "one" else in_s]).mul_(2)

    def centre(self, theta: Tensor) -> Tensor:
        """Return the point t = a / s, (d, S); not finite where a scale is 0."""
        a, s = self._split(theta)
        return a / s

    def start(self, instances: Tensor, scale: float) -> Tensor:
        """Return θ of concepts at scaled instances (S, d), all with one scale; a fixed scale stays 1."""
        if self.scales == "fixed":
            return instances.T.contiguous()
        n_scales = 1 if self.scales == "one" else instances.shape[1]
        return torch.cat([instances.T * scale, instances.new_full((n_scales, len(instances)), scale)])

    def bounds(self, n_features: int) -> tuple[Tensor, Tensor]:
        """Return the smallest and largest θ, (n_parameters, 1) each, in double precision.

        a is unbounded. Without a lower bound s may change sign: (−s, −a) is the same concept.
        """
        n_scales = {"fixed": 0, "one": 1, "each": n_features}[self.scales]
        low, high = self.scale_bounds
        free = torch.full((n_features, 1), math.inf, dtype=torch.float64)
        least = low if low > 0 else -high
        return (
            torch.cat([-free, free.new_full((n_scales, 1), least)]),
            torch.cat([free, free.new_full((n_scales, 1), high)]),
        )

    def log_prior(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log prior (S,), −½ Σ_k (log s_k)² / width² up to a constant, and its gradient in θ."""
        if self.scales == "fixed" or self.prior_width is None:
            return theta.new_zeros(theta.shape[1]), torch.zeros_like(theta)
        n_scales = 1 if self.scales == "one" else len(theta) // 2
        scales = theta[-n_scales:]
        precision = self.prior_width**-2
        gradient = torch.zeros_like(theta)
        logs = scales.abs().clamp(min=torch.finfo(theta.dtype).tiny ** 0.5).log()
        gradient[-n_scales:] = -precision * logs / scales
        return -precision / 2 * logs.square().sum(0), gradient

    def canonical(self, theta: Tensor) -> Tensor:
        """Return the θ of the same concepts that has no scale below 0."""
        if self.scales == "fixed":
            return theta
        a, s = self._split(theta)
        sign = torch.where(s < 0, -1.0, 1.0).to(theta.dtype)
        return torch.cat([a * sign, (s * sign)[:1] if self.scales == "one" else s * sign])

    def point_and_scale(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return points t and scales s ≥ 0 of θ (P, S), in scaled features, (d, S) each; t is 0 where s is 0."""
        a, s = (part.numpy() for part in self._split(torch.from_numpy(theta)))
        return np.divide(a, s, out=np.zeros_like(a), where=s != 0), np.abs(np.broadcast_to(s, a.shape))

    def _split(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Split θ into a and s, each (m, S)."""
        if self.scales == "fixed":
            return theta, torch.ones_like(theta)
        if self.scales == "one":
            return theta[:-1], theta[-1:].expand_as(theta[:-1])
        m = len(theta) // 2
        return theta[:m], theta[m:]


@settings
class HalfSpace:
    """Half-spaces, p = 1 / (1 + exp(b − v·x)): "linearly discriminable surfaces" (McGovern & Barto 2001, §8).

    If bags are separable, a Gaussian prior of v keeps the boundary from sharpening without limit. If no bag is
    negative, a prior of b keeps the half-space from growing to hold everything. θ holds v, then b, for each start.

    Attributes:
        steepness: Standard deviation of the prior of v_k, per width of a scaled feature.
        offset: Standard deviation of the prior of b.

    Raises:
        ValueError: An argument is not positive and finite.
    """

    steepness: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3.0
    offset: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 10.0

    def coefficients(self, theta: Tensor) -> Tensor:
        """Return the factors b of 1, −v of x_k and 0 of x_k²: (2 d + 1, S)."""
        return torch.cat([theta[-1:], -theta[:-1], torch.zeros_like(theta[:-1])])

    def pull_back(self, theta: Tensor, gradient: Tensor) -> Tensor:
        """Turn the gradient in coefficients into that in θ."""
        return torch.cat([-gradient[1 : len(theta)], gradient[:1]])

    def centre(self, theta: Tensor) -> Tensor:
        """Return an empty tensor, (0, S): a half-space has no centre."""
        return theta[:0]

    def start(self, instances: Tensor, scale: float) -> Tensor:
        """Return θ of half-spaces that face each scaled instance (S, d) from half way to the mean of all."""
        away = instances - instances.mean(0)
        v = scale * torch.nn.functional.normalize(away)
        b = (v * (instances - away / 2)).sum(1, keepdim=True)
        return torch.cat([v, b], dim=1).T.contiguous()

    def bounds(self, n_features: int) -> tuple[Tensor, Tensor]:
        """Return infinite bounds, (n_parameters, 1) each: the prior replaces them."""
        free = torch.full((n_features + 1, 1), math.inf, dtype=torch.float64)
        return -free, free

    def log_prior(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log prior (S,), −½ ‖v / steepness‖² − ½ (b / offset)², and its gradient in θ."""
        precision = theta.new_full((len(theta), 1), self.steepness**-2)
        precision[-1] = self.offset**-2
        gradient = -precision * theta
        return (gradient * theta).sum(0) / 2, gradient

    def canonical(self, theta: Tensor) -> Tensor:
        """Return θ itself: each θ is a different half-space."""
        return theta

    def point_and_scale(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return each boundary's point nearest to the origin, and its normal v, in scaled features, (d, S) each."""
        v, b = theta[:-1], theta[-1]
        return v * (b / np.maximum((v * v).sum(axis=0), np.finfo(np.float64).tiny)), v


Concept: TypeAlias = Point | HalfSpace
