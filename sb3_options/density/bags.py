"""Bags of instances, packed for evaluation: every positive bag padded to rows of one width, feature by feature."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from sb3_options.density.arrays import FloatArray

# What a row of the padded layout costs beside its instances, in instances.
ROW_COST = 8


@dataclass(frozen=True, eq=False)
class Bags:
    """Bags of instances, packed once and searched many times; made by :meth:`pack`.

    Attributes:
        instances: (N, d) in float64, bag after bag, the positive bags first.
        lengths: Number of instances in each bag.
        n_positive: Number of positive bags.
        dtype: Precision in which densities are computed.
        weights: Of every bag, a relative measure of how far it can be trusted (the paper's §8): its log probability
            is multiplied by it. None for 1.
    """

    instances: Tensor
    lengths: tuple[int, ...]
    n_positive: int
    dtype: torch.dtype
    weights: tuple[float, ...] | None = None
    _layouts: "dict[torch.dtype, Layout]" = field(default_factory=dict, repr=False)

    @classmethod
    def pack(
        cls,
        positive: Sequence[ArrayLike],
        negative: Sequence[ArrayLike] = (),
        *,
        weights: ArrayLike | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> Self:
        """Pack bags of shape (n_i, d). An instance given twice counts twice: pass first visits only.

        Args:
            positive: Bags that hold an instance of the concept.
            negative: Bags that hold none.
            weights: One for each bag, the positive ones first; 1 by default.
            dtype: Precision in which densities are computed.
            device: Where.

        Raises:
            ValueError: No bag at all, an empty bag, bags that disagree about d, NaN or infinite features, or
                weights that are negative, not finite, or not one a bag.
        """
        names = [f"positive bag {i}" for i in range(len(positive))]
        names += [f"negative bag {i}" for i in range(len(negative))]
        if not names:
            raise ValueError("there are no bags: pass at least one positive or negative bag")
        arrays = [np.asarray(bag, dtype=np.float64) for bag in (*positive, *negative)]
        for name, array in zip(names, arrays, strict=True):
            if array.size == 0:
                raise ValueError(f"{name} is empty, of shape {array.shape}: leave empty bags out")
            if array.ndim != 2:
                raise ValueError(f"{name} must have shape (instances, features), got {array.shape}")
            if array.shape[1] != arrays[0].shape[1]:
                raise ValueError(f"{name} has {array.shape[1]} features, {names[0]} has {arrays[0].shape[1]}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} holds NaN or infinite features")
        if weights is not None:
            weights = np.asarray(weights, dtype=np.float64)
            if weights.shape != (len(arrays),) or not (np.isfinite(weights) & (weights >= 0)).all():
                raise ValueError(
                    f"weights must be {len(arrays)} finite numbers of at least 0, one a bag, got {weights}"
                )
            weights = tuple(weights.tolist())
        instances = torch.from_numpy(np.concatenate(arrays)).to(device)
        return cls(instances, tuple(map(len, arrays)), len(positive), dtype, weights)

    @property
    def bag_weights(self) -> tuple[float, ...]:
        """The weight of every bag."""
        return (1.0,) * len(self.lengths) if self.weights is None else self.weights

    @property
    def n_features(self) -> int:
        """The dimension d of the feature space."""
        return int(self.instances.shape[1])

    def smallest_positive(self, n: int) -> FloatArray:
        """Distinct instances (m, d) of the `n` positive bags with the fewest, in the order packed."""
        positive = torch.split(self.instances, list(self.lengths))[: self.n_positive]
        smallest = sorted(sorted(range(len(positive)), key=lambda i: self.lengths[i])[:n])
        return distinct(torch.cat([self.instances[:0], *(positive[i] for i in smallest)]).cpu().numpy())

    def positive(self) -> "Bags":
        """The positive bags alone."""
        if self.n_positive == len(self.lengths):
            return self
        n_instances = sum(self.lengths[: self.n_positive])
        weights = None if self.weights is None else self.weights[: self.n_positive]
        return Bags(self.instances[:n_instances], self.lengths[: self.n_positive], self.n_positive, self.dtype, weights)

    def layout(self, dtype: torch.dtype) -> "Layout":
        """The bags as the kernels read them, in this precision; made once."""
        if dtype not in self._layouts:
            self._layouts[dtype] = Layout.of(self, dtype)
        return self._layouts[dtype]


class Layout(NamedTuple):
    """Bags as the kernels read them: by feature, each positive bag padded to as many rows as it needs."""

    origin: Tensor  # (d,): an instance, so that integers stay integers and a common offset costs no digits
    powers: Tensor  # (1 + 2 d, rows * width + n_negative): 1, x_k and x_k², relative to the origin
    padding: Tensor  # (rows * width + n_negative,): 0, or -inf for a place without an instance
    rows: tuple[int, int]  # rows, width
    bag_of_row: Tensor | None  # (rows,), or None where every bag is one row
    n_bags: int
    bag_weights: Tensor | None  # (bags,) of positive bags, or None where every weight is 1
    negative_weights: Tensor | None  # (n_negative,): of the bag of each negative instance

    @classmethod
    def of(cls, bags: Bags, dtype: torch.dtype) -> "Layout":
        """Lay bags out, with the row width that costs least."""
        lengths = np.array(bags.lengths[: bags.n_positive], dtype=np.int64)
        n_instances, n_positive = len(bags.instances), int(lengths.sum())
        widths = np.unique(np.append(lengths, 2 ** np.arange(int(lengths.max(initial=1)).bit_length())))
        rows = -(-lengths // widths[:, None])
        best = int(np.argmin(rows.sum(1) * (widths + ROW_COST)))
        width, rows = int(widths[best]), rows[best]
        bag = np.repeat(np.arange(len(lengths)), rows)
        row_in_bag = np.arange(len(bag)) - np.repeat(np.cumsum(rows) - rows, rows)
        place, length = row_in_bag[:, None] * width + np.arange(width), lengths[bag, None]
        index = (np.cumsum(lengths) - lengths)[bag, None] + np.minimum(place, length - 1)
        padding = np.append(np.where(place < length, 0.0, -np.inf), np.zeros(n_instances - n_positive))

        device = bags.instances.device
        columns = torch.from_numpy(np.append(index.ravel(), np.arange(n_positive, n_instances))).to(device)
        x = (bags.instances - bags.instances[0])[columns].T
        weights = torch.tensor(bags.bag_weights, dtype=dtype, device=device)
        negative_lengths = bags.lengths[bags.n_positive :]
        negative_bag = torch.from_numpy(np.repeat(np.arange(len(negative_lengths)), negative_lengths)).to(device)
        return cls(
            origin=bags.instances[0],
            powers=torch.cat([torch.ones_like(x[:1]), x, x * x]).to(dtype),
            padding=torch.from_numpy(padding).to(device, dtype),
            rows=(len(bag), width),
            bag_of_row=None if len(bag) == len(lengths) else torch.from_numpy(bag).to(device),
            n_bags=len(lengths),
            bag_weights=None if bags.weights is None else weights[: bags.n_positive],
            negative_weights=None if bags.weights is None else weights[bags.n_positive :][negative_bag],
        )

    def per_bag(self, rows: Tensor, reduce: Literal["amax", "prod", "sum"]) -> Tensor:
        """Reduce (S, rows) to (S, bags)."""
        if self.bag_of_row is None:
            return rows
        out = rows.new_empty(len(rows), self.n_bags)
        return out.scatter_reduce_(1, self.bag_of_row.expand_as(rows), rows, reduce, include_self=False)

    def per_row(self, bags: Tensor) -> Tensor:
        """Spread (S, bags) to (S, rows, 1)."""
        return (bags if self.bag_of_row is None else bags[:, self.bag_of_row])[..., None]


def distinct(points: FloatArray) -> FloatArray:
    """Drop repeated rows, keep the order. Adding 0 makes -0 a 0, whose bytes it must share."""
    first = {row.tobytes(): i for i, row in reversed(list(enumerate(points + 0.0)))}
    return points[sorted(first.values())]
