"""Which of many starts are peaks of their own, and in which order they come."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from sb3_options.density.arrays import FloatArray

TIES, SAME_PARAMETER = 1e-5, 1e-3
"""Peaks tie whose losses are this close, relatively or in nats; parameters this close do not order them."""


def best_apart(points: FloatArray, loss: FloatArray, radius: float, n: int) -> list[int]:
    """Rows of up to ``n`` points (S, P), smallest loss first, each further than ``radius`` from every better one."""
    order = np.argsort(loss, kind="stable")
    points, apart, kept = points[order], np.ones(len(order), dtype=bool), list[int]()
    for i, number in enumerate(order.tolist()):
        if apart[i]:
            kept.append(number)
            if len(kept) == n:
                break
            difference = points[i + 1 :] - points[i]
            apart[i + 1 :] &= np.einsum("ij,ij->i", difference, difference) > radius**2
    return kept


def ties_in_order(best: list[int], points: FloatArray, losses: Sequence[float]) -> list[int]:
    """Rows of points (S, P), smallest loss first, with those that tie for it in the order of their parameters."""
    limit = losses[best[0]] + TIES * max(1.0, abs(losses[best[0]]))
    tied = [i for i in best if losses[i] <= limit]
    key = functools.cmp_to_key(_compare)
    return [*sorted(tied, key=lambda i: key(points[i])), *best[len(tied) :]]


def _compare(one: FloatArray, other: FloatArray) -> int:
    """By the first parameter in which they differ."""
    apart = np.flatnonzero(np.abs(one - other) > SAME_PARAMETER)
    return int(np.sign(one[apart[0]] - other[apart[0]])) if len(apart) else 0
