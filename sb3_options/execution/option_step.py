"""Runs of options, a primitive step at a time. `OptionsWrapper` steps one run, `OptionsVecEnv` many at once."""

from collections.abc import Collection, Iterable, Sequence
from typing import Any, SupportsFloat, TypeAlias

import numpy as np

from sb3_options.experience.observations import BoolArray, copy_of, stack
from sb3_options.experience.option_run import OptionRun, Termination
from sb3_options.options.bank import OptionBank, checked_actions
from sb3_options.options.option import Option

StepReturn: TypeAlias = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]
"""What ``gymnasium.Env.step`` returns: observation, reward, terminated, truncated, info."""


class RunUnderWay:
    """An option that is running, with the primitive steps it has taken.

    Attributes:
        action: Primitive action of the present step.
        termination: Why the run ended; None while it goes on.
    """

    def __init__(
        self, slot: int, option: Option, observation: Any, gamma: float, random: np.random.Generator, *, inside: bool
    ) -> None:
        self.slot = slot
        self.option = option
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

    def choose(self, bank: OptionBank) -> int:
        """Set and return the primitive action of the next step; ``bank`` holds the option in its slot."""
        self.action = bank.action(self.slot, self.observations[-1])
        return self.action

    def advance(
        self, bank: OptionBank, reward: SupportsFloat, observation: Any, ended: Termination | None = None
    ) -> None:
        """Add the step that was taken. The run ends if the episode ``ended``, else as `RunUnderWay.arrive` says."""
        self.add(reward, observation, ended)
        if ended is None:
            self.arrive(*bank.membership(self.slot, self.observations[-1]))

    def add(self, reward: SupportsFloat, observation: Any, ended: Termination | None) -> None:
        """Add the step that was taken, and why the episode ended, if it did."""
        self.observations.append(copy_of(observation))
        self.actions.append(self.action)
        self.rewards.append(float(reward))
        self.total += self._discount * self.rewards[-1]
        self._discount *= self.gamma
        self.termination = ended

    def arrive(self, initiation: bool, beta: float) -> None:
        """End the run by β, outside I, or after the longest duration, in this order; outside I it takes one step."""
        if beta >= 1.0 or (beta > 0.0 and self._random.random() < beta):
            self.termination = "subgoal"
        elif not (self.inside and initiation):
            self.termination = "left_initiation"
        elif len(self.actions) >= self.option.max_duration:
            self.termination = "max_duration"

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


def choose_all(bank: OptionBank, runs: Collection[RunUnderWay]) -> list[int]:
    """Set and return the primitive actions of runs, whose options ``bank`` may hold no longer."""
    for option, group in _by_option(runs):
        if bank.looks_up(group[0].slot, option, len(group)):
            for run in group:
                run.choose(bank)
        else:
            actions = option.policy(stack([run.observations[-1] for run in group]))
            for run, action in zip(group, checked_actions(option, actions, bank.n_primitive).tolist(), strict=True):
                run.action = action
    return [run.action for run in runs]


def advance_all(
    bank: OptionBank,
    runs: Sequence[RunUnderWay],
    rewards: Sequence[SupportsFloat],
    observations: Sequence[Any],
    ended: Sequence[Termination | None],
) -> None:
    """Advance runs, whose options ``bank`` may hold no longer."""
    for run, reward, observation, why in zip(runs, rewards, observations, ended, strict=True):
        run.add(reward, observation, why)
    for option, group in _by_option(run for run in runs if run.termination is None):
        if bank.looks_up(group[0].slot, option, len(group)):
            for run in group:
                run.arrive(*bank.membership(run.slot, run.observations[-1]))
        else:
            initiation, beta = option.membership(stack([run.observations[-1] for run in group]))
            for run, *membership in zip(group, initiation.tolist(), beta.tolist(), strict=True):
                run.arrive(*membership)


def _by_option(runs: Iterable[RunUnderWay]) -> list[tuple[Option, list[RunUnderWay]]]:
    """Return the runs of each option; one that was replaced may run beside the later one."""
    groups: dict[int, list[RunUnderWay]] = {}
    for run in runs:
        groups.setdefault(id(run.option), []).append(run)
    return [(group[0].option, group) for group in groups.values()]
