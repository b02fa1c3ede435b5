"""A rival of the search that is compiled as a whole: numba loops around two matrix products, all starts in a batch.

The same objective and parameters (a = s · t, s), the same pruning and merging of starts, and the same rules of L-BFGS
as `sb3_options.density`, in single precision. No call of a library but BLAS is left between two evaluations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numba
import numpy as np
from numpy.typing import NDArray

from benchmarks.diverse_density.references import MERGE_RADIUS
from sb3_options.density.arrays import FloatArray
from sb3_options.density.diverse_density import SURVIVORS, best_apart
from sb3_options.density.lbfgs import CURVED, FINEST, SHORTEN, SHORTEST, SUFFICIENT

MEMORY = 10
"""Curvature pairs kept."""

LARGEST_P = np.float32(1 - 2**-20)
SMALLEST_HIT = np.float32(1e-30)
"""Keep logarithms finite; no start of the benchmark comes near either."""

Single = NDArray[np.float32]


class Compiled:
    """Search for points with a scale per feature, without bounds, prior, leak or weights.

    Args:
        positive: Bags (n_i, d) near the origin.
        negative: Likewise.
    """

    def __init__(self, positive: Sequence[FloatArray], negative: Sequence[FloatArray]) -> None:
        x = np.concatenate([*positive, *negative])
        self._powers = np.concatenate([x, x * x], axis=1).astype(np.float32)
        self._by_power = np.ascontiguousarray(self._powers.T)
        self._ends = np.cumsum([len(bag) for bag in positive])

    def __call__(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Value and gradient at one (a, s)."""
        columns = theta[None].astype(np.float32)
        value, gradient = _evaluate(columns, self._powers, self._by_power, self._ends)
        return float(value[0]), gradient[0].astype(np.float64)

    def search(
        self, points: FloatArray, scale: float, *, finalists: int, first_steps: int, final_steps: int, tolerance: float
    ) -> FloatArray:
        """Where the best of all starts comes to rest: its (a, s).

        Args:
            points: (S, d) starts, all of scale ``scale``.
            scale: One over their width.
            finalists: As in `DiverseDensity`, like all that follow.
            first_steps: Evaluations before each cut.
            final_steps: Most evaluations afterwards.
            tolerance: Relative, of two decreases running.
        """
        theta = np.concatenate([points * scale, np.full_like(points, scale)], axis=1).astype(np.float32)
        state = _State(theta, *_evaluate(theta, self._powers, self._by_power, self._ends))
        tolerance = max(tolerance, FINEST * float(np.finfo(np.float32).eps))
        n, descend = len(theta), cast(Any, _descend)  # whose number of arguments numba's types cannot say
        while n > finalists:
            descend(*state.arrays, self._powers, self._by_power, self._ends, first_steps, tolerance)
            n = max(finalists, n // SURVIVORS)
            state.keep(best_apart(state.theta.astype(np.float64), state.value.astype(np.float64), MERGE_RADIUS, n))
        descend(*state.arrays, self._powers, self._by_power, self._ends, final_steps, tolerance)
        return np.asarray(state.theta[np.argmin(state.value)], dtype=np.float64)


class _State:
    """Of all starts: where they are, the value and the gradient there, and their curvature pairs."""

    def __init__(self, theta: Single, value: Single, gradient: Single) -> None:
        n, p = theta.shape
        self.theta, self.value, self.gradient = theta, value, gradient
        self.length = np.minimum(1, 1 / np.linalg.norm(gradient, axis=1)).astype(np.float32)
        self.direction = -gradient
        self.steps = np.zeros((n, MEMORY, p), np.float32)
        self.changes = np.zeros((n, MEMORY, p), np.float32)
        self.along = np.zeros((n, MEMORY), np.float32)
        self.pairs, self.idle, self.done = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.bool_)

    @property
    def arrays(self) -> tuple[Any, ...]:
        return tuple(vars(self).values())

    def keep(self, rows: list[int]) -> None:
        for name, array in vars(self).items():
            setattr(self, name, np.ascontiguousarray(array[rows]))


