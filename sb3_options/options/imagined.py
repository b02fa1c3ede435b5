"""Imagines steps that nobody took: an action that moves a nearby thing by one cell does so farther away, too."""

from collections import Counter, defaultdict
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.experience.observations import BoolArray, FloatArray, flatten
from sb3_options.options.policies import TabularPolicy
from sb3_options.options.settings import OptionLearningSettings
from sb3_options.options.tasks import STEP_REWARD, Transitions

LEAST_STEPS = 20  # least saved steps of an action in a context; fewer show no rule
LEAST_SHARE = 0.9  # least share of these with the commonest displacement
MOST_POINTS = 2000  # at most this many are imagined


class Displacement(NamedTuple):
    """Effect of an action on the coordinates (c,) in a context: the other features before and after it (k − c,)."""

    action: int
    context: FloatArray
    move: FloatArray


def imagined_farther(
    initiation: Region, transitions: Transitions, policy: TabularPolicy, settings: OptionLearningSettings
) -> tuple[Region, TabularPolicy]:
    """Extend I and the policy by imagined steps to states that nobody visited, or return them unchanged.

    Small rooms show only nearby states. But if an action displaces a visible thing, it does so by the same vector
    wherever the thing is, as long as the other features stay the same. (They are the context: what is visible, whether
    the cell ahead is free.) So the search goes backwards from each state of I to unseen states, along displacements
    that nearly all saved steps agree on. An action there is worth as much as the best known way on from it:
    Q(s, a) = r + γ max Q(s', ·), in sweeps until nothing improves. This is planning with a model in the manner of
    linear Dyna (Sutton, Szepesvári, Geramifard & Bowling 2008), and the model is that displacement. Seen states stay as
    they are. As many steps are imagined as a run of the option may last.
    """
    group = initiation.group
    if group is None or not group.coordinates or not len(initiation.points):
        return initiation, policy
    moving = np.isin(group.features, group.coordinates)
    rules = displacements(transitions, moving)
    states = flatten(transitions.states) + 0.0
    seen = {state.tobytes() for state in states} | {point.tobytes() for point in initiation.points + 0.0}
    imagined: dict[bytes, tuple[FloatArray, FloatArray]] = {}  # points, and values of actions as far as they are known
    front = list(zip(initiation.points + 0.0, policy.best_values(initiation.points).tolist(), strict=True))
    for _ in range(settings.max_duration):
        better: dict[bytes, FloatArray] = {}
        for led, best in front:
            for rule in rules:
                if not np.array_equal(led[~moving], rule.context):
                    continue
                before = led.copy()
                before[moving] = led[moving] - rule.move + 0.0
                key = before.tobytes()
                value = STEP_REWARD + settings.gamma * best
                if key in seen or (key not in imagined and len(imagined) == MOST_POINTS):
                    continue
                _, values = imagined.setdefault(key, (before, np.full(policy.values.shape[1], -np.inf)))
                if value > values.max():
                    better[key] = before
                values[rule.action] = max(values[rule.action], value)
        front = [(point, float(imagined[key][1].max())) for key, point in better.items()]
    if not imagined:
        return initiation, policy
    points, new = (np.array(column) for column in zip(*imagined.values(), strict=True))
    table = TabularPolicy(np.concatenate([policy.states, points]), np.concatenate([policy.values, new]))
    return replace(initiation, points=np.concatenate([initiation.points, points])), table


def displacements(transitions: Transitions, moving: BoolArray) -> list[Displacement]:
    """Return the rules that nearly all saved steps agree on; ``moving`` says which features are coordinates, (k,)."""
    states = flatten(transitions.states) + 0.0
    sizes = len(states), int(transitions.actions.max()) + 1, len(states)
    steps = np.ravel_multi_index((transitions.began, transitions.actions, transitions.led), sizes)
    distinct, counts = np.unique(steps, return_counts=True)
    moves: dict[tuple[int, bytes], Counter[bytes]] = defaultdict(Counter)
    for began, action, led, count in zip(*np.unravel_index(distinct, sizes), counts, strict=True):
        move = states[led][moving] - states[began][moving] + 0.0
        moves[int(action), states[began][~moving].tobytes()][move.tobytes()] += int(count)
    rules = []
    for (action, context), seen in moves.items():
        [(commonest, n)] = seen.most_common(1)
        move = np.frombuffer(commonest)
        if seen.total() >= LEAST_STEPS and n >= LEAST_SHARE * seen.total() and move.any():
            rules.append(Displacement(action, np.frombuffer(context), move))
    return rules
