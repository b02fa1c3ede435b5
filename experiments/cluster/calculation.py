"""What many machines would give, worked out from what one machine was measured to do."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sb3_options.experience.observations import FloatArray

N_DRAWS = 200
"""Steps that are drawn to find how long the slowest actor takes."""


@dataclass(frozen=True)
class Assumptions:
    """What the calculation rests on. Times are of the processor: other work on the machine does not lengthen them.

    Attributes:
        cores: Of a machine, each with one actor; as fast as the one that was measured.
        round_trip: Seconds of the network, once in each step: actors are asked at the same time.
        step: Mean seconds of a step of one environment.
        call: Seconds that the process that learns takes for each actor in each step, one after the other.
        learn: Seconds that it takes to learn from a step of one environment.
        task: Seconds that the driver of a study takes for each part and seed, one after the other.
    """

    cores: int
    round_trip: float
    step: float
    call: float
    learn: float
    task: float


def slope(seconds: dict[int, list[float]]) -> float:
    """Seconds that each further actor adds to a step, by least squares over the medians; at least 1 µs."""
    actors = sorted(seconds)
    return max(1e-6, float(np.polyfit(actors, [float(np.median(seconds[n])) for n in actors], 1)[0]))


def environments(
    machines: int, per_actor: int, told: Assumptions, steps: FloatArray, random: np.random.Generator
) -> dict[str, Any]:
    """Steps per second of a `RayVecEnv` on many machines.

    A step of all environments takes::

        max over actors of (sum of its environments' steps) + round trip + actors · call + environments · learn

    Its first term is the mean over draws from ``steps``; the learner waits for the slowest actor.

    Args:
        machines: How many.
        per_actor: Environments of an actor.
        told: The assumptions.
        steps: Seconds of single steps, to draw from.
        random: Draws.
    """
    actors = machines * told.cores
    n = actors * per_actor
    sums = random.choice(steps, size=(N_DRAWS, actors, per_actor)).sum(axis=-1)
    slowest = float(sums.max(axis=-1).mean())
    acting = slowest + told.round_trip + actors * told.call
    alone = told.cores / told.step
    return {
        "machines": machines,
        "actors": actors,
        "environments": n,
        "slowest_actor_s": slowest,
        "steps_per_second": n / acting,
        "times_one_machine": n / acting / alone,
        "steps_per_second_with_learning": n / (acting + n * told.learn),
    }


def study(machines: int, n_parts: int, hours: float, told: Assumptions) -> dict[str, Any]:
    """Hours of a study whose parts take equally long.

    Args:
        machines: How many.
        n_parts: Parts times seeds.
        hours: Of one.
        told: The assumptions.
    """
    rounds = math.ceil(n_parts / (machines * told.cores))
    return {"machines": machines, "n": n_parts, "hours": rounds * hours + n_parts * told.task / 3600}


def as_json(told: Assumptions) -> dict[str, Any]:
    """The assumptions by name."""
    return asdict(told)
