"""Steps that nobody took: an action that moves a thing by one cell near it does so farther away, too."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.experience.observations import BoolArray, FloatArray, flatten
from sb3_options.options.policies import TabularPolicy
from sb3_options.options.settings import OptionLearningSettings
from sb3_options.options.tasks import Transitions

LEAST_STEPS = 20
"""Saved steps of an action in a context; fewer show no rule."""

LEAST_SHARE = 0.9
"""Of these, what the commonest displacement must have."""

MOST_POINTS = 2000
"""More are not imagined."""


class Displacement(NamedTuple):
    """What an action does to the coordinates, whatever they are.

    Attributes:
        action: Primitive.
        context: The other features, before it and after it, (k − c,).
        move: What it adds to the coordinates, (c,).
    """

    action: int
    context: FloatArray
    move: FloatArray


def imagined_farther(
    initiation: Region, transitions: Transitions, policy: TabularPolicy, settings: OptionLearningSettings
) -> tuple[Region, TabularPolicy]:
    """I and policy, extended to where nobody was by imagined steps.

    Small rooms show what is near. But where an action displaces a thing that is seen, it does so by the same vector
    wherever the thing is, as long as the other features (the context: what is visible, whether the cell ahead is free)
    stay what they were. So from each state of I one goes backwards, along the displacements that nearly all saved steps
    agree on, to states that were never seen, as many steps as a run of the option may last. This is planning with a
    model in the manner of linear Dyna (Sutton, Szepesvári, Geramifard & Bowling 2008); the model is that displacement.
    States that were seen are left as they are.

    Args:
        initiation: I, on a group of features with ``coordinates``; with others nothing is imagined.
        transitions: Of the option's own task.
        policy: A table, learned from them.
        settings: ``max_duration``, ``step_reward`` and ``gamma`` are used.

    Returns:
        I and the policy; the same ones where nothing is to be imagined.
    """
    group = initiation.group
    if group is None or not group.coordinates or not len(initiation.points):
        return initiation, policy
    moving = np.isin(group.features, group.coordinates)
    rules = displacements(transitions, moving)
    seen = {state.tobytes() for state in (flatten(transitions.states) + 0.0)}
    seen |= {point.tobytes() for point in initiation.points + 0.0}
    points: dict[bytes, FloatArray] = {}
    values: list[FloatArray] = []
    front = list(zip(initiation.points + 0.0, policy.best_values(initiation.points), strict=True))
    for _ in range(settings.max_duration):
        later, front = front, []
        for rule in rules:
            for point, value in later:
                if not np.array_equal(point[~moving], rule.context):
                    continue
                before = point.copy()
                before[moving] = point[moving] - rule.move + 0.0
                key = before.tobytes()
                if key in seen or key in points or len(points) == MOST_POINTS:
                    continue
                points[key] = before
                front.append((before, settings.step_reward + settings.gamma * value))
                values.append(np.full(policy.values.shape[1], -np.inf))
                values[-1][rule.action] = front[-1][1]
    if not points:
        return initiation, policy
    new = np.array(list(points.values()))
    table = TabularPolicy(np.concatenate([policy.states, new]), np.concatenate([policy.values, values]))
    return replace(initiation, points=np.concatenate([initiation.points, new])), table


def displacements(transitions: Transitions, moving: BoolArray) -> list[Displacement]:
    """The rules that nearly all saved steps agree on.

    Args:
        transitions: Of the option's own task, on its features.
        moving: Which of these are coordinates, (k,).
    """
    states = flatten(transitions.states) + 0.0
    steps = np.stack([transitions.began, transitions.actions, transitions.led], axis=1)
    distinct, counts = np.unique(steps, axis=0, return_counts=True)
    moves: dict[tuple[int, bytes], Counter[bytes]] = defaultdict(Counter)
    for (began, action, led), count in zip(distinct, counts, strict=True):
        move = states[led][moving] - states[began][moving] + 0.0
        moves[int(action), states[began][~moving].tobytes()][move.tobytes()] += int(count)
    rules = []
    for (action, context), seen in moves.items():
        [(commonest, n)] = seen.most_common(1)
        move = np.frombuffer(commonest)
        if seen.total() >= LEAST_STEPS and n >= LEAST_SHARE * seen.total() and move.any():
            rules.append(Displacement(action, np.frombuffer(context), move))
    return rules
