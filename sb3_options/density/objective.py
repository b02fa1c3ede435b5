"""Log diverse density of any concept, value and closed-form gradient, near the speed of the machine.

A concept enters as one number per instance, its energy z = c₀ + Σ_k c_k x_k + Σ_k c_kk x_k², linear in coefficients
c that the concept computes from its parameters (`concepts`). Two links turn an energy into Pr(x ∈ concept):
"gaussian" exp(−z) for z ≥ 0, and "logistic" 1 / (1 + exp(z)). The bags are noisy-ors (Maron & Lozano-Pérez 1998):

    log DD = Σ_i w_i log(1 − Π_j (1 − p_ij)) + Σ_i w_i Σ_j log(1 − η p_ij)      (positive bags, negative bags)

and the gradient in the coefficients is Σ_ij (∂ log DD / ∂z_ij) (1, x, x²): two matrix products, and between them
one exponential and five cheap passes over the (instances × starts) matrix, a block at a time so that it stays in the
cache. `_quick` does that wherever nothing under- or overflows; it notices where something does, and those starts are
done again by `_careful`, which factors out each bag's smallest energy and is right at any distance.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from itertools import islice
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from sb3_options.density.layout import Arrays, Segment, Workspace

MAX_PAIRS = 1 << 20
"""Default for (instances × starts) held at once. Such an array is 4 MiB in single precision."""

NEAR_NEGATIVE = 2.0**-26
"""In double precision 1 − p of a row of negative instances is exact to half its digits above this."""

LOG2_E = math.log2(math.e)

Link = Literal["gaussian", "logistic"]


class Evaluation(NamedTuple):
    """Log densities (S,), in nats, and their gradients in the coefficients, (K, S)."""

    log_density: Tensor
    gradient: Tensor


def evaluate(
    coefficients: Tensor,
    segments: list[Segment],
    link: Link,
    workspace: Workspace,
    *,
    max_pairs: int = MAX_PAIRS,
) -> Evaluation:
    """Log density and gradient of every column of coefficients.

    Args:
        coefficients: (K, S), one column per start; K is the number of powers of the segments, without log η.
        segments: The evidence.
        link: How an energy becomes a probability.
        workspace: Kept from one evaluation to the next.
        max_pairs: Bounds the memory: (instances × starts) at once, unless one bag alone is larger.

    Returns:
        Shapes (S,) and (K, S).
    """
    parts = [_of_segment(coefficients, segment, link, workspace, max_pairs) for segment in segments]
    log_density, gradient = parts[0]
    for value, slope in parts[1:]:
        log_density.add_(value)
        gradient.add_(slope)
    return Evaluation(log_density, gradient[: len(coefficients)])


def _of_segment(
    coefficients: Tensor, segment: Segment, link: Link, workspace: Workspace, max_pairs: int
) -> tuple[Tensor, Tensor]:
    """Value (S,) and gradient (K, S)."""
    at_once = max(1, max_pairs // len(segment.powers))
    if coefficients.shape[1] > at_once:
        parts = [_of_segment(c, segment, link, workspace, max_pairs) for c in torch.split(coefficients, at_once, dim=1)]
        return torch.cat([value for value, _ in parts]), torch.cat([slope for _, slope in parts], dim=1)
    value, slope, fine = _quick(coefficients, segment, link, workspace)
    if not bool(fine.all()):
        again = (~fine).nonzero()[:, 0]
        value[again], slope[:, again] = _careful(coefficients[:, again], segment, link, workspace)
    return value, slope


def _with_strength(coefficients: Tensor, segment: Segment, factor: float) -> Tensor:
    """``factor`` times the coefficients, with a row for log η if the segment has that column."""
    scaled = coefficients * factor
    if segment.powers.shape[1] > len(scaled):
        scaled = torch.cat([scaled, scaled.new_full((1, scaled.shape[1]), abs(factor))])
    return scaled


def _quick(coefficients: Tensor, segment: Segment, link: Link, workspace: Workspace) -> tuple[Tensor, Tensor, Tensor]:
    """Value (S,), gradient (K, S), and for which starts they can be relied on (S,).

    h ← h + p (1 − h) gives the probability of a hit without cancellation at either end. The rest follows from
    ∂ log h / ∂z_j = −p_j / (1 − p_j) · (1 − h) / h, and −log(1 − p_j) for a negative instance from the product of
    1 − p_j over its row.
    """
    precision = torch.finfo(coefficients.dtype)
    arrays = workspace.take(segment, coefficients.shape[1], coefficients)
    p = arrays.p
    if link == "gaussian":
        scaled = _with_strength(coefficients, segment, -LOG2_E)
        # A product that rounds to an energy below 0 would make p > 1; the margin keeps p below 1 and costs 1e-6 of it.
        scaled[0].mul_(1 + 4 * precision.eps).sub_(4 * precision.eps)
        _energies(scaled, segment, p, 0.95 * math.log2(precision.tiny))
        p.exp2_()
    else:
        _energies(_with_strength(coefficients, segment, -1.0), segment, p, 0.95 * math.log(precision.tiny))
        p.sigmoid_()
    _rows(arrays)
    value, fine = _bags_of_rows(arrays, segment, precision.tiny**0.75)
    if link == "gaussian":
        steps = zip(arrays.p_blocks, arrays.spare_blocks, arrays.divisor_blocks, strict=True)
        for block, spare, divisor in reversed(list(steps)):  # the last are in the cache still
            torch.addcmul(divisor, block, divisor, value=-1, out=spare)
            block.div_(spare)
    else:
        for block, divisor in zip(arrays.p_blocks, arrays.divisor_blocks, strict=True):
            block.div_(divisor)
    gradient = _moments(segment, p)
    # A p of exactly 1 leaves 0/0.
    return value, gradient, fine.logical_and_(gradient[0].abs() < math.inf)


def _energies(coefficients: Tensor, segment: Segment, p: Tensor, lowest: float) -> None:
    """Negative energies of all instances into p, (N, S), where they may be below ``lowest``, cut off there.

    Below it p or its product with another is subnormal, and arithmetic with those is many times slower.
    """
    if p.is_contiguous():
        torch.mm(segment.powers, coefficients, out=p)
    else:
        torch.mm(coefficients.T.contiguous(), segment.powers_by_power, out=p.T)
    if bool((segment.reach @ coefficients.abs()).amax() > -lowest):
        p.clamp_(min=lowest)


def _moments(segment: Segment, p: Tensor) -> Tensor:
    """Sums over instances of the weights in p times the powers, (K, S)."""
    if p.is_contiguous():
        return torch.mm(segment.powers_by_power, p)
    return torch.mm(p.T, segment.powers_by_power.T).T


def _rows(arrays: Arrays) -> None:
    """Probabilities of a hit and of none in each row, each without cancellation."""
    arrays.rows[0] = arrays.p_blocks[0]
    torch.sub(arrays.ends[0], arrays.p_blocks[0], out=arrays.rows[1])
    for rows, p in islice(zip(arrays.rows_blocks, arrays.p_blocks, strict=True), 1, None):
        torch.lerp(rows, arrays.ends, p, out=rows)


def _bags_of_rows(arrays: Arrays, segment: Segment, smallest: float) -> tuple[Tensor, Tensor]:
    """The value (S,) and which starts are reliable (S,); in place, what each row's odds are divided by."""
    rows = arrays.rows.contiguous()  # they are gathered one by one
    # Near a negative instance 1 − p cancels. In single precision a hit is worth some −15 nats instead of −∞, which
    # refuses it as well and is not worth a second look.
    near = NEAR_NEGATIVE if rows.dtype == torch.float64 else 0.0
    parts, fine = [], []
    if len(segment.negative_rows):
        negative = rows[1].index_select(0, segment.negative_rows)
        fine.append(negative.amin(0) > near)
        parts.append(_weighted_sum(negative.log_(), segment.negative_weight, segment))
    if segment.rows_of_bags:
        torch.index_select(rows, 1, segment.rows_by_bag, out=arrays.by_bag)
        one = arrays.ends[0]
        for hit, other in islice(zip(arrays.hit_of_bags, arrays.hit_by_bag, strict=True), 1, None):
            torch.lerp(hit, one, other, out=hit)
        for miss, other in islice(zip(arrays.miss_of_bags, arrays.miss_by_bag, strict=True), 1, None):
            miss.mul_(other)
        hit, miss = arrays.hit_of_bags[0], arrays.miss_of_bags[0]
        fine += [hit.amin(0) > smallest, hit.amax(0) <= 1]
        torch.div(hit, miss, out=arrays.divisors[:-1]).clamp_(max=1 / smallest).neg_()
        parts.append(_weighted_sum(hit.log_(), segment.bag_weight, segment))
    if arrays.divisor.is_contiguous():
        torch.index_select(arrays.divisors, 0, segment.bag_of_row, out=arrays.divisor)
    else:
        arrays.divisor.copy_(arrays.divisors.index_select(0, segment.bag_of_row))
    if segment.weighted:
        arrays.divisor.div_(segment.row_weight).clamp_(-1 / smallest, 1 / smallest)
    return functools.reduce(torch.add, parts), functools.reduce(torch.logical_and, fine)


