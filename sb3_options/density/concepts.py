"""Concepts: what a subgoal may look like, as energies that are linear in coefficients of 1, x_k and x_k².

Everything is in scaled features, whose unit is the width of a concept of scale 1.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from sb3_options.checked import Field, settings
from sb3_options.density.arrays import FloatArray

SCALE_BOUNDS = (0.1, 10.0)
"""Default smallest and largest learned scale, as factors of the scale given.

Without a lower bound and without negative bags a concept grows for ever, because at scale 0 it holds every instance;
without an upper bound it may shrink onto one instance.
"""


@settings
class Point:
    """A class of concepts: a point t with scales s, z = Σ_k (s_k (x_k − t_k))² (Maron & Lozano-Pérez 1998).

    Searched in a = s · t and s, where z = Σ_k (s_k x_k − a_k)² is convex, a feature whose scale goes to 0 drops out
    without taking t_k anywhere, and both kinds of parameters are curved alike. θ holds a, then the learned scales, for
    each start in a column: (n_parameters, S).

    Attributes:
        scales: Learned for "each" feature, "one" for all, or "fixed" at the scale given.
        scale_bounds: Smallest and largest learned scale, as factors of the scale given; (0, inf) for none.
        prior_width: Standard deviation, in e-folds, of a log-normal prior of a learned scale about the scale given;
            None for no prior. With it, of concepts that explain the bags alike, the one of the expected size wins: in
            two rooms the doorway, with which a slab across the world ties otherwise.

    Raises:
        ValueError: An argument is out of its range.
    """

    scales: Literal["each", "one", "fixed"] = "each"
    scale_bounds: tuple[Annotated[float, Field(ge=0)], float] = SCALE_BOUNDS
    prior_width: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = 1.0

    def __post_init__(self) -> None:
        """Refuse bounds that hold nothing."""
        if not self.scale_bounds[0] < self.scale_bounds[1]:
            raise ValueError(f"scale_bounds must be factors 0 <= low < high, got {self.scale_bounds}")

    def coefficients(self, theta: Tensor) -> Tensor:
        """‖a‖², −2 s a and s², the factors of 1, x_k and x_k²: (2 d + 1, S)."""
        a, s = self._split(theta)
        return torch.cat([(a * a).sum(0, keepdim=True), (a * s).mul_(-2), s * s])

    def pull_back(self, theta: Tensor, gradient: Tensor) -> Tensor:
        """The gradient in θ from that in the coefficients: ∂/∂a = 2 (a g₀ − s g_k) and ∂/∂s = 2 (s g_kk − a g_k)."""
        a, s = self._split(theta)
        m = len(a)
        first, second = gradient[1 : 1 + m], gradient[1 + m :]
        in_a = (a * gradient[:1]).addcmul_(s, first, value=-1)
        if self.scales == "fixed":
            return in_a.mul_(2)
        in_s = (s * second).addcmul_(a, first, value=-1)
        return torch.cat([in_a, in_s.sum(0, keepdim=True) if self.scales == "one" else in_s]).mul_(2)

    def centre(self, theta: Tensor) -> Tensor:
        """The point t = a / s, (d, S); not finite where a scale is 0."""
        a, s = self._split(theta)
        return a / s

    def start(self, instances: Tensor, scale: float) -> Tensor:
        """θ of concepts at scaled instances (S, d), with one scale for all; a fixed scale stays 1."""
        if self.scales == "fixed":
            return instances.T.contiguous()
        n_scales = 1 if self.scales == "one" else instances.shape[1]
        return torch.cat([instances.T * scale, instances.new_full((n_scales, len(instances)), scale)])

    def bounds(self, n_features: int) -> tuple[Tensor, Tensor]:
        """Smallest and largest θ, (n_parameters, 1) each, in double precision.

        None on a. With no lower bound s may change its sign, which changes nothing: (−s, −a) is the same.
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
        """Logarithm of the prior (S,), −½ Σ_k (log s_k)² / width² up to a constant, and its gradient in θ."""
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
        """One θ for all that mean the same concept: with no scale below 0."""
        if self.scales == "fixed":
            return theta
        a, s = self._split(theta)
        sign = torch.where(s < 0, -1.0, 1.0).to(theta.dtype)
        return torch.cat([a * sign, (s * sign)[:1] if self.scales == "one" else s * sign])

    def point_and_scale(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points t and scales s ≥ 0 in scaled features, (d, S) each, of θ (P, S); where s is 0, t is 0."""
        a, s = (part.numpy() for part in self._split(torch.from_numpy(theta)))
        return np.divide(a, s, out=np.zeros_like(a), where=s != 0), np.abs(np.broadcast_to(s, a.shape))

    def _split(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Parameters a and s, each (m, S)."""
        if self.scales == "fixed":
            return theta, torch.ones_like(theta)
        if self.scales == "one":
            return theta[:-1], theta[-1:].expand_as(theta[:-1])
        m = len(theta) // 2
        return theta[:m], theta[m:]


@settings
class HalfSpace:
    """Half-spaces, p = 1 / (1 + exp(b − v·x)): "linearly discriminable surfaces" (McGovern & Barto 2001, §8).

    A Gaussian prior of v keeps the boundary from growing sharp without end where bags can be separated. One of b keeps
    the half-space from growing to hold everything where no bag is negative. θ holds v, then b, for each start.

    Attributes:
        steepness: Standard deviation of the prior of v_k, per width of a scaled feature.
        offset: Standard deviation of the prior of b.

    Raises:
        ValueError: An argument is not positive and finite.
    """

    steepness: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3.0
    offset: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 10.0

    def coefficients(self, theta: Tensor) -> Tensor:
        """Factors b and −v of 1 and x_k, and 0 of x_k²: (2 d + 1, S)."""
        return torch.cat([theta[-1:], -theta[:-1], torch.zeros_like(theta[:-1])])

    def pull_back(self, theta: Tensor, gradient: Tensor) -> Tensor:
        """The gradient in θ from that in the coefficients."""
        return torch.cat([-gradient[1 : len(theta)], gradient[:1]])

    def centre(self, theta: Tensor) -> Tensor:
        """None, (0, S)."""
        return theta[:0]

    def start(self, instances: Tensor, scale: float) -> Tensor:
        """θ of half-spaces that face each scaled instance (S, d) from half way to the middle of all."""
        away = instances - instances.mean(0)
        v = scale * torch.nn.functional.normalize(away)
        b = (v * (instances - away / 2)).sum(1, keepdim=True)
        return torch.cat([v, b], dim=1).T.contiguous()

    def bounds(self, n_features: int) -> tuple[Tensor, Tensor]:
        """None: the prior does their work; (n_parameters, 1) each."""
        free = torch.full((n_features + 1, 1), math.inf, dtype=torch.float64)
        return -free, free

    def log_prior(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Logarithm of the prior (S,), −½ ‖v / steepness‖² − ½ (b / offset)², and its gradient in θ."""
        precision = theta.new_full((len(theta), 1), self.steepness**-2)
        precision[-1] = self.offset**-2
        gradient = -precision * theta
        return (gradient * theta).sum(0) / 2, gradient

    def canonical(self, theta: Tensor) -> Tensor:
        """Itself: each θ means another half-space."""
        return theta

    def point_and_scale(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Of each boundary the point that is nearest to the origin, and the normal v, in scaled features, (d, S)."""
        v, b = theta[:-1], theta[-1]
        return v * (b / np.maximum((v * v).sum(axis=0), np.finfo(np.float64).tiny)), v


Concept: TypeAlias = Point | HalfSpace
