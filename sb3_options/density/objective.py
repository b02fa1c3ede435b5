"""Log diverse density of any concept, with its closed-form gradient, near the speed of the machine.

A concept enters as one number per instance, its energy z = c₀ + Σ_k c_k x_k + Σ_k c_kk x_k² ≥ 0. The concept computes
the coefficients c from its parameters (`concepts`). p = Pr(x ∈ concept) = exp(−z); for a half-space it is
1 / (1 + exp(z)) for any z. The bags are noisy-ors (Maron & Lozano-Pérez 1998) with a leak λ (Henrion 1989). η is the
strength of negative instances; for a half-space it multiplies their odds:

    h_i = λ + (1 − λ) (1 − Π_j (1 − p_ij))
    log DD = Σ_i log h_i + Σ_i Σ_j log(1 − η p_ij)      (positive bags, negative bags)

The gradient in the coefficients is Σ_ij (∂ log DD / ∂z_ij) (1, x, x²). It takes two matrix products, and between them
one exponential and five cheap passes over the (instances × starts) matrix, block by block to stay in the cache.
`_quick` does this, and notices which starts under- or overflow. `careful` repeats these starts: it factors out each
bag's smallest energy and is correct at any distance.

In double precision, energies close to a concept's centre, where products cancel, are measured again as differences.
"""

import functools
import math
from itertools import islice

import torch
from torch import Tensor

from sb3_options.density.careful import careful
from sb3_options.density.energies import (
    Columns,
    Evaluation,
    Likelihood,
    exponents,
    measure_close_pairs,
    moments,
    take_near,
)
from sb3_options.density.layout import Arrays, Segment, Workspace

MAX_PAIRS = 1 << 20
"""Maximum (instances × starts) held at once, 4 MiB in single precision, unless one bag alone has more."""

NEAR_NEGATIVE = 2.0**-20  # `careful` takes the logarithm of a smaller product of 1 − p over negative instances


def evaluate(
    columns: Columns, segments: list[Segment], likelihood: Likelihood, workspace: Workspace, *, gradient: bool = True
) -> Evaluation:
    """Return log density and gradient of every column, as new tensors."""
    first, *others = (_of_segment(columns, segment, likelihood, workspace, gradient) for segment in segments)
    for other in others:
        for total, part in zip(first, other, strict=True):
            total.add_(part)
    return first


