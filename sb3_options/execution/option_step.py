"""Runs of options, a primitive step at a time. `OptionsWrapper` steps one run, `OptionsVecEnv` many at once."""

from collections.abc import Collection, Iterable, Sequence
from itertools import groupby
from typing import Any, SupportsFloat, TypeAlias

import numpy as np

from sb3_options.experience.observations import BoolArray, copy_of, stack
from sb3_options.experience.option_run import OptionRun, Termination
from sb3_options.options.bank import Answers, OptionBank

StepReturn: TypeAlias = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]
"""What ``gymnasium.Env.step`` returns: observation, reward, terminated, truncated, info."""


class RunUnderWay:
    """An option that is running, with the primitive steps it has taken.

    Attributes:
        bank: Holds the option in ``slot`` as it was when the run began.
        inside: Whether it began in I. Outside I it runs for one step.
        action: Primitive action of the present step.
        termination: Why the run ended; None while it goes on.
    """

    def __init__(
        self,
        bank: OptionBank,
        slot: int,
        observation: Any,
        gamma: float,
        random: np.random.Generator,
        answers: Answers,
        *,
        inside: bool,
    ) -> None:
        self.bank = bank
        self.slot = slot
        self.gamma = gamma
        self.inside = inside
        self.action = -1
        self.termination: Termination | None = None
        self.observations = [copy_of(observation)]
        self.actions: list[int] = []
        self.rewards: list[float] = []
        self.total = 0.0
        self._discount = 1.0
        self._random = random
        self._answers = answers

    def choose(self) -> int:
        """Return the primitive action of the next step."""
        self.action = self.bank.action(self.slot, self.observations[-1], self._answers)
        return self.action

    def advance(self, reward: SupportsFloat, observation: Any, ended: Termination | None) -> None:
        """Add the step that was taken, and end with the episode, or where the option ends."""
        self._add(reward, observation, ended)
        if ended is None:
            self._arrive(self.bank.answers_at(observation))

    def _add(self, reward: SupportsFloat, observation: Any, ended: Termination | None) -> None:
        self.observations.append(copy_of(observation))
        self.actions.append(self.action)
        self.rewards.append(float(reward))
        self.total += self._discount * self.rewards[-1]
        self._discount *= self.gamma
        self.termination = ended

    def _arrive(self, answers: Answers) -> None:
        """End where β says so, outside I, or after the longest duration, in this order."""
        self._answers = answers
        initiation, beta = self.bank.membership(self.slot, self.observations[-1], answers)
        option = self.bank[self.slot]
        assert option is not None  # the bank keeps it
        if beta >= 1.0 or (beta > 0.0 and self._random.random() < beta):
            self.termination = "subgoal"
        elif not (self.inside and initiation):
            self.termination = "left_initiation"
        elif len(self.actions) >= option.max_duration:
            self.termination = "max_duration"

    def keep(self, bank: OptionBank) -> None:
        """Go on with the option that ``bank`` holds."""
        self.bank = bank
        self._answers = bank.answers_at(self.observations[-1])

    def ended(self, available: BoolArray | None) -> OptionRun:
        """Return the record of the run, with the slots that are ``available`` in the k observations arrived in."""
        assert self.termination is not None
        return OptionRun(
            self.slot,
            len(self.actions),
            self._discount,
            self.gamma,
            self.termination,
            stack(self.observations[:-1]),
            np.array(self.actions),
            np.array(self.rewards),
            available,
            self.inside,
        )


def begin(
    bank: OptionBank,
    slots: Sequence[int],
    observations: Sequence[Any],
    gamma: float,
    random: Sequence[np.random.Generator],
) -> list[RunUnderWay]:
    """Begin a run of the option in each slot."""
    answers = bank.answers(observations)
    each = zip(slots, observations, random, answers, bank.may_start(slots, observations, answers), strict=True)
    return [RunUnderWay(bank, slot, at, gamma, draws, known, inside=inside) for slot, at, draws, known, inside in each]


def choose_all(runs: Collection[RunUnderWay]) -> list[int]:
    """Return the primitive action of each run, with one call of each policy for all observations that are new to it."""
    for bank, group in _by_bank(runs):
        bank.compute_actions(*_of(group, [run._answers for run in group]))
    return [run.choose() for run in runs]


def advance_all(
    runs: Sequence[RunUnderWay],
    rewards: Sequence[SupportsFloat],
    observations: Sequence[Any],
    ended: Sequence[Termination | None],
) -> None:
    """Advance each run, with one call of φ, I and β for all observations that are new to them."""
    for run, reward, observation, why in zip(runs, rewards, observations, ended, strict=True):
        run._add(reward, observation, why)
    for bank, group in _by_bank(run for run in runs if run.termination is None):
        answers = bank.answers([run.observations[-1] for run in group])
        bank.compute_memberships(*_of(group, answers))
        for run, known in zip(group, answers, strict=True):
            run._arrive(known)


def _of(runs: Sequence[RunUnderWay], answers: list[Answers]) -> tuple[list[int], list[Any], list[Answers]]:
    return [run.slot for run in runs], [run.observations[-1] for run in runs], answers


def _by_bank(runs: Iterable[RunUnderWay]) -> list[tuple[OptionBank, list[RunUnderWay]]]:
    """Return the runs of each bank: some may go on with options that were replaced."""
    groups = [list(group) for _, group in groupby(runs, key=lambda run: id(run.bank))]
    return [(group[0].bank, group) for group in groups]
