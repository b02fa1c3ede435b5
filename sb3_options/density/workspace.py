"""Arrays that the kernels of the objective write into, laid out for speed and kept between evaluations."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from sb3_options.density.layout import Segment

FEW_STARTS = 9
"""Below this many starts arrays are stored start by start: products with so few columns are slow."""


class Arrays(NamedTuple):
    """What one evaluation writes into, for N instances in R rows and S starts."""

    p: Tensor  # (N, S)
    rows: Tensor  # (2, R, S): probabilities of a hit in each row, and of none
    divisor: Tensor  # (R, S)
    divisors: Tensor  # (B + 1, S), the last one 1
    ends: Tensor  # (2, 1, 1): what a hit makes of both probabilities, 1 and 0
    p_blocks: tuple[Tensor, ...]  # views of the first instances of all rows, of the second ones, and so on
    rows_blocks: tuple[Tensor, ...]  # views of the rows that have a first instance, a second one, and so on
    divisor_blocks: tuple[Tensor, ...]
    spare_blocks: tuple[Tensor, ...]  # of no meaning
    by_bag: Tensor  # (2, R of positive bags, S): their rows, the first of every bag, then the second, and so on
    hit_by_bag: tuple[Tensor, ...]  # views of those, and of the bags that have them
    miss_by_bag: tuple[Tensor, ...]
    hit_of_bags: tuple[Tensor, ...]
    miss_of_bags: tuple[Tensor, ...]


class Workspace:
    """Arrays that every evaluation writes into: fresh memory and fresh views cost as much as the arithmetic."""

    VIEWS = 64
    """Shapes whose views are kept."""

    def __init__(self) -> None:
        self._flat = torch.empty(0)
        self._views: dict[tuple[int, int, torch.dtype], tuple[Segment, Arrays]] = {}

    def take(self, segment: Segment, n_starts: int, like: Tensor) -> Arrays:
        """Uninitialised arrays with the precision and the device of ``like``."""
        key = (id(segment), n_starts, like.dtype)
        known = self._views.get(key)
        if known is not None and known[0] is segment:
            return known[1]
        n = len(segment.powers) * n_starts
        flat = self._flat
        if len(flat) < n or flat.dtype != like.dtype or flat.device != like.device:
            self._flat = like.new_empty(n)
            self._views.clear()
        if len(self._views) == self.VIEWS:
            self._views.clear()
        p = _columns(self._flat[:n], n_starts)
        n_rows = segment.counts[0]
        divisor, spare = (_columns(like.new_empty(n_rows * n_starts), n_starts) for _ in range(2))
        rows = like.new_empty(2, n_rows, n_starts)
        if not divisor.is_contiguous():
            rows = like.new_empty(2, n_starts, n_rows).transpose(1, 2)
        of_bags = [len(numbers) for numbers in segment.rows_of_bags]
        by_bag = like.new_empty(2, sum(of_bags), n_starts)
        hits, misses = (torch.split(part, of_bags) if of_bags else () for part in by_bag)
        arrays = Arrays(
            p=p,
            rows=rows,
            divisor=divisor,
            divisors=like.new_ones(len(segment.bag_weight) + 1, n_starts),
            ends=like.new_tensor([1, 0]).view(2, 1, 1),
            p_blocks=torch.split(p, list(segment.counts)),
            spare_blocks=tuple(spare[:count] for count in segment.counts),
            rows_blocks=tuple(rows[:, :count] for count in segment.counts),
            divisor_blocks=tuple(divisor[:count] for count in segment.counts),
            by_bag=by_bag,
            hit_by_bag=tuple(hits),
            miss_by_bag=tuple(misses),
            hit_of_bags=tuple(by_bag[0, :count] for count in of_bags),
            miss_of_bags=tuple(by_bag[1, :count] for count in of_bags),
        )
        self._views[key] = (segment, arrays)
        return arrays


def _columns(flat: Tensor, n_starts: int) -> Tensor:
    """As (rows, S), stored row by row or, for few starts, start by start."""
    return flat.view(-1, n_starts) if n_starts >= FEW_STARTS else flat.view(n_starts, -1).T
