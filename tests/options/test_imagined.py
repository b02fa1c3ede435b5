"""Imagined steps, worked out by hand on a thing that comes nearer by 1 with each step ahead."""

from collections.abc import Sequence

import numpy as np
import pytest

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.experience.observations import FloatArray
from sb3_options.options.imagined import LEAST_STEPS, MOST_POINTS, displacements, imagined_farther
from sb3_options.options.policies import TabularPolicy
from sb3_options.options.settings import OptionLearningSettings
from sb3_options.options.tasks import Transitions
from tests.options.test_reach import repeated

TURN, AHEAD = 0, 1
# Of all features: visible, forward, lateral, free ahead; a thing is seen at (forward, lateral).
GROUP = FeatureGroup("thing", [2, 5, 3, 4], present=[[2]], scale=[10, 1, 1, 10], coordinates=[5, 3])
MOVING = np.array([False, True, True, False])
SETTINGS = OptionLearningSettings(max_duration=4, gamma=0.5)

STATES = np.array(
    [
        [1, 1, 0, 1],  # the subgoal
        [1, 2, 0, 1],
        [1, 2, 1, 1],
        [1, 2, 1, 0],  # something is in the way
        [1, 3, 0, 1],
    ],
    dtype=np.float64,
)


def steps(*taken: tuple[int, int, int, int], states: FloatArray = STATES, ends: Sequence[int] = (0,)) -> Transitions:
    """Each (began, action, led, how often), as rows of the states."""
    began, actions, led = repeated(*taken)
    return Transitions(states, began, actions, np.zeros(len(began)), led, np.isin(led, ends))


AHEAD_IS_NEARER = steps((1, AHEAD, 0, 19), (4, AHEAD, 1, 5), (2, TURN, 3, 30), (3, AHEAD, 3, 30))


def extended(points: FloatArray, values: FloatArray, transitions: Transitions) -> tuple[Region, TabularPolicy]:
    initiation = Region(points, np.array(GROUP.scale), 0.5, group=GROUP)
    return imagined_farther(initiation, transitions, TabularPolicy(points, values), SETTINGS)


def from_rows(rows: list[int], transitions: Transitions) -> tuple[Region, TabularPolicy]:
    """Only a step ahead is known of these states, and is worth less from each to the next."""
    return extended(STATES[rows], np.array([[-np.inf, -float(i)] for i in range(len(rows))]), transitions)


def test_a_step_ahead_brings_nearer_in_its_context_only() -> None:
    (rule,) = displacements(AHEAD_IS_NEARER, MOVING)
    assert (rule.action, rule.context.tolist(), rule.move.tolist()) == (AHEAD, [1, 1], [-1, 0])


def test_the_initiation_set_goes_on_where_nobody_was() -> None:
    region, table = from_rows([1, 4], AHEAD_IS_NEARER)
    new = region.points[2:]
    assert new.tolist() == [[1, f, 0, 1] for f in (4, 5, 6, 7)]
    assert region.points[:2].tolist() == STATES[[1, 4]].tolist()
    assert table.actions(new).tolist() == [AHEAD] * 4
    # The value of (3, 0) is -1, and each step before it costs 1.
    expected = [-1 + 0.5 * -1, -1 + 0.5 * -1.5, -1 + 0.5 * -1.75, -1 + 0.5 * -1.875]
    assert table.best_values(new).tolist() == expected
    features = np.zeros((3, 6))
    features[:, [2, 5, 3, 4]] = [[1, 6, 0, 1], [1, 6, 0, 0], [1, 6, 1, 1]]
    assert region.contains(features).tolist() == [True, False, False]


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0]])
def test_of_two_ways_the_better_one_is_taken(order: list[int]) -> None:
    """From (3, 0) ahead leads to what is worth -2, sideways to what is worth -9, whichever is found first."""
    states = np.array([[1, 1, 0, 1], [1, 1, 1, 1], [1, 2, 0, 1], [1, 3, 1, 1], [1, 2, 1, 1]], dtype=np.float64)
    saved = [(2, AHEAD, 0, 40), (4, AHEAD, 1, 40), (3, AHEAD, 4, 40), (2, TURN, 4, 40)]
    transitions = steps(*saved, states=states, ends=(0, 1))
    values = np.array([[-np.inf, -2.0], [-np.inf, -9.0], [-np.inf, -8.0]])  # of (2, 0), (3, 1) and (2, 1)
    region, table = extended(states[[2, 3, 4]][order], values[order], transitions)
    there = np.array([[1.0, 3.0, 0.0, 1.0]])
    assert there[0].tolist() in region.points.tolist()
    assert table.actions(there).tolist() == [AHEAD]
    (row,) = np.flatnonzero((table.states == there).all(axis=1))
    assert table.values[row].tolist() == [-1 + 0.5 * -9, -1 + 0.5 * -2]


@pytest.mark.parametrize(
    "transitions",
    [
        steps((1, AHEAD, 0, LEAST_STEPS - 2), (4, AHEAD, 1, 1)),  # too few
        steps((1, AHEAD, 0, 70), (1, AHEAD, 1, 30)),  # it may fail
        steps((3, AHEAD, 3, 100)),  # it never leads anywhere
    ],
    ids=["few", "unsure", "still"],
)
def test_nothing_is_imagined_without_a_rule(transitions: Transitions) -> None:
    assert displacements(transitions, MOVING) == []
    assert len(from_rows([1, 4], transitions)[0].points) == 2


def test_states_that_were_seen_stay_out() -> None:
    """(3, 0) was seen and is not in I: runs from there did not get to the subgoal. So nothing goes on behind it."""
    assert len(from_rows([1], AHEAD_IS_NEARER)[0].points) == 1


def test_there_is_a_limit() -> None:
    lateral = np.arange(MOST_POINTS / 2)
    points: FloatArray = np.stack([np.ones_like(lateral), lateral * 0 + 9, lateral, np.ones_like(lateral)], axis=1)
    region, _ = extended(points, np.zeros((len(points), 2)), AHEAD_IS_NEARER)
    assert len(region.points) == len(points) + MOST_POINTS


def test_a_rule_of_another_context_or_that_leads_to_what_was_seen_hides_no_later_one() -> None:
    states = np.array([[1, 5, 0, 0], [1, 5, 1, 0], [1, 2, 1, 1], [1, 2, 0, 1], [1, 1, 0, 1]], dtype=np.float64)
    transitions = steps((0, TURN, 1, 40), (2, TURN, 3, 40), (3, AHEAD, 4, 40), states=states, ends=(4,))
    assert [rule.context[1] for rule in displacements(transitions, MOVING)] == [0, 1, 1]
    region, _ = extended(states[2:4], np.zeros((2, 2)), transitions)
    assert [1, 3, 0, 1] in region.points.tolist()  # by a step ahead from (2, 0), beside which (2, 1) was seen
