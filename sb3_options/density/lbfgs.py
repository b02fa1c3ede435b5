"""Limited-memory BFGS within bounds, for many starts at once.

This is Nocedal (1980) with the curvature pairs of every start in its own column, so one call of the objective serves
all. After Bertsekas (1982), the direction omits parameters that the gradient pushes against a bound.
"""

from collections.abc import Callable

import torch
from torch import Tensor

PAIRS = 6  # curvature pairs kept
SUFFICIENT = 1e-4  # Armijo's constant: required share of the decrease that the slope promises
SHORTEN = 0.3  # factor for a step that did not decrease enough
CURVED = 1e-8  # a pair with s·y below this times y·y tells nothing about curvature
SHORTEST = 1e-10  # a start with a shorter step has converged, as far as this precision can tell
FINEST = 8  # rounding error of an objective, in units of the precision

Objective = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Parameters (P, S) → values (S,) to be minimised and gradients (P, S)."""


class BatchedLBFGS:
    """The descent of many starts (P, S), each with its value (S,) and whether it has ``converged``.

    Every call of the objective tries a step of every start. A start accepts a step that decreases its value, and
    otherwise tries a shorter one. A non-finite value or gradient counts as no decrease. Bounds are (P, 1) each.

    Unless ``curvature`` is given, the first step has length 1 at most. A start has converged when two accepted steps in
    a row change its value by less than ``tolerance`` times ``max(1, |value|)``, when no free component of its gradient
    exceeds the tolerance, or when no step, however short, decreases the value. The tolerance is at least ``FINEST``
    times the precision, because a smaller decrease is rounding.
    """

    @torch.inference_mode()
    def __init__(
        self,
        objective: Objective,
        theta: Tensor,
        bounds: tuple[Tensor, Tensor],
        *,
        tolerance: float,
        curvature: float | None = None,
    ) -> None:
        self._objective = objective
        self._tolerance = tolerance
        self._low, self._high = (bound.to(theta) for bound in bounds)
        self._bounded = bool(self._low.isfinite().any() or self._high.isfinite().any())
        self.theta = theta.clamp(self._low, self._high) if self._bounded else theta
        self.value, self._gradient = objective(self.theta)
        self._pairs = CurvaturePairs(theta, 0.0 if curvature is None else 1 / curvature)
        self._length = torch.ones_like(self.value)
        self._idle = torch.zeros_like(self.value)
        self.evaluations = 1
        free = self._free()
        self.converged = self._flat(free)
        self._direction = self._pairs.direction(self._gradient, free)

    @torch.inference_mode()
    def run(self, steps: int, *, contest: bool = False) -> None:
        """Continue for at most ``steps`` calls of the objective.

        With ``contest`` it stops once no start promises to reach the best value so far, or to improve by more than the
        tolerance. The promise is the slope along the direction, twice the decrease of a quadratic.
        """
        for _ in range(steps):
            done = self.converged
            if contest:
                promise = -(self._gradient * self._direction).sum(0)
                self.converged |= promise <= self._tolerance_of(promise) * self.value.abs().clamp(min=1)
                done = self.converged | (self.value - promise > self.value.min())
            if bool(done.all()):
                return
            self._step()

    @torch.inference_mode()
    def keep(self, columns: list[int], dtype: torch.dtype) -> None:
        """Continue with these starts only, in this precision, keeping their curvature."""
        changed = dtype != self.theta.dtype
        for name in ("theta", "value", "_gradient", "_direction", "_length", "_idle", "converged"):
            kept = getattr(self, name)[..., columns]
            setattr(self, name, kept.to(dtype) if kept.is_floating_point() else kept)
        self._pairs.keep(columns, dtype)
        self._low, self._high = self._low.to(dtype), self._high.to(dtype)
        if changed:
            self.value, self._gradient = self._objective(self.theta)
            self._idle.zero_()
            self.converged.fill_(False)
            self._length.fill_(1)
            self._direction = self._pairs.direction(self._gradient, self._free())
            self.evaluations += 1

    def _step(self) -> None:
        tried = torch.addcmul(self.theta, self._direction, self._length)
        if self._bounded:
            tried = tried.clamp(self._low, self._high)
        value, gradient = self._objective(tried)
        self.evaluations += 1
        moved = tried - self.theta
        size = self.value.abs().clamp(min=1).nan_to_num(posinf=1)  # an infinite value takes any step to a finite one
        slope = (self._gradient * moved).sum(0)
        enough = self.value + SUFFICIENT * slope + torch.finfo(size.dtype).eps * size
        better = (value <= enough) & gradient.sum(0).isfinite()
        small = (self.value - value).abs() <= self._tolerance_of(size) * size
        idle = (self._idle + 1) * small
        length = torch.ones_like(size)
        if not bool(better.all()):
            tried, value, idle, length, gradient = (
                torch.where(better, new, old)
                for new, old in (
                    (tried, self.theta),
                    (value, self.value),
                    (idle, self._idle),
                    (length, self._length * SHORTEN),
                    (gradient, self._gradient),
                )
            )
            moved = moved * better
        self._pairs.add(moved, gradient - self._gradient)
        self.theta = tried
        self.value = value
        self._idle = idle
        self._length = length
        self._gradient = gradient
        free = self._free()
        self._direction = torch.where(better, self._pairs.direction(self._gradient, free), self._direction)
        self.converged = (self._idle >= 2) | (self._length < SHORTEST) | self._flat(free)

    def _flat(self, free: Tensor | None) -> Tensor:
        """Whether the gradient that parameters may follow is within the tolerance: (S,)."""
        steepest = self._gradient if free is None else torch.where(free, self._gradient, 0)
        return steepest.abs().amax(0) <= self._tolerance_of(self.value)

    def _tolerance_of(self, value: Tensor) -> float:
        return max(self._tolerance, FINEST * torch.finfo(value.dtype).eps)

    def _free(self) -> Tensor | None:
        """Which parameters may follow their gradient: (P, S), or None for all."""
        if not self._bounded:
            return None
        held_low = (self.theta <= self._low) & (self._gradient > 0)
        return ~(held_low | ((self.theta >= self._high) & (self._gradient < 0)))


# For every place of the oldest pair, the order of s and then y by age, and its inverse.
RINGS = [(torch.arange(PAIRS) + oldest) % PAIRS for oldest in range(PAIRS)]
OLDEST_FIRST = [torch.cat([ring, ring + PAIRS]) for ring in RINGS]
AS_STORED = [order.argsort() for order in OLDEST_FIRST]


class CurvaturePairs:
    """The last steps s and gradient changes y of every start, which turn a gradient into a direction.

    The compact form of Byrd, Nocedal & Schnabel (1994, theorem 2.2) needs only a few products of small matrices:
    H g = γ g + S q − γ Y p with p = R⁻¹ Sᵀg, q = R⁻ᵀ ((D + γ YᵀY) p − γ Yᵀg), R the upper triangle of SᵀY, D its
    diagonal.
    """

    def __init__(self, theta: Tensor, size: float = 0.0) -> None:
        n = PAIRS
        n_parameters, n_starts = theta.shape
        self._both = theta.new_zeros(n_starts, 2 * n, n_parameters)  # the last n s, then the last n y, each a ring
        self._sy = torch.eye(n, dtype=theta.dtype).repeat(n_starts, 1, 1)  # (S, n, n), R is upper
        self._yy = torch.zeros_like(self._sy)
        self._good = torch.zeros_like(self._sy[:, :, :1])  # (S, n, 1): 1 for a usable pair, else 0
        self._size = theta.new_full((n_starts,), size)  # γ = s·y / y·y of the last good pair; 0 if none is known
        self._n = 0

    def keep(self, columns: list[int], dtype: torch.dtype) -> None:
        """Keep these starts only, in this precision."""
        for name in ("_both", "_sy", "_yy", "_good", "_size"):
            setattr(self, name, getattr(self, name)[columns].to(dtype))

    def add(self, step: Tensor, change: Tensor) -> None:
        """Add a pair per start, (P, S); 0 where a start did not move."""
        at = self._n % PAIRS
        self._n += 1
        along, square = (step * change).sum(0), change.square().sum(0)
        good = along > CURVED * square
        self._size = torch.where(good, along / square, self._size)
        new = self._both[:, at::PAIRS]
        torch.mul(torch.stack([step, change]), good, out=new.permute(1, 2, 0))
        with_y = self._products(new[:, 1:])[..., 0]
        for old in (self._sy, self._yy):
            old[:, :-1, :-1] = old[:, 1:, 1:].clone()
        self._good[:, :-1] = self._good[:, 1:].clone()
        self._good[:, -1, 0] = good
        self._sy[:, :, -1] = with_y[:, :PAIRS]
        self._sy[:, -1, -1] += ~good  # entries below the diagonal are never read
        self._yy[:, :, -1] = self._yy[:, -1] = with_y[:, PAIRS:]

    def direction(self, gradient: Tensor, free: Tensor | None) -> Tensor:
        """Return −H g, (P, S), in the free parameters; where it does not descend, the steepest descent."""
        start = gradient if free is None else torch.where(free, gradient, 0)
        # The first step has length 1 at most.
        size = torch.where(self._size > 0, self._size, start.square().sum(0).rsqrt().clamp(max=1))
        out = start * -size
        if self._n == 0:
            return out
        with_g = self._products(start.T.contiguous()[:, None])
        gamma = size[:, None, None]
        p = torch.linalg.solve_triangular(self._sy, with_g[:, :PAIRS], upper=True)
        right = torch.baddbmm(with_g[:, PAIRS:], self._yy, p, beta=-1).mul_(gamma)
        right.addcmul_(self._sy.diagonal(dim1=1, dim2=2)[..., None] * self._good, p)
        q = torch.linalg.solve_triangular(self._sy.transpose(1, 2), right, upper=False)
        parts = torch.cat([-q, gamma * p], dim=1)[:, AS_STORED[self._n % PAIRS]]
        newton = out + (parts.transpose(1, 2) @ self._both)[:, 0].T
        if free is not None:
            newton = torch.where(free, newton, 0)
        return torch.where((newton * start).sum(0) < 0, newton, out)

    def _products(self, row: Tensor) -> Tensor:
        """Return products of (S, 1, P) with every s and every y, oldest first: (S, 2 n, 1)."""
        # With a column on the right instead, the product takes nine times as long.
        return (row @ self._both.transpose(1, 2)).transpose(1, 2)[:, OLDEST_FIRST[self._n % PAIRS]]
