"""Bags in the form that a search for one class of concepts needs: scaled, and packed once."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.concepts import Concept
from sb3_options.density.energies import Columns, Likelihood
from sb3_options.density.layout import Segment, Workspace, segments_of
from sb3_options.density.objective import evaluate

FARTHEST = 1e15  # widths from the origin: squared and times squared learned scales, they fit single precision


class Evidence:
    """Bags in scaled features, (x − origin) · scale, in each precision requested."""

    def __init__(
        self, bags: Bags, concept: Concept, origin: FloatArray, scale: FloatArray, likelihood: Likelihood
    ) -> None:
        self.concept = concept
        self.origin = origin
        self.scale = scale
        self._likelihood = likelihood
        self._arrays = bags.arrays(self.scaled)
        self._workspace = Workspace()
        self._segments: dict[torch.dtype, list[Segment]] = {}

    def sample(self, n: int) -> Evidence:
        """Return evidence of up to ``n`` positive and ``n`` negative bags, evenly spaced."""
        positive = self._arrays.positive
        chosen = np.concatenate([evenly(np.flatnonzero(positive == sign), n) for sign in (True, False)])
        sample = copy.copy(self)
        sample._arrays = self._arrays.take(chosen)
        sample._workspace = Workspace()
        sample._segments = {}
        return sample

    @torch.inference_mode()
    def loss(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return −log DD − log prior of every column of θ (P, S), shape (S,), and its gradient (P, S).

        An energy z at scaled features x, relative to their mean, has an error of about ε (‖s x‖² + ‖s t‖²). For
        log(1 − η p) of a negative instance this error is divided by 1 − η p. In double precision this also holds where
        a centre comes close. There the rounding of θ remains: ε ‖s t‖ over the distance. ε is 1e-15, or 1e-6 in single
        precision. In single precision a hit negative instance costs about 15 nats instead of up to ∞, enough to refuse
        it during a search.
        """
        columns = Columns(self.concept.coefficients(theta), self.concept.centre(theta))
        at = evaluate(columns, self.segments(theta.dtype), self._likelihood, self._workspace)
        prior, pull = self.concept.log_prior(theta)
        pull.add_(self.concept.pull_back(theta, at.gradient))
        return at.log_density.add_(prior).neg_(), pull.neg_()

    @torch.inference_mode()
    def value(self, theta: Tensor) -> Tensor:
        """Return the loss alone, (S,); double precision measures small energies exactly."""
        centre = self.concept.centre(theta)
        exact = theta.dtype == torch.float64 and not self._likelihood.logistic
        columns = Columns(self.concept.coefficients(theta), centre, exact)
        at = evaluate(columns, self.segments(theta.dtype), self._likelihood, self._workspace, gradient=False)
        return at.log_density.add_(self.concept.log_prior(theta)[0]).neg_()

    def positive_instances(self) -> FloatArray:
        """Return the scaled instances of all positive bags, (n, m)."""
        return self._arrays.instances[np.repeat(self._arrays.positive, self._arrays.lengths)]

    def segments(self, dtype: torch.dtype) -> list[Segment]:
        """Return the bags in this precision; packed once."""
        if dtype not in self._segments:
            self._segments[dtype] = segments_of(self._arrays, dtype)
        return self._segments[dtype]

    def scaled(self, instances: FloatArray) -> FloatArray:
        """Convert features (n, d) to scaled features (n, m)."""
        # In torch: numpy takes three times as long to subtract from rows of few features.
        origin, scale = torch.from_numpy(self.origin), torch.from_numpy(self.scale)
        scaled: FloatArray = torch.from_numpy(instances).sub(origin).mul_(scale).numpy()
        reach = max(scaled.max(initial=0), -scaled.min(initial=0))
        if reach > FARTHEST:
            raise ValueError(
                f"features reach {reach:.1g} widths from their middle, at most {FARTHEST:g} can be searched: "
                "pass a smaller scale, or leave out what lies so far"
            )
        return scaled


def evenly(rows: Any, n: int) -> Any:
    """Return up to ``n`` rows of an array, evenly spaced."""
    return rows if len(rows) <= n else rows[np.linspace(0, len(rows) - 1, n).round().astype(np.int64)]
