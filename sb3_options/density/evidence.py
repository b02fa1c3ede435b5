"""Bags as a search for one class of concepts sees them: scaled, and packed once."""

from __future__ import annotations

import copy
import functools
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.concepts import Concept, Frame
from sb3_options.density.energies import Columns, Likelihood
from sb3_options.density.layout import SEGMENT_INSTANCES, BagArrays, Segment, Workspace, segment_of
from sb3_options.density.objective import evaluate

FARTHEST = 1e15
"""Widths from the origin whose squares, times those of learned scales, single precision can hold."""


class Evidence:
    """Bags in scaled features, in as many precisions as are asked for.

    Args:
        bags: What there is at first.
        concept: The class of concepts they are evidence for.
        frame: Scaled features.
        likelihood: What they say.
        negative_width: Width of negative instances of `ConceptSearch`.
        max_pairs: (instances × starts) held at once.
    """

    def __init__(
        self,
        bags: Bags,
        concept: Concept,
        frame: Frame,
        *,
        likelihood: Likelihood,
        negative_width: float,
        max_pairs: int,
    ) -> None:
        self.concept, self.frame = concept, frame
        self.device = bags.instances.device
        self._likelihood, self._width, self._max_pairs = likelihood, negative_width, max_pairs
        self._workspace = Workspace()
        self._parts = bags.arrays(self.scaled).split(SEGMENT_INSTANCES)
        self._segments: dict[torch.dtype, list[Segment]] = {}

    @property
    def n_instances(self) -> int:
        """How many instances they hold."""
        return sum(len(part.instances) for part in self._parts)

    @property
    def positive_weight(self) -> float:
        """Sum of the weights of the positive bags."""
        return float(sum(part.weights[part.positive].sum() for part in self._parts))

    def sample(self, n: int) -> Evidence:
        """Evidence of up to ``n`` positive and ``n`` negative bags, evenly spaced."""
        positive = np.concatenate([part.positive for part in self._parts])
        chosen = np.concatenate([evenly(np.flatnonzero(positive == sign), n) for sign in (True, False)])
        ends = np.cumsum([len(part.lengths) for part in self._parts])
        some = [
            part.take(inside)
            for part, end in zip(self._parts, ends, strict=True)
            if len(inside := chosen[(chosen >= end - len(part.lengths)) & (chosen < end)] - end + len(part.lengths))
        ]
        sample = copy.copy(self)
        sample._parts, sample._segments, sample._workspace = [functools.reduce(BagArrays.joined, some)], {}, Workspace()
        return sample

    @torch.inference_mode()
    def loss(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """−log DD − log prior of every column of θ (P, S), shape (S,), and its gradient (P, S).

        An energy z at scaled features x, relative to their middle, has an error of some ε (‖s x‖² + ‖s t‖²), and
        log(1 − η p) of a negative instance that over 1 − η p; in double precision also where a centre comes close,
        with the rounding of θ left: ε ‖s t‖ over the distance. ε is 1e-15, or 1e-6 in single precision, in which a
        negative instance that is hit costs some 15 nats instead of up to ∞: enough to refuse it, while a search runs.
        """
        columns = Columns(self.concept.coefficients(theta), self.concept.centre(theta))
        at = evaluate(columns, self.segments(theta.dtype), self._likelihood, self._workspace, max_pairs=self._max_pairs)
        prior, pull = self.concept.log_prior(theta)
        pull.add_(self.concept.pull_back(theta, at.gradient))
        return at.log_density.add_(prior).neg_(), pull.neg_()

    @torch.inference_mode()
    def value(self, theta: Tensor) -> Tensor:
        """The loss alone, (S,); in double precision small energies are measured exactly."""
        centre = self.concept.centre(theta)
        columns = Columns(self.concept.coefficients(theta), centre, theta.dtype == torch.float64 and len(centre) > 0)
        segments, limit = self.segments(theta.dtype), self._max_pairs
        at = evaluate(columns, segments, self._likelihood, self._workspace, gradient=False, max_pairs=limit)
        return at.log_density.add_(self.concept.log_prior(theta)[0]).neg_()

    def positive_instances(self) -> FloatArray:
        """Scaled instances of all positive bags, (n, m)."""
        return np.concatenate([part.instances[np.repeat(part.positive, part.lengths)] for part in self._parts])

    def segments(self, dtype: torch.dtype) -> list[Segment]:
        """The bags in this precision; packed once."""
        if dtype not in self._segments:
            self._segments[dtype] = [self._packed(part, dtype) for part in self._parts]
        return self._segments[dtype]

    def _packed(self, part: BagArrays, dtype: torch.dtype) -> Segment:
        return segment_of(
            part,
            n_powers=self.concept.n_powers,
            width=self._width,
            dtype=dtype,
            device=self.device,
        )

    def scaled(self, instances: FloatArray) -> FloatArray:
        """Features (n, d) in scaled features (n, m).

        Raises:
            ValueError: They lie further from the origin than single precision can square.
        """
        scaled = (instances[:, self.frame.features] - self.frame.origin) * self.frame.scale
        reach = np.abs(scaled).max(initial=0)
        if reach > FARTHEST:
            raise ValueError(
                f"features reach {reach:.1g} widths from their middle, at most {FARTHEST:g} can be searched: "
                "pass a smaller scale, or leave out what lies so far"
            )
        return np.asarray(scaled)


def evenly(rows: Any, n: int) -> Any:
    """Up to ``n`` rows of an array, evenly spaced."""
    return rows if len(rows) <= n else rows[np.linspace(0, len(rows) - 1, n).round().astype(np.int64)]
