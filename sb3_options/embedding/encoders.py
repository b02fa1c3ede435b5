"""Networks of learned feature maps: a table for numbered states, convolutions for images, else two layers."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import nn

from sb3_options.experience.observations import Observations, flatten

CLIP = 5.0  # standardised observations are clipped to ± this (Burda et al. 2018, §2.4)
SMALLEST = 1e-3  # least standard deviation of a pixel, as a share of the largest: constant pixels become 0
ROUNDING = 1e-6  # the same for other numbers, as a share of their mean: smaller changes are rounding errors
MIN_IMAGE = 36  # pixels; smallest side that the convolutions of Mnih et al. (2015) accept
HIDDEN = 64  # units of hidden layers
CHANNELS = (8, 16)  # of both convolutions, half as many as in Mnih et al. (2013): a map has little to tell apart


class ObservationForm(NamedTuple):
    """The form of observations, as an encoder needs it: numbered states, an image, or anything else, flattened."""

    kind: Literal["table", "image", "vector"]
    shape: tuple[int, ...]  # (n,) states; (channels, height, width); (numbers,)
    first: int = 0  # number of the first state; for an image 1 if channels come last, else 0


def form_of_array(shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> ObservationForm:
    """Return the form of observations that are one array: an image if shape and dtype fit."""
    for first, channels, sides in ((1, shape[-1:], shape[:2]), (0, shape[:1], shape[1:])):
        if dtype == np.uint8 and len(shape) == 3 and channels[0] in (1, 3, 4, 12) and min(sides) >= MIN_IMAGE:
            return ObservationForm("image", (*channels, *sides), first)
    return ObservationForm("vector", (int(np.prod(shape, dtype=np.int64)),))


def as_tensor(observations: Observations, form: ObservationForm) -> torch.Tensor:
    """Convert a batch to the encoder's layout, not yet standardised; bytes stay bytes.

    The layout is state numbers (n,), images (n, channels, height, width), or rows (n, numbers).
    """
    if form.kind == "table":
        return torch.from_numpy(np.asarray(observations).reshape(len(observations)).astype(np.int64) - form.first)
    if form.kind == "image":
        assert not isinstance(observations, Mapping)  # only an array has this form
        images = np.moveaxis(observations, -1, 1) if form.first else observations
        return torch.from_numpy(np.ascontiguousarray(images))
    return torch.from_numpy(flatten(observations).astype(np.float32))


class Encoder(nn.Module):
    """A network from observations to ``size`` numbers.

    Each number of an observation is standardised by the data seen before the first gradient step. Constant parts, such
    as walls in a picture, become 0, so the agent stands out however small it is.
    """

    shift: torch.Tensor
    factor: torch.Tensor

    def __init__(self, form: ObservationForm, size: int) -> None:
        super().__init__()
        self.form = form
        shape = () if form.kind == "table" else form.shape
        self.register_buffer("shift", torch.zeros(shape))
        self.register_buffer("factor", torch.ones(shape))
        if form.kind == "image":
            self.layers = _convolutions(form.shape, size)
        else:
            n = form.shape[0]
            first = [nn.Embedding(n, HIDDEN)] if form.kind == "table" else [nn.Linear(n, HIDDEN), nn.ReLU()]
            # From a table not straight to the output: rows that share no weights need many more gradient steps.
            self.layers = nn.Sequential(*first, nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, size))

    def standardise_by(self, batch: torch.Tensor) -> None:
        """Set mean and standard deviation of each number from a batch, in the layout of `as_tensor`."""
        if self.form.kind == "table":
            return
        if self.form.kind == "image":
            std, mean = torch.std_mean(batch.float(), dim=0, correction=0)
            least = SMALLEST * std.max()
        else:  # numbers of any units: each has its own floor, and squares of large numbers need double precision
            std, mean = torch.std_mean(batch.double(), dim=0, correction=0)
            least = ROUNDING * mean.abs()
        self.shift.copy_(mean)
        self.factor.copy_(1.0 / torch.clamp(torch.maximum(std, least), min=1e-8))

    def forward(self, batch: torch.Tensor) -> torch.Tensor:
        """Map the layout of `as_tensor` to (n, size)."""
        if self.form.kind != "table":
            batch = ((batch.float() - self.shift) * self.factor).clamp(-CLIP, CLIP)
        made: torch.Tensor = self.layers(batch)
        return made


def _convolutions(shape: tuple[int, ...], size: int) -> nn.Sequential:
    """Build two convolutions and a hidden layer (Mnih et al. 2013), padded so that they see all edge pixels."""
    first, second = CHANNELS
    convolutions = nn.Sequential(
        nn.Conv2d(shape[0], first, 8, stride=4, padding=4),
        nn.ReLU(),
        nn.Conv2d(first, second, 4, stride=2, padding=2),
        nn.ReLU(),
        nn.Flatten(),
    )
    with torch.no_grad():
        n = convolutions(torch.zeros(1, *shape)).shape[1]
    return nn.Sequential(convolutions, nn.Linear(n, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, size))
