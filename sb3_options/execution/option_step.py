"""A run of an option that is under way, and why it ends; `OptionsWrapper` and `OptionsVecEnv` both use these."""

from typing import Any, SupportsFloat, TypeAlias

import numpy as np

from sb3_options.experience.observations import BoolArray, copy_of, stack
from sb3_options.experience.option_run import OptionRun, Termination

StepReturn: TypeAlias = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]
"""What ``gymnasium.Env.step`` returns: observation, reward, terminated, truncated, info."""


class RunUnderWay:
    """An option that is running, with the primitive steps it has taken."""

    def __init__(self, slot: int, observation: Any, gamma: float, *, inside: bool) -> None:
        self.slot = slot
        self.gamma = gamma
        self.inside = inside
        self.observations = [copy_of(observation)]
        self.actions: list[int] = []
        self.rewards: list[float] = []
        self.total = 0.0
        self.discount = 1.0

    def add(self, action: int, reward: SupportsFloat, observation: Any) -> None:
        """Add a primitive step that led to ``observation``."""
        self.observations.append(copy_of(observation))
        self.actions.append(action)
        self.rewards.append(float(reward))
        self.total += self.discount * self.rewards[-1]
        self.discount *= self.gamma

    def ended(self, termination: Termination, available: BoolArray | None) -> OptionRun:
        """Return the record of the run, with the slots that are ``available`` in the k observations arrived in."""
        return OptionRun(
            self.slot,
            len(self.actions),
            self.discount,
            self.gamma,
            termination,
            stack(self.observations[:-1]),
            np.array(self.actions),
            np.array(self.rewards),
            available,
            self.inside,
        )


def why_ended(
    duration: int, max_duration: int, probability: float, random: np.random.Generator, *, goes_on: bool
) -> Termination | None:
    """Return why a run ends after ``duration`` steps, where β is ``probability``, or None if it goes on."""
    if probability >= 1.0 or (probability > 0.0 and random.random() < probability):
        return "subgoal"
    if not goes_on:
        return "left_initiation"
    return "max_duration" if duration >= max_duration else None
