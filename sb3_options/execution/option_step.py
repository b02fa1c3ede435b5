"""An option from its start to its end: one step of a semi-Markov decision process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, SupportsFloat, TypeAlias

import numpy as np

from sb3_options.experience.observations import BoolArray, Observations, batch_of_one, copy_of, stack
from sb3_options.experience.option_run import OptionRun, Termination
from sb3_options.options.option import Option

StepReturn: TypeAlias = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]
"""What ``gymnasium.Env.step`` returns: observation, reward, terminated, truncated, info."""


def run_option(
    option: Option,
    slot: int,
    observation: Any,
    step: Callable[[int], StepReturn],
    *,
    inside: bool,
    available: Callable[[Observations], BoolArray] | None,
    n_primitive: int,
    gamma: float,
    random: np.random.Generator,
    legal: Callable[[], BoolArray | None],
) -> tuple[StepReturn, OptionRun]:
    """Run an option until the episode, β, I, or its longest duration ends it, asked in this order.

    It also ends, as if it had left I, where the environment masks the primitive action that it would take next:
    ``legal`` says which may be taken now. Outside I it runs for one step. ``available`` says which slots may start in
    the k observations arrived in, for the record.

    Returns what the last step returned, with Σ γⁱ rᵢ in the place of its reward, and the record of the run.
    """
    total, discount = 0.0, 1.0
    observations: list[Any] = [copy_of(observation)]
    actions: list[int] = []
    rewards: list[float] = []
    termination: Termination | None = None
    action = primitive_of(option, observations[-1], n_primitive)
    while termination is None:
        observation, reward, terminated, truncated, info = step(action)
        observations.append(copy_of(observation))
        actions.append(action)
        rewards.append(float(reward))
        total += discount * rewards[-1]
        discount *= gamma
        if terminated:
            termination = "terminated"
        elif truncated:
            termination = "truncated"
        else:
            termination = _why_ended(option, observation, len(actions), random, inside=inside)
        if termination is None:
            action = primitive_of(option, observations[-1], n_primitive)
            mask = legal()
            if mask is not None and not mask[action]:
                termination = "left_initiation"
    run = OptionRun(
        slot,
        len(actions),
        discount,
        gamma,
        termination,
        stack(observations[:-1]),
        np.array(actions),
        np.array(rewards),
        None if available is None else available(stack(observations[1:])),
        inside,
    )
    return (observation, total, terminated, truncated, info), run


def primitive_of(option: Option, observation: Any, n_primitive: int) -> int:
    """The primitive action that an option's policy takes."""
    action = int(option.policy(batch_of_one(observation))[0])
    if not 0 <= action < n_primitive:
        raise ValueError(
            f"The policy of option {option.name!r} chose {action}; primitive actions are 0 to {n_primitive - 1}."
        )
    return action


def _why_ended(
    option: Option, observation: Any, duration: int, random: np.random.Generator, *, inside: bool
) -> Termination | None:
    batch = batch_of_one(observation)
    probability = float(option.termination(batch)[0])
    if probability >= 1.0 or (probability > 0.0 and random.random() < probability):
        return "subgoal"
    if not (inside and option.initiation(batch)[0]):
        return "left_initiation"
    return "max_duration" if duration >= option.max_duration else None
