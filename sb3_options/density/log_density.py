"""Exact log diverse density of points, with its gradient for autograd."""

from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from sb3_options.density.bags import Bags, check_finite, positive_scale, real_array
from sb3_options.density.energies import Columns, Likelihood
from sb3_options.density.layout import Workspace
from sb3_options.density.objective import evaluate


def _columns(t: Tensor, s: Tensor) -> Columns:
    """Convert points (relative to the bags' origin) and scales, (S, d), to the kernels' form."""
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
    """Return log diverse density log DD(t, s) = Σ_i log Pr(t | B_i⁺) + Σ_i log Pr(t | B_i⁻) ≤ 0 (`objective`).

    It is differentiable once in points and scales. It is finite at any distance, and −inf only where a point hits an
    instance of a negative bag at full strength. A hit instance adds nothing to the gradient. The error is below 1e-9
    of the value, plus the rounding of the sum.

    Args:
        points: (S, d) concepts t, in the units of the features.
        scales: (S, d), (d,) or a number: one over the width of the concept.
        bags: The evidence.
        negative_strength: η in (0, 1]: below 1 a negative instance does not rule a point out.
        leak: λ in [0, 1): the probability that a bag is positive for a reason other than the concept, as in a leaky
            noisy-or (Henrion 1989): Pr(t | B⁺) = λ + (1 − λ) (1 − Π_j (1 − p_j)). Above 0, a bag without the concept
            costs at most log λ, at any distance.

    Returns:
        Shape (S,), in nats, in double precision.

    Raises:
        ValueError: Shapes do not fit the bags, values are not finite, or scales, strength or leak are out of range.
    """
    if not (0 < negative_strength <= 1 and 0 <= leak < 1):
        raise ValueError(f"negative_strength must be in (0, 1], leak in [0, 1), got {negative_strength} and {leak}")
    t, s = (
        (x if isinstance(x, Tensor) else torch.from_numpy(real_array(name, x))).to(bags.instances)
        for name, x in (("points", points), ("scales", scales))
    )
    if t.ndim != 2 or t.shape[1] != bags.n_features:
        raise ValueError(f"points must have shape (S, {bags.n_features}) as in the bags, got {tuple(t.shape)}")
    check_finite("one of the points", t.detach().numpy())
    if not positive_scale(s.detach().flatten()):
        raise ValueError("scales must be positive and finite: a scale is one over a width")
    t = t - bags.origin
    s = s.expand_as(t)
    likelihood = Likelihood(negative_strength, leak)
    if torch.is_grad_enabled() and (t.requires_grad or s.requires_grad):
        value: Tensor = _LogDiverseDensity.apply(t, s, bags, likelihood)  # type: ignore[no-untyped-call]  # torch's
    else:
        value = evaluate(_columns(t, s), bags.segments, likelihood, Workspace(), gradient=False).log_density
    return value
