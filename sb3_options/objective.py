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

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from sb3_options.segments import Segment

MAX_PAIRS = 1 << 18
"""Default for (instances × starts) held at once. Two such arrays in single precision are 2 MiB."""

LOG2_E = math.log2(math.e)

Link = Literal["gaussian", "logistic"]


class Evaluation(NamedTuple):
    """Log densities (S,), in nats, and their gradients in the coefficients, (K, S)."""

    log_density: Tensor
    gradient: Tensor


class Workspace:
    """Two arrays that every evaluation writes into: fresh memory would cost more than the arithmetic."""

    def __init__(self) -> None:
        self._flat: tuple[Tensor, Tensor] = (torch.empty(0), torch.empty(0))

    def take(self, rows: int, columns: int, like: Tensor) -> tuple[Tensor, Tensor]:
        """Two uninitialised (rows, columns) arrays with the precision and the device of ``like``."""
        flat, n = self._flat[0], rows * columns
        if len(flat) < n or flat.dtype != like.dtype or flat.device != like.device:
            self._flat = (like.new_empty(n), like.new_empty(n))
        first, second = (flat[:n].view(rows, columns) for flat in self._flat)
        return first, second


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
    k, n_starts = coefficients.shape
    total = coefficients.new_zeros(n_starts)
    gradient = torch.zeros_like(coefficients)
    for segment in segments:
        at_once = max(1, max_pairs // len(segment.powers))
        for first in range(0, n_starts, at_once):
            part = coefficients[:, first : first + at_once]
            value, slope, fine = _quick(part, segment, link, workspace)
            if not bool(fine.all()):
                again = (~fine).nonzero()[:, 0]
                value[again], slope[:, again] = _careful(part[:, again], segment, link, workspace)
            total[first : first + at_once] += value
            gradient[:, first : first + at_once] += slope[:k]
    return Evaluation(total, gradient)


def _blocks(segment: Segment, array: Tensor) -> list[Tensor]:
    """Views of the first instances of all rows, the second instances, and so on."""
    return list(torch.split(array, list(segment.counts)))


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
    n_starts = coefficients.shape[1]
    p, q = workspace.take(len(segment.powers), n_starts, coefficients)
    if link == "gaussian":
        scaled = _with_strength(coefficients, segment, -LOG2_E)
        # A product that rounds to an energy below 0 would make p > 1; the margin keeps p below 1 and costs 1e-6 of it.
        scaled[0] -= (4 * precision.eps) * (1 + coefficients[0].abs())
        torch.mm(segment.powers, scaled, out=p)
        p.exp2_()
    else:
        torch.mm(segment.powers, _with_strength(coefficients, segment, -1.0), out=p)
        p.sigmoid_()
    one = p.new_ones(())
    blocks = _blocks(segment, p)
    hit = blocks[0].clone()
    for block in blocks[1:]:
        rows = hit[: len(block)]
        torch.lerp(rows, one, block, out=rows)
    value, ratio, fine = _bags_of_rows(hit, segment, precision.tiny**0.75)
    if link == "gaussian":
        torch.sub(one, p, out=q)
        torch.div(p, q, out=p)
    for block in blocks:
        block.mul_(ratio[: len(block)])
    gradient = torch.mm(segment.powers.T, p)
    # A p of exactly 1 leaves 0/0.
    return value, gradient, fine & gradient.isfinite().all(0)


def _bags_of_rows(hit: Tensor, segment: Segment, smallest: float) -> tuple[Tensor, Tensor, Tensor]:
    """From the probability of a hit in each row (R, S): value (S,), factor of each row's odds (R, S), reliable (S,)."""
    miss = 1 - hit
    # Near a negative instance 1 − p cancels.
    fine = ((miss > torch.finfo(miss.dtype).eps ** 0.5) | ~segment.negative).all(0)
    log_density = (torch.where(segment.negative, miss, 1.0).log() * segment.row_weight).sum(0)
    ratio = (segment.row_weight * segment.negative).expand_as(hit)
    if segment.rows_of_bags:
        first, *others = segment.rows_of_bags
        bag_hit, one = hit[first], hit.new_ones(())
        for rows in others:
            bags = bag_hit[: len(rows)]
            torch.lerp(bags, one, hit[rows], out=bags)
        fine &= ((bag_hit > smallest) & (bag_hit <= 1)).all(0)
        log_density += segment.bag_weight @ bag_hit.log()
        bag_ratio = ((1 - bag_hit) / bag_hit).neg_()[segment.bag_of_row]
        ratio = torch.where(segment.negative, ratio, bag_ratio * segment.row_weight)
    return log_density, ratio, fine


def _careful(coefficients: Tensor, segment: Segment, link: Link, workspace: Workspace) -> tuple[Tensor, Tensor]:
    """Value (S,) and gradient (K, S) at any distance, on hits and near them.

    Each bag's largest p, its top, is factored out: p = top · share. So nothing underflows that matters, and the
    weights tend to the soft-max of −z as a bag recedes.
    """
    precision = torch.finfo(coefficients.dtype)
    floor = math.log2(precision.tiny) / 2  # keeps products of two above the subnormal numbers, which are slow
    share, odds = workspace.take(len(segment.powers), coefficients.shape[1], coefficients)
    if link == "gaussian":
        torch.mm(segment.powers, _with_strength(coefficients, segment, -LOG2_E), out=share)
        _measure_close_pairs_again(share, coefficients, segment)
        log2_p, outside = share.clamp_(max=0), None
    else:
        energy = torch.mm(segment.powers, _with_strength(coefficients, segment, 1.0), out=share)
        outside = energy.sigmoid()
        log2_p = torch.nn.functional.softplus(energy).mul_(-LOG2_E)
        share.copy_(log2_p)
    blocks = _blocks(segment, share)
    row_top = _chain(blocks, torch.maximum)
    top = torch.zeros_like(row_top)  # instances of negative bags are taken as they are
    if segment.rows_of_bags:
        bag_top = _over_rows(row_top, segment, torch.maximum)
        top = torch.where(segment.negative, top, bag_top[segment.bag_of_row])
    for block in blocks:
        block.sub_(top[: len(block)])
    share.clamp_(min=floor).exp2_()
    largest = top.clamp(min=floor).exp2_()  # (R, S), 1 for rows of negative bags

    def unite(hit: Tensor, other: Tensor, largest: Tensor) -> Tensor:
        return hit + other * (1 - largest * hit)

    hit = blocks[0].clone()
    for block, odd in zip(blocks, _blocks(segment, odds), strict=True):
        torch.addcmul(odd.fill_(1), block, largest[: len(block)], value=-1, out=odd)
        if block is not blocks[0]:
            rows = hit[: len(block)]
            rows.copy_(unite(rows, block, largest[: len(block)]))
    ratio = segment.row_weight * segment.negative + torch.zeros_like(hit)
    log_density = hit.new_zeros(hit.shape[1])
    if segment.rows_of_bags:
        first, *others = segment.rows_of_bags
        bag_hit, bag_largest = hit[first], largest[first]
        for rows in others:
            n = len(rows)
            bag_hit[:n] = unite(bag_hit[:n], hit[rows], bag_largest[:n])
        log_density += segment.bag_weight @ (bag_hit.log() + bag_top * math.log(2)).clamp_(max=0)
        bag_ratio = ((1 - bag_largest * bag_hit).clamp_(min=0) / bag_hit).neg_()[segment.bag_of_row]
        ratio = torch.where(segment.negative, ratio, bag_ratio * segment.row_weight)
    negative = torch.cat([segment.negative[:count, 0] for count in segment.counts])
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


def _chain(blocks: list[Tensor], unite: Callable[..., Tensor]) -> Tensor:
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