@numba.njit(fastmath=True)
def _evaluate(theta: Any, powers: Any, by_power: Any, ends: Any) -> Any:
    """Negative log likelihoods (S,) and gradients (S, 2 d) of starts (S, 2 d)."""
    n, p = theta.shape
    d = p // 2
    coefficients, constant = np.empty_like(theta), np.zeros(n, np.float32)
    for i in range(n):
        for k in range(d):
            a, s = theta[i, k], theta[i, d + k]
            coefficients[i, k] = -2 * a * s
            coefficients[i, d + k] = s * s
            constant[i] += a * a
    weights = np.dot(coefficients, by_power)  # energies at first
    value, total, one = np.zeros(n, np.float32), np.zeros(n, np.float32), np.float32(1)
    n_positive = ends[-1] if len(ends) else 0
    for i in range(n):
        row = weights[i]
        for j in range(len(row)):
            row[j] = min(np.exp(-max(row[j] + constant[i], np.float32(0))), LARGEST_P)
        begin = 0
        for end in ends:
            hit, miss = np.float32(0), one
            for j in range(begin, end):
                hit += row[j] * (one - hit)
                miss *= one - row[j]
            hit = max(hit, SMALLEST_HIT)
            value[i] -= np.log(hit)
            ratio = -miss / hit
            for j in range(begin, end):
                row[j] *= ratio / (one - row[j])
            begin = end
        for j in range(n_positive, len(row)):
            value[i] -= np.log(one - row[j])
            row[j] /= one - row[j]
        for j in range(len(row)):
            total[i] += row[j]
    # The weights are −∂ value / ∂z: the sign is turned in the chain rule.
    gradient = np.dot(weights, powers)
    for i in range(n):
        for k in range(d):
            a, s, first, second = theta[i, k], theta[i, d + k], gradient[i, k], gradient[i, d + k]
            gradient[i, k] = -2 * (a * total[i] - s * first)
            gradient[i, d + k] = -2 * (s * second - a * first)
    return value, gradient


@numba.njit(fastmath=True)
def _descend(
    theta: Any,
    value: Any,
    gradient: Any,
    length: Any,
    direction: Any,
    steps: Any,
    changes: Any,
    along: Any,
    pairs: Any,
    idle: Any,
    done: Any,
    powers: Any,
    by_power: Any,
    ends: Any,
    evaluations: int,
    tolerance: float,
) -> None:
    """Move every start that is not done, in place, by at most so many evaluations."""
    eps = np.float32(2**-23)
    for _ in range(evaluations):
        active = np.flatnonzero(~done)
        if not len(active):
            return
        tried = np.empty((len(active), theta.shape[1]), np.float32)
        for row, i in enumerate(active):
            tried[row] = theta[i] + length[i] * direction[i]
        new_value, new_gradient = _evaluate(tried, powers, by_power, ends)
        for row, i in enumerate(active):
            slope, size = length[i] * np.dot(gradient[i], direction[i]), max(np.float32(1), abs(value[i]))
            if not new_value[row] <= value[i] + SUFFICIENT * slope + eps * size:
                length[i] *= np.float32(SHORTEN)
                done[i] = length[i] < SHORTEST
                continue
            idle[i] = idle[i] + 1 if value[i] - new_value[row] <= tolerance * size else 0
            at = pairs[i] % MEMORY
            steps[i, at] = tried[row] - theta[i]
            changes[i, at] = new_gradient[row] - gradient[i]
            along[i, at] = np.dot(steps[i, at], changes[i, at])
            if along[i, at] > CURVED * np.dot(changes[i, at], changes[i, at]):
                pairs[i] += 1
            theta[i], value[i], gradient[i] = tried[row], new_value[row], new_gradient[row]
            _direct(gradient[i], steps[i], changes[i], along[i], pairs[i], direction[i])
            length[i] = 1
            done[i] = idle[i] >= 2 or np.abs(gradient[i]).max() <= tolerance


@numba.njit(fastmath=True)
def _direct(gradient: Any, steps: Any, changes: Any, along: Any, pairs: int, direction: Any) -> None:
    """The two-loop recursion (Nocedal 1980), into ``direction``."""
    direction[:] = -gradient
    first = max(0, pairs - MEMORY)
    if pairs == 0:
        direction *= np.float32(1) / max(np.float32(1), np.sqrt(np.dot(gradient, gradient)))
        return
    parts = np.empty(MEMORY, np.float32)
    for k in range(pairs - 1, first - 1, -1):
        at = k % MEMORY
        parts[at] = np.dot(steps[at], direction) / along[at]
        direction -= parts[at] * changes[at]
    last = (pairs - 1) % MEMORY
    direction *= along[last] / np.dot(changes[last], changes[last])
    for k in range(first, pairs):
        at = k % MEMORY
        direction += (parts[at] - np.dot(changes[at], direction) / along[at]) * steps[at]
