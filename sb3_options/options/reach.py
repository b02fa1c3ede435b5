"""Estimates from where an option's policy reaches its subgoal, by the saved steps."""

from dataclasses import replace

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.experience.observations import BoolArray, FloatArray, flatten
from sb3_options.options.policies import TabularPolicy
from sb3_options.options.tasks import SUBGOAL_REWARD, Transitions

IMAGINED_FAILURES = 1.0  # failing steps besides the seen ones of each state and action: few of these promise little


def reach_probabilities(
    transitions: Transitions, policy: TabularPolicy, *, steps: int, inside: BoolArray | None = None
) -> FloatArray:
    """Return the probability of reaching the subgoal within ``steps``, for each of ``transitions.states``, (m,).

    The saved steps in which the policy's action was taken make a Markov chain: P(s) = Σ P(s') / (n + 1) over the n
    steps from s, with P = 1 at the subgoal and 0 where the option ends. The 1 is a step that fails
    (``IMAGINED_FAILURES``). The option goes on in the states ``inside``, (m,), by default in all.
    """
    chosen = policy.actions(transitions.states)
    taken = chosen[transitions.began] == transitions.actions
    began, led, ends = transitions.began[taken], transitions.led[taken], transitions.ends[taken]
    reached = ends & (transitions.rewards[taken] == SUBGOAL_REWARD)
    goes_on = ~ends if inside is None else ~ends & inside[led]
    m = len(chosen)
    seen = np.bincount(began, minlength=m) + IMAGINED_FAILURES
    probability = np.zeros(m)
    for _ in range(steps):
        follows = np.where(reached, 1.0, goes_on * probability[led])
        probability = np.bincount(began, weights=follows, minlength=m) / seen
    return probability


def reliable_part(
    initiation: Region, transitions: Transitions, policy: TabularPolicy, *, least: float, steps: int
) -> Region:
    """Return the states of an initiation set that reach the subgoal often enough without leaving them.

    On a few features, states that look the same may differ: a step ahead leads to a door, or nowhere, because of a wall
    that the features do not show. A policy that is greedy in these features then stays where it is.
    """
    states = flatten(transitions.states) + 0.0  # -0.0 and 0.0 are one state
    inside = np.ones(len(states), dtype=bool)
    while True:
        probability = reach_probabilities(transitions, policy, steps=steps, inside=inside)
        still = inside & (probability >= least)
        if still.sum() == inside.sum():
            break
        inside = still
    known = {state.tobytes() for state in states[inside]}
    kept = [(point + 0.0).tobytes() in known for point in initiation.points]
    return replace(initiation, points=initiation.points[np.array(kept, dtype=bool)])