def _weighted_sum(rows: Tensor, weights: Tensor, segment: Segment) -> Tensor:
    return (rows * weights[:, None]).sum(0) if segment.weighted else rows.sum(0)


def _careful(coefficients: Tensor, segment: Segment, link: Link, workspace: Workspace) -> tuple[Tensor, Tensor]:
    """Value (S,) and gradient (K, S) at any distance, on hits and near them.

    Each bag's largest p, its top, is factored out: p = top · share. So nothing underflows that matters, and the
    weights tend to the soft-max of −z as a bag recedes.
    """
    precision = torch.finfo(coefficients.dtype)
    floor = math.log2(precision.tiny) / 2  # keeps products of two above the subnormal numbers, which are slow
    arrays = workspace.take(segment, coefficients.shape[1], coefficients)
    share, odds = arrays.p, torch.empty_like(arrays.p)
    if link == "gaussian":
        torch.mm(segment.powers, _with_strength(coefficients, segment, -LOG2_E), out=share)
        _measure_close_pairs_again(share, coefficients, segment)
        log2_p, outside = share.clamp_(max=0), None
    else:
        energy = torch.mm(segment.powers, _with_strength(coefficients, segment, 1.0), out=share)
        outside = energy.sigmoid()
        log2_p = torch.nn.functional.softplus(energy).mul_(-LOG2_E)
        share.copy_(log2_p)
    blocks = arrays.p_blocks
    row_top = _chain(blocks, torch.maximum)
    top = torch.zeros_like(row_top)  # instances of negative bags are taken as they are
    if segment.rows_of_bags:
        bag_top = _over_rows(row_top, segment, torch.maximum)
        top = torch.cat([bag_top, torch.zeros_like(bag_top[:1])])[segment.bag_of_row]
    for block in blocks:
        block.sub_(top[: len(block)])
    share.clamp_(min=floor).exp2_()
    largest = top.clamp(min=floor).exp2_()  # (R, S), 1 for rows of negative bags

    def unite(hit: Tensor, other: Tensor, largest: Tensor) -> Tensor:
        return hit + other * (1 - largest * hit)

    hit = blocks[0].clone()
    for block, odd in zip(blocks, torch.split(odds, list(segment.counts)), strict=True):
        torch.addcmul(odd.fill_(1), block, largest[: len(block)], value=-1, out=odd)
        if block is not blocks[0]:
            rows = hit[: len(block)]
            rows.copy_(unite(rows, block, largest[: len(block)]))
    factors = hit.new_ones(len(segment.bag_weight) + 1, hit.shape[1])
    log_density = hit.new_zeros(hit.shape[1])
    if segment.rows_of_bags:
        first, *others = segment.rows_of_bags
        bag_hit, bag_largest = hit[first], largest[first]
        for rows in others:
            n = len(rows)
            bag_hit[:n] = unite(bag_hit[:n], hit[rows], bag_largest[:n])
        log_density += segment.bag_weight @ (bag_hit.log() + bag_top * math.log(2)).clamp_(max=0)
        torch.div((1 - bag_largest * bag_hit).clamp_(min=0), bag_hit, out=factors[:-1]).neg_()
    ratio = factors[segment.bag_of_row] * segment.row_weight
    is_negative = segment.bag_of_row == len(segment.bag_weight)
    negative = torch.cat([is_negative[:count] for count in segment.counts])
    if bool(negative.any()):
        # log(1 − p) from p where p is small, from 1 − p where it is not: the row's product may underflow.
        p, rows_weight = share[negative], torch.cat([segment.row_weight[:count] for count in segment.counts])[negative]
        log_miss = torch.where(p < 0.5, torch.log1p(-p), (1 - p).log())
        log_density += (log_miss * rows_weight).sum(0)
    # An instance that is hit lies at its smallest energy: it pulls nowhere, whatever its weight.
    share.mul_(odds > 0)
    weights = torch.div(share, odds.clamp_(min=precision.eps**2), out=share)
    for block in blocks:
        block.mul_(ratio[: len(block)])
    if outside is not None:
        weights.mul_(outside)
    return log_density, torch.mm(segment.powers.T, weights)


