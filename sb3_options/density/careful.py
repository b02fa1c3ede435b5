"""The objective where it under- or overflows: slow, but correct at any distance."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from sb3_options.density.energies import (
    LOG2_E,
    Columns,
    Evaluation,
    Likelihood,
    exponents,
    measure_close_pairs,
    moments,
    take_near,
)
from sb3_options.density.layout import Segment, Workspace


def careful(columns: Columns, segment: Segment, likelihood: Likelihood, workspace: Workspace) -> Evaluation:
    """Evaluate the objective at any distance, including hits and points near them.

    Each bag's largest p, its top, is factored out: p = top · share. So no relevant term underflows, and the weights
    tend to the soft-max of −z as a bag recedes.
    """
    precision = torch.finfo(columns.coefficients.dtype)
    floor = math.log2(precision.tiny) / 2  # keeps products of two above subnormal numbers, which are slow
    arrays = workspace.take(segment, columns.coefficients.shape[1], columns.coefficients)
    share, blocks = arrays.p, arrays.p_blocks
    scaled = exponents(columns, segment, likelihood)
    torch.mm(segment.powers[:, : len(scaled)], scaled, out=share)
    close = None
    if likelihood.logistic:
        share.copy_(torch.nn.functional.logsigmoid(share.mul_(math.log(2))).mul_(LOG2_E))
    else:
        close = measure_close_pairs(share, columns, segment, likelihood)
    odds = torch.expm1(share.clamp_(max=0) * math.log(2)).neg_()  # 1 − p, exact where p is near 1
    row_top = _chain(blocks, torch.maximum)
    top = torch.zeros_like(row_top)  # instances of negative bags are not factored
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
    for block in blocks[1:]:
        rows = hit[: len(block)]
        rows.copy_(unite(rows, block, largest[: len(block)]))
    miss = _chain(torch.split(odds, list(segment.counts)), torch.mul)
    factors = hit.new_ones(segment.n_positive + 1, hit.shape[1])
    log_density = hit.new_zeros(hit.shape[1])
    if segment.rows_of_bags:
        first, *others = segment.rows_of_bags
        bag_hit, bag_largest = hit[first], largest[first]
        for rows in others:
            n = len(rows)
            bag_hit[:n] = unite(bag_hit[:n], hit[rows], bag_largest[:n])
        log_hit = (bag_hit.log() + bag_top * math.log(2)).clamp_(max=0)
        torch.div(_over_rows(miss, segment, torch.mul), bag_hit, out=factors[:-1]).neg_()
        if likelihood.leak:
            unleaked = log_hit.exp().mul_(1 - likelihood.leak)
            log_hit = (unleaked + likelihood.leak).log()
            factors[:-1] *= unleaked / (unleaked + likelihood.leak)
        log_density += log_hit.sum(0)
    ratio = factors[segment.bag_of_row]
    is_negative = segment.bag_of_row == segment.n_positive
    negative = torch.cat([is_negative[:count] for count in segment.counts])
    if bool(negative.any()):
        # log(1 − p) from p where p is small, from 1 − p where it is not: the row's product may underflow.
        p = share[negative]
        log_density += torch.where(p < 0.5, torch.log1p(-p), odds[negative].log()).sum(0)
    weights = share
    if not likelihood.logistic:
        torch.div(share, odds.clamp_(min=precision.tiny if columns.exact else precision.eps**2), out=weights)
    for block in blocks:
        block.mul_(ratio[: len(block)])
    near = columns.centre[:0]
    if close is not None:
        # A hit instance is at its smallest energy: it exerts no pull, whatever its weight.
        weights[close.place[close.hit], close.start[close.hit]] = 0
        near = take_near(weights, close, columns, segment) if columns.exact else near
    return Evaluation(log_density, moments(segment, weights, len(columns.coefficients)), near)


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
