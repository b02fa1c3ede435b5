"""Limited-memory BFGS within bounds, for many starts at once.

Nocedal (1980) with the curvature pairs of every start in its own column, so that one call of the objective serves
all; after Bertsekas (1982), parameters at a bound that the gradient pushes against are left out of the direction.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

PAIRS = 8
"""Curvature pairs kept."""

SUFFICIENT = 1e-4
"""Armijo's constant: the part of the decrease that the slope promises."""

SHORTEN = 0.3
"""Factor of a step that did not decrease enough."""

CURVED = 1e-8
"""A pair with s·y below this times y·y says nothing about curvature."""

SHORTEST = 1e-10
"""A start whose step has been shortened below this is at rest as far as this precision can tell."""

Objective = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Parameters (P, S) → values (S,) to be minimised and gradients (P, S)."""


class Minimum(NamedTuple):
    """Where every start ended.

    Attributes:
        theta: (P, S).
        value: (S,), never above the start's.
        converged: (S,): whether the last decrease fell below the tolerance, or the gradient did.
        evaluations: Calls of the objective.
    """

    theta: Tensor
    value: Tensor
    converged: Tensor
    evaluations: int


def minimise(
    objective: Objective,
    theta: Tensor,
    bounds: tuple[Tensor, Tensor],
    *,
    steps: int,
    tolerance: float,
) -> Minimum:
    """Descend from every column.

    Every call of the objective moves every start: those whose step decreased their value go on from there, the
    others try a shorter one. A value that is not finite counts as no decrease.

    Args:
        objective: Values and gradients of all columns.
        theta: (P, S) starts.
        bounds: Smallest and largest parameters, (P, 1).
        steps: Most calls of the objective after the first.
        tolerance: A start has converged when two accepted steps running decrease its value by less than this times
            max(1, |value|), or no component of its gradient that is free exceeds this.
    """
    low, high = bounds
    bounded = bool(low.isfinite().any() or high.isfinite().any())
    theta = theta.clamp(low, high) if bounded else theta
    value, gradient = objective(theta)
    pairs = _Pairs(theta)
    n_starts = theta.shape[1]
    length = torch.ones(n_starts, dtype=theta.dtype, device=theta.device)
    idle = torch.zeros(n_starts, dtype=torch.int64, device=theta.device)
    noise = torch.finfo(theta.dtype).eps
    direction, free = pairs.direction(gradient, _free(theta, gradient, low, high) if bounded else None)
    evaluations = 1
    for _ in range(steps):
        tried = torch.addcmul(theta, direction, length)
        if bounded:
            tried = tried.clamp(low, high)
        moved = tried - theta
        new_value, new_gradient = objective(tried)
        evaluations += 1
        slope = (gradient * moved).sum(0)
        rounding = noise * value.abs().clamp(min=1).nan_to_num(posinf=1)
        # A start at an infinite value takes any step to a finite one.
        better = (new_value <= value + SUFFICIENT * slope + rounding) & new_gradient.isfinite().all(0)
        small = (value - new_value).abs() <= tolerance * value.abs().clamp(min=1)
        idle = torch.where(better, torch.where(small, idle + 1, 0), idle)
        pairs.add(moved * better, (new_gradient - gradient) * better)
        theta = torch.where(better, tried, theta)
        value = torch.where(better, new_value, value)
        gradient = torch.where(better, new_gradient, gradient)
        length = torch.where(better, 1.0, length * SHORTEN)
        stuck = length < SHORTEST
        new_direction, free = pairs.direction(gradient, _free(theta, gradient, low, high) if bounded else None)
        direction = torch.where(better, new_direction, direction)
        steepest = torch.where(free, gradient, 0) if free is not None else gradient
        converged = (idle >= 2) | stuck | (steepest.abs().amax(0) <= tolerance)
        if bool(converged.all()):
            break
    else:
        if steps < 1:
            converged = torch.zeros(n_starts, dtype=torch.bool, device=theta.device)
    return Minimum(theta, value, converged, evaluations)


def _free(theta: Tensor, gradient: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Where a parameter may follow its gradient: (P, S)."""
    return ~(((theta <= low) & (gradient > 0)) | ((theta >= high) & (gradient < 0)))


class _Pairs:
    """The last steps and changes of gradient of every start, and the direction they make of a gradient."""

    def __init__(self, theta: Tensor) -> None:
        self._steps = theta.new_zeros(PAIRS, *theta.shape)
        self._changes = theta.new_zeros(PAIRS, *theta.shape)
        self._inverse = theta.new_zeros(PAIRS, theta.shape[1])  # 1 / (s·y), 0 for a pair that says nothing
        self._size = theta.new_zeros(theta.shape[1])  # s·y / y·y of the last good pair: the size of a step
        self._n = 0

    def add(self, step: Tensor, change: Tensor) -> None:
        """Take in a pair per start; (P, S), 0 where a start did not move."""
        at = self._n % PAIRS
        self._n += 1
        along, square = (step * change).sum(0), change.square().sum(0)
        good = along > CURVED * square
        self._steps[at], self._changes[at] = step, change
        self._inverse[at] = torch.where(good, 1 / along, 0)
        self._size = torch.where(good, along / square, self._size)

    def direction(self, gradient: Tensor, free: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Two-loop recursion (Nocedal & Wright 2006, algorithm 7.4); where it does not descend, the gradient."""
        start = gradient if free is None else torch.where(free, gradient, 0)
        out = start.clone()
        order = [(self._n - 1 - i) % PAIRS for i in range(min(self._n, PAIRS))]
        along = {}
        for i in order:
            along[i] = self._inverse[i] * (self._steps[i] * out).sum(0)
            out.addcmul_(self._changes[i], along[i], value=-1)
        # The first step has length 1 at most.
        size = torch.where(self._size > 0, self._size, 1 / start.norm(dim=0).clamp(min=1))
        out.mul_(size)
        for i in reversed(order):
            back = self._inverse[i] * (self._changes[i] * out).sum(0)
            out.addcmul_(self._steps[i], along[i] - back)
        out.neg_()
        if free is not None:
            out = torch.where(free, out, 0)
        descends = (out * start).sum(0) < 0
        return torch.where(descends, out, -start * size), free
