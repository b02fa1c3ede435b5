"""Draws pairs of observations some steps apart from saved trajectories."""

from collections.abc import Iterable

import numpy as np
import torch

from sb3_options.embedding.encoders import Encoder, ObservationForm, as_tensor
from sb3_options.experience.observations import batch_size, concatenate, keys_of, take
from sb3_options.experience.trajectories import Trajectory

MOST_BYTES = 32 << 20  # of the trajectories that a map is learned from at once


class Replay:
    """The distinct observations of trajectories, or of a random part of them if they are larger than ``MOST_BYTES``.

    An observation that occurs repeatedly in a batch is encoded once: in a gridworld, encoding takes most of the time of
    learning from images.
    """

    def __init__(self, trajectories: Iterable[Trajectory], form: ObservationForm, generator: torch.Generator) -> None:
        row_of: dict[bytes, int] = {}
        new, paths = [], []
        for trajectory in _some([each for each in trajectories if len(each)], generator):
            n = batch_size(trajectory.states)
            rows = np.empty(n, dtype=np.int64)
            fresh = []
            for i, key in enumerate(keys_of(trajectory.states)):
                before = len(row_of)
                rows[i] = row_of.setdefault(key, before)
                if rows[i] == before:
                    fresh.append(i)
            new.append(take(trajectory.states, np.array(fresh, dtype=np.int64)))
            paths.append(rows[trajectory.visits])
        self.observations = as_tensor(concatenate(new), form)
        self._visits = torch.from_numpy(np.concatenate(paths))
        lengths = [len(path) for path in paths]
        ends = np.repeat(np.cumsum(lengths), lengths)
        # How many steps follow each visit in its trajectory.
        self._left = torch.from_numpy(ends - np.arange(len(ends)) - 1)
        self._starts = torch.nonzero(self._left).ravel()
        # The same visits, grouped by observation: each group has its count, and begins at ``first``.
        self._sorted = self._starts[torch.argsort(self._visits[self._starts], stable=True)]
        _, self._counts = torch.unique_consecutive(self._visits[self._sorted], return_counts=True)
        self._first = torch.cumsum(self._counts, dim=0) - self._counts

    def __len__(self) -> int:
        """Number of distinct observations."""
        return len(self.observations)

    def steps(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return rows of the observations before and after every primitive step that moved, (n,) each."""
        before, after = self._visits[self._starts], self._visits[self._starts + 1]
        moved = before != after
        return before[moved], after[moved]

    def sample(self, n: int, horizon: float, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Return rows of ``n`` pairs k steps apart, earlier and later.

        P(k) ∝ γᵏ⁻¹ for k up to the end of the trajectory, γ = 1 − 1/horizon.

        Each distinct observation begins a pair equally often. A walk visits some places a hundred times as often as
        others. If pairs were drawn by visits, rare places would lie far from everything, however near they are.
        """
        which = torch.randint(len(self._counts), (n,), generator=generator)
        visit = torch.rand(n, dtype=torch.float64, generator=generator) * self._counts[which]
        at = self._sorted[self._first[which] + visit.long()]
        left = self._left[at].double()
        log_gamma = np.log1p(-1.0 / horizon)
        uniform = torch.rand(n, dtype=torch.float64, generator=generator)
        # The inverse of the truncated distribution function, 1 − γᵏ over 1 − γˡᵉᶠᵗ.
        mass = -torch.expm1(left * log_gamma)
        steps = torch.ceil(torch.log1p(-uniform * mass) / log_gamma).clamp(min=1.0)
        steps = torch.minimum(steps, left).long()
        return self._visits[at], self._visits[at + steps]

    def encoded(self, encoder: Encoder, *rows: torch.Tensor) -> list[torch.Tensor]:
        """Encode the observations in these rows, (n, size) for each."""
        distinct, which = torch.unique(torch.cat(rows), return_inverse=True)
        made = encoder(self.observations[distinct])[which]
        return list(made.split([len(each) for each in rows]))


def _some(trajectories: list[Trajectory], generator: torch.Generator) -> list[Trajectory]:
    """Draw trajectories of up to ``MOST_BYTES`` together, at least one, and keep their order."""
    n_bytes = torch.tensor([each.n_bytes for each in trajectories])
    if n_bytes.sum() <= MOST_BYTES:
        return trajectories
    order = torch.randperm(len(trajectories), generator=generator)
    n = max(1, int((n_bytes[order].cumsum(dim=0) <= MOST_BYTES).sum()))
    return [trajectories[i] for i in sorted(order[:n].tolist())]
