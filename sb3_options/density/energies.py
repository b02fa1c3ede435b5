"""Shared parts of the objective's kernels: concepts as columns, and exact energies where products cancel."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from sb3_options.density.layout import Segment

# An energy is measured again if it is below the precision to this power, relative to the squares it comes from. In
# double precision, larger energies have a relative rounding error below 1e-10.
CLOSE = 1 / 3
CLOSE_PAIRS = 1 << 18  # numbers held at once while energies are measured again
LOG2_E = math.log2(math.e)


class Likelihood(NamedTuple):
    """Parameters of the likelihood: strength η in (0, 1] of negative instances, leak λ in [0, 1), form of p.

    p is exp(−z), or 1 / (1 + exp(z)) if ``logistic``; η then multiplies the odds of p.
    """

    strength: float = 1.0
    leak: float = 0.0
    logistic: bool = False


class Columns(NamedTuple):
    """Concepts as the kernels read them: coefficients (2 d + 1, S) of 1, x_k and x_k², and centres (d, S).

    The energy is Σ_k c_kk (x_k − centre_k)². ``exact`` columns, in double precision, measure small energies by this
    form, without cancellation. Their part of the gradient is in ``Evaluation.near``. A half-space has no centre,
    (0, S).
    """

    coefficients: Tensor
    centre: Tensor
    exact: bool = False

    def take(self, numbers: Tensor | slice) -> Columns:
        """Return some columns."""
        return Columns(self.coefficients[:, numbers], self.centre[:, numbers], self.exact)


class Evaluation(NamedTuple):
    """Log densities (S,), in nats, and their gradients in the coefficients (K, S).

    ``near`` (2 d, S) is the part missing from the gradient of exact columns, where moments would cancel: Σ_j w_j
    (x_j − centre) and Σ_j w_j (x_j − centre)² over instances close to the centre, with w_j = ∂ log DD / ∂z_j.
    """

    log_density: Tensor
    gradient: Tensor
    near: Tensor


def exponents(columns: Columns, segment: Segment, likelihood: Likelihood) -> Tensor:
    """Return the coefficients of −z / log 2. For weak negative instances an extra row turns p into η p."""
    scaled = columns.coefficients * -LOG2_E
    if likelihood.strength < 1 and len(segment.negative_rows):
        strength = scaled.new_full((1, scaled.shape[1]), LOG2_E * math.log(likelihood.strength))
        scaled = torch.cat([scaled, strength])
    return scaled


class ClosePairs(NamedTuple):
    """Pairs of an instance and a start with a close centre: indices (pairs,), and whether the centre hits."""

    place: Tensor
    start: Tensor
    hit: Tensor


def measure_close_pairs(log2_p: Tensor, columns: Columns, segment: Segment, likelihood: Likelihood) -> ClosePairs:
    """Measure energies near 0, where products cancel, again as Σ_k c_kk (x_k − centre_k)². Return these pairs.

    Writes to ``log2_p``. A weak negative instance has p ≤ η. It is left as it is if η is far from 1.
    """
    size = columns.coefficients[0].abs().add_(1).mul_(-(torch.finfo(log2_p.dtype).eps ** CLOSE))
    size = torch.where(columns.centre.isfinite().all(0), size, math.inf)
    places, starts = (log2_p > size).nonzero(as_tuple=True)
    hit = torch.zeros_like(places, dtype=torch.bool)
    for part in _parts(places, columns):
        place, start = places[part], starts[part]
        rows = segment.powers[place]
        square = columns.coefficients[-len(columns.centre) :, start].T
        energy = (square * _difference(place, start, columns, segment).square_()).sum(1).mul_(rows[:, 0])
        hit[part] = energy == 0
        if len(segment.negative_rows):
            energy -= rows[:, -1] * math.log(likelihood.strength)
        log2_p[place, start] = energy.mul_(-LOG2_E)
    return ClosePairs(places, starts, hit)


def take_near(weights: Tensor, close: ClosePairs, columns: Columns, segment: Segment) -> Tensor:
    """Return ``Evaluation.near`` of these pairs, and set their ``weights`` (N, S) to 0."""
    d = len(columns.centre)
    near = weights.new_zeros(2 * d, weights.shape[1])
    for part in _parts(close.place, columns):
        place, start = close.place[part], close.start[part]
        difference = _difference(place, start, columns, segment).T
        weight = weights[place, start] * segment.powers[place, 0]
        near.index_add_(1, start, torch.cat([weight * difference, weight * difference.square()]))
    weights[close.place, close.start] = 0
    return near


def _parts(places: Tensor, columns: Columns) -> Iterator[slice]:
    n = max(1, CLOSE_PAIRS // len(columns.centre))
    return (slice(i, i + n) for i in range(0, len(places), n))


def _difference(place: Tensor, start: Tensor, columns: Columns, segment: Segment) -> Tensor:
    """Return instances minus centres, (pairs, d)."""
    rows = segment.powers[place]
    return rows[:, 1 : len(columns.centre) + 1] / rows[:, :1] - columns.centre[:, start].T


def moments(segment: Segment, p: Tensor, k: int) -> Tensor:
    """Sum the weights in p times the first k powers over instances, (k, S)."""
    if p.is_contiguous():
        return torch.mm(segment.powers_by_power[:k], p)
    return torch.mm(p.T, segment.powers_by_power[:k].T).T
