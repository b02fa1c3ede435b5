"""What diverse density is measured against: scipy's L-BFGS-B over numpy objectives with analytic gradients.

Both take the classic parameters, a point t and a scale s per feature, and compute the negative log of
Π_i (1 − Π_j (1 − p_ij)) · Π_ij (1 − p_ij) with p_ij = exp(−Σ_k (s_k (x_ijk − t_k))²) in double precision.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from sb3_options.density.arrays import FloatArray
from sb3_options.density.diverse_density import SURVIVORS, best_apart

MERGE_RADIUS = 0.5
"""As in `DiverseDensity`."""

LARGEST_P = 1 - 1e-16
SMALLEST_HIT = 1e-300
"""Keep logarithms finite; no start of the benchmark comes near either."""

Objective = Callable[[FloatArray], tuple[float, FloatArray]]


class Descended(NamedTuple):
    """Where a start ended: negative log likelihood, and evaluations used."""

    value: float
    evaluations: int


def descend(objective: Objective, point: FloatArray, scale: float) -> Descended:
    """L-BFGS-B from one start, with scipy's tolerances and as many steps as it wants."""
    start = np.concatenate([point, np.full_like(point, scale)])
    found = minimize(objective, start, jac=True, method="L-BFGS-B", options={"maxiter": 15_000, "maxfun": 50_000})
    return Descended(float(found.fun), int(found.nfev))


def descend_pruned(
    objective: Objective, points: FloatArray, scale: float, finalists: int, first_steps: int
) -> Descended:
    """From all starts, pruned as by `DiverseDensity`: every ``first_steps`` evaluations the best quarter goes on."""
    theta = np.concatenate([points, np.full_like(points, scale)], axis=1)
    d, n, evaluations = points.shape[1], len(theta), 0

    def go_on(most: int) -> FloatArray:
        nonlocal theta, evaluations
        found = [
            minimize(objective, x, jac=True, method="L-BFGS-B", options={"maxiter": 15_000, "maxfun": most})
            for x in theta
        ]
        theta, evaluations = np.array([f.x for f in found]), evaluations + sum(int(f.nfev) for f in found)
        return np.array([f.fun for f in found])

    while n > finalists:
        value, n = go_on(first_steps), max(finalists, n // SURVIVORS)
        scales = theta[:, d:]
        theta = theta[best_apart(np.concatenate([theta[:, :d] * scales, scales], axis=1), value, MERGE_RADIUS, n)]
    return Descended(float(go_on(50_000).min()), evaluations)


class Vectorised:
    """All instances at once: distances and gradients as matrix-vector products, bags by ``reduceat``.

    The strongest form found: with differences x − t written out an evaluation on Musk1 takes several times as long.
    """

    def __init__(self, positive: Sequence[FloatArray], negative: Sequence[FloatArray]) -> None:
        self._x = np.concatenate([*positive, *negative])
        self._squares = self._x**2
        self._d = self._x.shape[1]
        self._lengths = np.array([len(bag) for bag in positive])
        self._first = np.cumsum(self._lengths) - self._lengths
        self._n = int(self._lengths.sum())

    def __call__(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Value and gradient at (t, s)."""
        t, s = theta[: self._d], theta[self._d :]
        squares = s * s
        distance = self._squares @ squares - 2 * (self._x @ (squares * t)) + squares @ (t * t)
        p = np.minimum(np.exp(-np.maximum(distance, 0)), LARGEST_P)
        log_miss = np.log1p(-p)
        bag_miss = np.add.reduceat(log_miss[: self._n], self._first)
        hit = np.maximum(-np.expm1(bag_miss), SMALLEST_HIT)
        value = -np.log(hit).sum() - log_miss[self._n :].sum()
        weight = -p / (1 - p)
        weight[: self._n] *= -np.repeat(np.exp(bag_miss) / hit, self._lengths)
        total, first, second = weight.sum(), weight @ self._x, weight @ self._squares
        in_t = -2 * squares * (first - t * total)
        in_s = 2 * s * (second - 2 * t * first + t * t * total)
        return float(value), np.concatenate([in_t, in_s])


class BagByBag:
    """One bag after the other, the way the formula reads."""

    def __init__(self, positive: Sequence[FloatArray], negative: Sequence[FloatArray]) -> None:
        self._bags = [(bag, True) for bag in positive] + [(bag, False) for bag in negative]

    def __call__(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Value and gradient at (t, s)."""
        t, s = np.split(theta, 2)
        value, in_t, in_s = 0.0, np.zeros_like(t), np.zeros_like(s)
        for bag, positive in self._bags:
            difference = bag - t
            p = np.minimum(np.exp(-(difference**2 @ (s * s))), LARGEST_P)
            log_miss = np.log1p(-p)
            if positive:
                hit = max(-np.expm1(log_miss.sum()), SMALLEST_HIT)
                value -= np.log(hit)
                weight = p / (1 - p) * np.exp(log_miss.sum()) / hit
            else:
                value -= log_miss.sum()
                weight = -p / (1 - p)
            in_t -= 2 * s * s * (weight @ difference)
            in_s += 2 * s * (weight @ difference**2)
        return value, np.concatenate([in_t, in_s])