def _measure_close_pairs_again(log2_p: Tensor, coefficients: Tensor, segment: Segment) -> None:
    """Energies near 0, where the products cancel, once more as Σ_k c_kk (x_k − t_k)² with t_k = −c_k / (2 c_kk).

    In place. Nothing is done for coefficients that are no such square.
    """
    d = (len(coefficients) - 1) // 2
    constant, linear, square = coefficients[0], coefficients[1 : d + 1], coefficients[d + 1 :]
    eps, size = torch.finfo(coefficients.dtype).eps, 1 + constant.abs()
    centre = torch.where(square > 0, linear / square.clamp(min=torch.finfo(square.dtype).tiny) / -2, 0.0)
    is_square = (constant - (square * centre.square()).sum(0)).abs() < d * 8 * eps * size
    # A column for log η, if there is one, moves energies that are close to others; those are left as they are.
    plain = segment.powers.shape[1] == len(coefficients)
    close = (log2_p > -(eps**0.5) * size) & is_square if plain else torch.zeros_like(log2_p, dtype=torch.bool)
    place, start = close.nonzero().T
    rows = segment.powers[place]
    energy = (square[:, start].T * (rows[:, 1 : d + 1] / rows[:, :1] - centre[:, start].T).square()).sum(1)
    # Nearer than the rounding of the coefficients is a hit.
    energy = torch.where(energy < (4 * eps) ** 2 * size[start], torch.zeros_like(energy), energy)
    log2_p[place, start] = -LOG2_E * energy * rows[:, 0]


def _chain(blocks: Sequence[Tensor], unite: Callable[..., Tensor]) -> Tensor:
    """Reduce the instances of each row: (R, S)."""
    out = blocks[0].clone()
    for block in blocks[1:]:
        rows = out[: len(block)]
        unite(rows, block, out=rows)
    return out


def _over_rows(rows: Tensor, segment: Segment, unite: Callable[..., Tensor]) -> Tensor:
    """Reduce the rows (R, S) of each positive bag: (B, S)."""
    first, *others = segment.rows_of_bags
    out = rows[first]
    for numbers in others:
        bags = out[: len(numbers)]
        unite(bags, rows[numbers], out=bags)
    return out