def _of_segment(
    columns: Columns, segment: Segment, likelihood: Likelihood, workspace: Workspace, gradient: bool
) -> Evaluation:
    n = columns.coefficients.shape[1]
    at_once = max(1, MAX_PAIRS // len(segment.powers))
    if n > at_once:
        parts = [
            _of_segment(columns.take(slice(i, i + at_once)), segment, likelihood, workspace, gradient)
            for i in range(0, n, at_once)
        ]
        return Evaluation(*(torch.cat(pieces, dim=-1) for pieces in zip(*parts, strict=True)))
    whole, fine = _quick(columns, segment, likelihood, workspace, gradient)
    if not bool(fine.all()):
        again = (~fine).nonzero()[:, 0]
        for old, new in zip(whole, careful(columns.take(again), segment, likelihood, workspace), strict=True):
            old[..., again] = new[: len(old)] if old.ndim == 2 else new
    return whole


def _quick(
    columns: Columns, segment: Segment, likelihood: Likelihood, workspace: Workspace, gradient: bool
) -> tuple[Evaluation, Tensor]:
    """Return the evaluation, and for which starts it is reliable (S,).

    h ← h + p (1 − h) gives the probability of a hit without cancellation at either end. The rest follows from
    ∂ log h / ∂z_j = −p_j / (1 − p_j) · (1 − h) / h, and −log(1 − p_j) for a negative instance from the product of
    1 − p_j over its row.
    """
    precision = torch.finfo(columns.coefficients.dtype)
    arrays = workspace.take(segment, columns.coefficients.shape[1], columns.coefficients)
    p = arrays.p
    close = None
    none = columns.centre[:0]
    scaled = exponents(columns, segment, likelihood)
    if not (columns.exact or likelihood.logistic):
        # A product that rounds to an energy below 0 would make p > 1. The margin prevents this, and costs 1e-6 of p.
        scaled[0].mul_(1 + 4 * precision.eps).sub_(4 * precision.eps)
    _energies(scaled, segment, p, 0.95 * math.log2(precision.tiny))
    if columns.exact:
        close = measure_close_pairs(p, columns, segment, likelihood)
    if likelihood.logistic:
        p.mul_(math.log(2)).sigmoid_()
    else:
        p.exp2_()
    _rows(arrays)
    value, fine = _bags_of_rows(arrays, segment, likelihood, precision.tiny**0.75)
    if not gradient:
        return Evaluation(value, none, none), fine
    if close is not None:
        # A p that rounds to 1 leaves 0/0, and its instance hardly pulls there.
        p[close.place, close.start] *= p[close.place, close.start] < 1
    steps = zip(arrays.p_blocks, arrays.spare_blocks, arrays.divisor_blocks, strict=True)
    for block, spare, divisor in reversed(list(steps)):  # the last are still in the cache
        if not likelihood.logistic:
            torch.addcmul(divisor, block, divisor, value=-1, out=spare)
        block.div_(divisor if likelihood.logistic else spare)
    near = none if close is None else take_near(p, close, columns, segment)
    slope = moments(segment, p, len(columns.coefficients))
    # A p of exactly 1 leaves 0/0.
    return Evaluation(value, slope, near), fine.logical_and_(slope[0].abs() < math.inf)


def _energies(coefficients: Tensor, segment: Segment, p: Tensor, lowest: float) -> None:
    """Write the negative energies of all instances into p, (N, S), clamped to at least ``lowest``.

    Below it, p or its product with another p is subnormal, and such arithmetic is many times slower.
    """
    k = len(coefficients)
    if p.is_contiguous():
        torch.mm(segment.powers[:, :k], coefficients, out=p)
    else:
        torch.mm(coefficients.T.contiguous(), segment.powers_by_power[:k], out=p.T)
    if bool((segment.reach[:k] @ coefficients.abs()).amax() > -lowest):
        p.clamp_(min=lowest)


def _rows(arrays: Arrays) -> None:
    """Compute the probabilities of a hit and of no hit in each row, without cancellation."""
    arrays.rows[0] = arrays.p_blocks[0]
    torch.sub(arrays.ends[0], arrays.p_blocks[0], out=arrays.rows[1])
    for rows, p in islice(zip(arrays.rows_blocks, arrays.p_blocks, strict=True), 1, None):
        torch.lerp(rows, arrays.ends, p, out=rows)


def _bags_of_rows(arrays: Arrays, segment: Segment, likelihood: Likelihood, smallest: float) -> tuple[Tensor, Tensor]:
    """Return the value (S,) and which starts are reliable (S,); write the divisor of each row's odds in place."""
    rows = arrays.rows.contiguous()  # they are gathered one by one
    # Near a negative instance 1 − p cancels. In single precision a hit costs about 15 nats instead of ∞. This refuses
    # it just as well, so it need not be computed again.
    near = NEAR_NEGATIVE if rows.dtype == torch.float64 else 0.0
    parts, fine = [], []
    if len(segment.negative_rows):
        negative = rows[1].index_select(0, segment.negative_rows)
        fine.append(negative.amin(0) > near)
        parts.append(negative.log_().sum(0))
    if segment.rows_of_bags:
        torch.index_select(rows, 1, segment.rows_by_bag, out=arrays.by_bag)
        one = arrays.ends[0]
        for hit, other in islice(zip(arrays.hit_of_bags, arrays.hit_by_bag, strict=True), 1, None):
            torch.lerp(hit, one, other, out=hit)
        for miss, other in islice(zip(arrays.miss_of_bags, arrays.miss_by_bag, strict=True), 1, None):
            miss.mul_(other)
        hit, miss = arrays.hit_of_bags[0], arrays.miss_of_bags[0]
        if likelihood.leak:
            hit.mul_(1 - likelihood.leak).add_(likelihood.leak)
            miss.mul_(1 - likelihood.leak)
        fine += [hit.amin(0) > smallest, hit.amax(0) <= 1]
        torch.div(hit, miss, out=arrays.divisors[:-1]).clamp_(max=1 / smallest).neg_()
        parts.append(hit.log_().sum(0))
    if arrays.divisor.is_contiguous():
        torch.index_select(arrays.divisors, 0, segment.bag_of_row, out=arrays.divisor)
    else:
        arrays.divisor.copy_(arrays.divisors.index_select(0, segment.bag_of_row))
    return functools.reduce(torch.add, parts), functools.reduce(torch.logical_and, fine)
