"""Cuts bags into segments that fit the cache, in a layout that wastes nothing on uneven bags.

A bag is cut into rows of nearly equal length, at most ``SHORTEST_WIDTH`` instances each, or √n if that is more, for the
longest bag of n. The rows of a segment are ordered by length, longest first, and stored place by place: first the first
instance of every row, then the second instance of every row that has one, and so on. So the k-th places are a block
whose rows are a prefix of all rows. Every reduction over a bag is a chain of operations on whole blocks, without
padding.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sb3_options.density.arrays import BoolArray, FloatArray, IntArray

SEGMENT_INSTANCES = 1 << 17  # of a segment, unless one bag has more; 8 starts at once then fill `MAX_PAIRS`

SHORTEST_WIDTH = 16  # smallest limit on row length: a place costs three calls, a row its share of the work on rows
FEW_STARTS = 9  # below this, arrays are stored start by start: products with so few columns are slow


class Segment(NamedTuple):
    """Some bags, as the kernels read them; R rows, N instances, B positive bags.

    Powers are 1, x_k and x_k². If there are negative instances, one more column is 1 for these and 0 for others.
    """

    powers: Tensor  # (N, K)
    powers_by_power: Tensor  # (K, N)
    reach: Tensor  # (K,), the largest magnitude of each power
    counts: tuple[int, ...]  # rows that have a first, second, … instance; their sum is N
    negative_rows: Tensor  # numbers of the rows of negative bags
    n_positive: int  # B
    bag_of_row: Tensor  # (R,): positive bag of each row, B for rows of negative bags
    rows_by_bag: Tensor  # the first rows of all positive bags, the second rows of those that have one, …
    rows_of_bags: tuple[Tensor, ...]  # the same in parts


class BagArrays(NamedTuple):
    """Bags as arrays: instances (N, d) bag after bag, lengths (n,), and which are positive (n,)."""

    instances: FloatArray
    lengths: IntArray
    positive: BoolArray

    def take(self, numbers: IntArray) -> BagArrays:
        """Return some bags, at least one."""
        ends = np.cumsum(self.lengths)
        instances = np.concatenate([self.instances[ends[i] - self.lengths[i] : ends[i]] for i in numbers])
        return BagArrays(instances, self.lengths[numbers], self.positive[numbers])

    def split(self, n_instances: int) -> list[BagArrays]:
        """Split into parts of up to ``n_instances`` instances, without dividing a bag."""
        ends = np.cumsum(self.lengths)
        parts, first = [], 0
        while first < len(ends):
            began = ends[first] - self.lengths[first]
            last = max(first + 1, int(np.searchsorted(ends, began + n_instances, side="right")))
            bags = slice(first, last)
            instances = self.instances[began : ends[last - 1]]
            parts.append(BagArrays(instances, self.lengths[bags], self.positive[bags]))
            first = last
        return parts


def segments_of(bags: BagArrays, dtype: torch.dtype) -> list[Segment]:
    """Lay out bags in segments, in the units of the search."""
    return [_segment_of(part, dtype) for part in bags.split(SEGMENT_INSTANCES)]


def _segment_of(bags: BagArrays, dtype: torch.dtype) -> Segment:
    longest = max(SHORTEST_WIDTH, math.isqrt(int(bags.lengths.max()) - 1) + 1)
    rows = -(-bags.lengths // longest)
    bag = np.repeat(np.arange(len(rows)), rows)
    row_in_bag = np.arange(len(bag)) - np.repeat(np.cumsum(rows) - rows, rows)
    shortest, longer = bags.lengths[bag] // rows[bag], bags.lengths[bag] % rows[bag]
    length = shortest + (row_in_bag < longer)
    began = (np.cumsum(bags.lengths) - bags.lengths)[bag] + row_in_bag * shortest + np.minimum(row_in_bag, longer)
    order = np.argsort(-length, kind="stable")
    bag, row_in_bag, length, began = bag[order], row_in_bag[order], length[order], began[order]
    counts = [int((length > place).sum()) for place in range(int(length[0]))]
    index = np.concatenate([began[:count] + place for place, count in enumerate(counts)])

    positive = np.flatnonzero(bags.positive)
    positive = positive[np.argsort(-rows[positive], kind="stable")]
    number = np.full(len(rows), len(positive), dtype=np.int64)
    number[positive] = np.arange(len(positive))
    row_at = np.zeros((len(rows), int(rows.max())), dtype=np.int64)
    row_at[bag, row_in_bag] = np.arange(len(bag))
    row_counts = [int((rows[positive] > k).sum()) for k in range(int(rows[positive].max(initial=0)))]
    rows_of_bags = [row_at[positive[:n], k] for k, n in enumerate(row_counts)]
    rows_by_bag = torch.from_numpy(np.concatenate([row_at[:0, 0], *rows_of_bags]))

    negative = ~bags.positive[bag]
    negative_rows = np.flatnonzero(negative)
    x = np.take(bags.instances, index, axis=0).T  # five times as fast as an index in brackets
    powers = torch.empty((1 + 2 * len(x) + bool(len(negative_rows)), len(index)), dtype=dtype)
    powers[0] = 1
    powers[1 : 1 + len(x)] = torch.from_numpy(x)
    x *= x  # in place: new memory would cost as much as the arithmetic
    powers[1 + len(x) : 1 + 2 * len(x)] = torch.from_numpy(x)
    if len(negative_rows):
        powers[-1] = torch.from_numpy(np.concatenate([negative[:count] for count in counts]))

    highest, lowest = powers.numpy().max(axis=1), powers.numpy().min(axis=1)  # powers.abs() would need new memory
    return Segment(
        powers=torch.from_numpy(np.ascontiguousarray(powers.numpy().T)),
        powers_by_power=powers,
        reach=torch.from_numpy(np.maximum(highest, -lowest)),
        counts=tuple(counts),
        negative_rows=torch.from_numpy(negative_rows),
        n_positive=len(positive),
        bag_of_row=torch.from_numpy(number[bag]),
        rows_by_bag=rows_by_bag,
        rows_of_bags=torch.split(rows_by_bag, row_counts) if row_counts else (),
    )


class Arrays(NamedTuple):
    """Buffers of one evaluation, for N instances in R rows and S starts."""

    p: Tensor  # (N, S)
    rows: Tensor  # (2, R, S): probabilities of a hit and of no hit in each row
    divisor: Tensor  # (R, S)
    divisors: Tensor  # (B + 1, S), the last one 1
    ends: Tensor  # (2, 1, 1): both probabilities after a hit, 1 and 0
    p_blocks: tuple[Tensor, ...]  # views of the first instances of all rows, the second ones, and so on
    rows_blocks: tuple[Tensor, ...]  # views of the rows with a first instance, a second one, and so on
    divisor_blocks: tuple[Tensor, ...]
    spare_blocks: tuple[Tensor, ...]  # scratch memory
    by_bag: Tensor  # (2, R of positive bags, S): the first row of every bag, then the second, and so on
    hit_by_bag: tuple[Tensor, ...]  # views of these rows, and of the bags that have them
    miss_by_bag: tuple[Tensor, ...]
    hit_of_bags: tuple[Tensor, ...]
    miss_of_bags: tuple[Tensor, ...]


class Workspace:
    """Buffers reused by every evaluation: new memory and new views would cost as much as the arithmetic."""

    VIEWS = 8
    """Maximum views kept per segment, one per number of starts and precision."""

    def __init__(self) -> None:
        self._flat = torch.empty(0)
        self._views: dict[int, tuple[Segment, dict[tuple[int, torch.dtype], Arrays]]] = {}

    def take(self, segment: Segment, n_starts: int, like: Tensor) -> Arrays:
        """Return uninitialised arrays with the precision of ``like``."""
        key = (n_starts, like.dtype)
        _, views = self._views.setdefault(id(segment), (segment, {}))
        if key in views:
            return views[key]
        n = len(segment.powers) * n_starts
        flat = self._flat
        if len(flat) < n or flat.dtype != like.dtype:
            self._flat = like.new_empty(n)
            for _, others in self._views.values():
                others.clear()
        if len(views) == self.VIEWS:
            views.pop(next(iter(views)))
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
            divisors=like.new_ones(segment.n_positive + 1, n_starts),
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
        views[key] = arrays
        return arrays


def _columns(flat: Tensor, n_starts: int) -> Tensor:
    """View as (rows, S), stored row by row or, for few starts, start by start."""
    return flat.view(-1, n_starts) if n_starts >= FEW_STARTS else flat.view(n_starts, -1).T
