"""Intra-option learning: an update of every option that is consistent with a primitive step.

An option o is consistent with a step s, a, r, s' if π_o(s) = a. Its value then moves towards

    r + γ U(s', o),   U(s', o) = (1 − β(s')) Q(s', o) + β(s') max Q(s', a')

(one-step intra-option Q-learning; Sutton, Precup & Singh 1999, §6). No importance weights are needed, because the
policies of options are functions of the observation: reward and successor of a consistent step are drawn as under the
option. The algorithm is for Markov options. Hence the longest duration, which is a property of the run and not of the
state, does not enter, and a hand-made option whose policy is random or has a memory must not be learned this way.
``replay_buffer_kwargs={"intra_option": True}`` switches it on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from sb3_options.experience.observations import BoolArray, FloatArray, IntArray, Observations
from sb3_options.options.option import Option

OptionValues = Callable[[Any, torch.Tensor], torch.Tensor]
"""Next observations as the network takes them and augmented actions (n,) → Q(s', o), (n, 1), or (n, quantiles)."""


class Consistency(NamedTuple):
    """The relation of one option to n primitive steps s, a, s'.

    Attributes:
        consistent: π_o(s) = a, (n,).
        inside: s ∈ I, (n,).
        continuation: Probability that the option continues in s': 1 − β(s') if s and s' lie in I, else 0, because
            outside I an option runs for one step, (n,).
    """

    consistent: BoolArray
    inside: BoolArray
    continuation: FloatArray


def consistency_of(
    option: Option, observations: Observations, actions: IntArray, next_observations: Observations
) -> Consistency:
    """The relation of ``option`` to the primitive steps s, a, s'.

    Args:
        option: Its policy must be a function of the observation.
        observations: s, batch of n.
        actions: a, primitive, (n,); no option is consistent with a negative one.
        next_observations: s', batch of n.
    """
    inside = option.initiation(observations)
    ends = np.clip(option.termination(next_observations), 0.0, 1.0)
    continuation = np.where(inside & option.initiation(next_observations), 1.0 - ends, 0.0)
    return Consistency(option.policy(observations) == actions, inside, continuation)


class IntraOptionRows(NamedTuple):
    """Stored primitive steps, each with an option that is consistent with it.

    Attributes:
        rows: Of the replay buffer, (m,).
        slots: Of the options, (m,).
        continuation: Probability that the option continues, (m,).
    """

    rows: npt.NDArray[np.int64]
    slots: npt.NDArray[np.int64]
    continuation: npt.NDArray[np.float32]


class ConsistencyTable:
    """The `Consistency` of all options with all rows of a replay buffer.

    Args:
        size: Rows of the replay buffer.
        n_primitive: Number of primitive actions.
        max_options: Number of slots.
        values: Q(s', o) of the target network; not pickled.
        outside: Whether an option is also updated from steps outside its initiation set, where it runs for one step:
            for algorithms that do not mask and so need its value there.
        quantiles: Whether values are quantiles. A mixture of continuing and ending has no quantiles in closed form, so
            that only steps after which the option surely continues or surely ends are used.
    """

    def __init__(
        self,
        size: int,
        n_primitive: int,
        max_options: int,
        values: OptionValues | None = None,
        *,
        outside: bool = True,
        quantiles: bool = False,
    ) -> None:
        self.n_primitive, self.max_options = n_primitive, max_options
        self.values, self.outside, self.quantiles = values, outside, quantiles
        self.consistent = np.zeros((size, max_options), dtype=bool)
        self.inside = np.zeros((size, max_options), dtype=bool)
        self.continuation = np.zeros((size, max_options), dtype=np.float32)

    def columns(self) -> tuple[npt.NDArray[Any], ...]:
        """Every array with one row per transition."""
        return self.consistent, self.inside, self.continuation

    def clear_rows(self, rows: slice | npt.NDArray[Any]) -> None:
        """Mark rows that were overwritten: no option is consistent with them until `record` says so."""
        self.consistent[rows] = False

    def clear_slot(self, slot: int) -> None:
        """Mark a slot that was emptied: it is consistent with no row."""
        self.consistent[:, slot] = False

    def copy_rows(self, source: npt.NDArray[Any], rows: npt.NDArray[Any]) -> None:
        """Follow the replay buffer, whose ``rows`` are now copies of ``source``."""
        for column in self.columns():
            column[rows] = column[source]

    def record(self, rows: npt.NDArray[Any], slot: int, found: Consistency) -> None:
        """Store the consistency of the option in ``slot`` with ``rows``."""
        certain = np.isin(found.continuation, (0.0, 1.0)) if self.quantiles else True
        self.consistent[rows, slot] = found.consistent & (self.outside | found.inside) & certain
        self.inside[rows, slot] = found.inside
        self.continuation[rows, slot] = found.continuation

    def select(self, rows: npt.NDArray[Any], limit: int) -> IntraOptionRows | None:
        """The pairs of a row and a consistent option, at most ``limit``, those inside an initiation set first.

        The rows of a batch are in random order, so that the first ``limit`` pairs are a uniform sample.

        Args:
            rows: A batch, (n,).
            limit: Most pairs.

        Returns:
            None if there is no pair.
        """
        consistent = self.consistent[rows]
        if self.values is None or limit == 0 or not consistent.any():
            return None
        batch, slots = np.nonzero(consistent)
        stored = rows[batch]
        if len(batch) > limit:
            first = np.argsort(~self.inside[stored, slots], kind="stable")[:limit]
            stored, slots = stored[first], slots[first]
        return IntraOptionRows(stored, slots, self.continuation[stored, slots])

    def as_option_transitions(self, samples: Any, selected: IntraOptionRows) -> Any:
        """Turn the last rows of a batch, the ``selected`` ones, into transitions of their options.

        Args:
            samples: An ``OptionReplayBufferSamples`` whose last rows are primitive steps as they were stored.
            selected: In the order of those rows.

        Returns:
            The samples with actions, rewards and discounts that give `intra_option_target` under the algorithm's
            own R + γ max Q(s', a'). Rewards are (batch, quantiles) where values are quantiles.
        """
        assert self.values is not None  # select() returns None without
        last = slice(len(samples.actions) - len(selected.rows), None)
        device = samples.actions.device
        options = torch.as_tensor(selected.slots, device=device)[:, None] + self.n_primitive
        following = samples.next_observations
        following = {k: v[last] for k, v in following.items()} if isinstance(following, dict) else following[last]
        certain, discounts = intra_option_target(
            samples.rewards[last],
            samples.discounts[last],
            samples.dones[last],
            torch.as_tensor(selected.continuation, device=device)[:, None],
            self.values(following, options[:, 0]),
        )
        as_drawn = samples.rewards[: last.start].expand(-1, certain.shape[1])
        samples.actions[last] = options
        samples.discounts[last] = discounts
        return samples._replace(rewards=torch.cat([as_drawn, certain]))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "values": None}


def intra_option_target(
    rewards: torch.Tensor,
    discounts: torch.Tensor,
    dones: torch.Tensor,
    continuation: torch.Tensor,
    option_values: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The target r + γ U(s', o), split as algorithms expect it: reward, and the discount of max Q(s', a').

    Args:
        rewards: r, (n, 1).
        discounts: γ, (n, 1).
        dones: 1 where nothing follows, (n, 1).
        continuation: 1 − β(s'), (n, 1).
        option_values: Q(s', o), (n, 1) or (n, quantiles).

    Returns:
        r + γ (1 − β) Q(s', o), of the shape of ``option_values``, and γ β, (n, 1).
    """
    return rewards + (1 - dones) * discounts * continuation * option_values, discounts * (1 - continuation)
