"""Intra-option learning: what one primitive step teaches the options that would have taken it.

After a step s, a, r, s' every option o with π_o(s) = a moves towards

    r + γ U(s', o),   U(s', o) = (1 − β(s')) Q(s', o) + β(s') max Q(s', a')

(one-step intra-option Q-learning; Sutton, Precup & Singh 1999, §6). It needs no importance weights: option policies
are functions of the observation, so that the step either is the one the option would have taken, and then its reward
and successor are drawn as under the option, or it is not, and then nothing is learned from it. The algorithm calls for
Markov options, so the longest duration, which is a property of the run and not of the state, does not enter. For the
same reason a hand-made option whose policy draws at random or remembers must not be taught.
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


class Judgement(NamedTuple):
    """What an option says of primitive steps.

    Attributes:
        takes: π_o(s) = a, (n,).
        inside: s ∈ I, (n,).
        goes_on: Probability that the option goes on in s': 1 − β(s') if s and s' lie in I, else 0, (n,). Outside I an
            option runs for one step.
    """

    takes: BoolArray
    inside: BoolArray
    goes_on: FloatArray


def judge(option: Option, observations: Observations, actions: IntArray, next_observations: Observations) -> Judgement:
    """What ``option`` says of the primitive steps s, a, s'.

    Args:
        option: Whose policy is a function of the observation.
        observations: s, batch of n.
        actions: a, primitive, (n,); a negative one is taken by no option.
        next_observations: s', batch of n.
    """
    inside = option.initiation(observations)
    ends = np.clip(option.termination(next_observations), 0.0, 1.0)
    goes_on = np.where(inside & option.initiation(next_observations), 1.0 - ends, 0.0)
    return Judgement(option.policy(observations) == actions, inside, goes_on)


class Lessons(NamedTuple):
    """Primitive steps that teach options.

    Attributes:
        rows: Stored transitions, (m,).
        slots: The option that each teaches, (m,).
        goes_on: Probability that it goes on, (m,).
    """

    rows: npt.NDArray[np.int64]
    slots: npt.NDArray[np.int64]
    goes_on: npt.NDArray[np.float32]


class IntraOptionMemory:
    """The judgements of all options on all stored transitions.

    Args:
        size: Rows of the replay buffer.
        n_primitive: Number of primitive actions.
        max_options: Number of slots.
        values: Q(s', o) of the target network; it does not travel in files.
        outside: Whether an option also learns from steps outside its initiation set, where it runs for one step: so
            that an algorithm that cannot mask knows what it is worth there.
        quantiles: Whether values are quantiles. A mixture of going on and ending has none that could be written down,
            so that only steps after which an option surely goes on or surely ends teach it.
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
        self.takes = np.zeros((size, max_options), dtype=bool)
        self.inside = np.zeros((size, max_options), dtype=bool)
        self.goes_on = np.zeros((size, max_options), dtype=np.float32)

    def forget(self, rows: slice | npt.NDArray[Any]) -> None:
        """These rows hold other transitions now, on which nobody has judged."""
        self.takes[rows] = False

    def forget_option(self, slot: int) -> None:
        """Nothing is taught to ``slot`` any more."""
        self.takes[:, slot] = False

    def copy(self, source: npt.NDArray[Any], rows: npt.NDArray[Any]) -> None:
        """``rows`` hold what ``source`` holds."""
        for column in (self.takes, self.inside, self.goes_on):
            column[rows] = column[source]

    def note(self, rows: npt.NDArray[Any], slot: int, judgement: Judgement) -> None:
        """Keep what the option in ``slot`` says of these rows."""
        certain = np.isin(judgement.goes_on, (0.0, 1.0)) if self.quantiles else True
        self.takes[rows, slot] = judgement.takes & (self.outside | judgement.inside) & certain
        self.inside[rows, slot] = judgement.inside
        self.goes_on[rows, slot] = judgement.goes_on

    def lessons(self, rows: npt.NDArray[Any], limit: int) -> Lessons | None:
        """What these rows teach, at most ``limit`` lessons, those inside an initiation set first.

        The rows of a batch come in random order, so that the first ``limit`` of them are drawn evenly.

        Args:
            rows: A batch, (n,).
            limit: Most lessons.

        Returns:
            None if they teach nothing.
        """
        takes = self.takes[rows]
        if self.values is None or limit == 0 or not takes.any():
            return None
        batch, slots = np.nonzero(takes)
        stored = rows[batch]
        if len(batch) > limit:
            first = np.argsort(~self.inside[stored, slots], kind="stable")[:limit]
            stored, slots = stored[first], slots[first]
        return Lessons(stored, slots, self.goes_on[stored, slots])

    def teach(self, samples: Any, lessons: Lessons) -> Any:
        """Turn the last rows of a batch, which are those of ``lessons``, into transitions of the options they teach.

        Args:
            samples: An ``OptionReplayBufferSamples`` whose last rows are primitive steps as they were stored.
            lessons: In the order of those rows.

        Returns:
            The samples with actions, rewards and discounts that give `intra_option_target` under the algorithm's
            own R + γ max Q(s', a'). Rewards are (batch, quantiles) where values are quantiles.
        """
        assert self.values is not None  # there are no lessons without
        taught = slice(len(samples.actions) - len(lessons.rows), None)
        device = samples.actions.device
        options = torch.as_tensor(lessons.slots, device=device)[:, None] + self.n_primitive
        following = samples.next_observations
        following = {k: v[taught] for k, v in following.items()} if isinstance(following, dict) else following[taught]
        certain, discounts = intra_option_target(
            samples.rewards[taught],
            samples.discounts[taught],
            samples.dones[taught],
            torch.as_tensor(lessons.goes_on, device=device)[:, None],
            self.values(following, options[:, 0]),
        )
        as_drawn = samples.rewards[: taught.start].expand(-1, certain.shape[1])
        samples.actions[taught] = options
        samples.discounts[taught] = discounts
        return samples._replace(rewards=torch.cat([as_drawn, certain]))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "values": None}


def intra_option_target(
    rewards: torch.Tensor,
    discounts: torch.Tensor,
    dones: torch.Tensor,
    goes_on: torch.Tensor,
    option_values: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The target r + γ U(s', o), split as algorithms expect it: what is certain, and the discount of max Q(s', a').

    Args:
        rewards: r, (n, 1).
        discounts: γ, (n, 1).
        dones: 1 where nothing follows, (n, 1).
        goes_on: 1 − β(s'), (n, 1).
        option_values: Q(s', o), (n, 1) or (n, quantiles).

    Returns:
        r + γ (1 − β) Q(s', o), of the shape of ``option_values``, and γ β, (n, 1).
    """
    return rewards + (1 - dones) * discounts * goes_on * option_values, discounts * (1 - goes_on)
