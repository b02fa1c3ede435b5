"""From where a policy reaches its subgoal, worked out by hand."""

import numpy as np
import numpy.typing as npt
import pytest

from sb3_options.density.regions import Region
from sb3_options.experience.observations import FloatArray
from sb3_options.options.policies import TabularPolicy
from sb3_options.options.reach import reach_probabilities, reliable_part
from sb3_options.options.tasks import Transitions

STAY, GO = 0, 1
AWAY, FAR, NEAR, THERE = range(4)


def repeated(*taken: tuple[int, int, int, int]) -> npt.NDArray[np.int64]:
    """Each (began, action, led, how often) as columns that often, (3, n)."""
    steps = np.array(taken, dtype=np.int64)
    return np.repeat(steps[:, :3], steps[:, 3], axis=0).T


def steps(*taken: tuple[int, int, int, int]) -> Transitions:
    """Each (began, action, led, how often); the subgoal ends the task, and so does what lies away from I."""
    began, actions, led = repeated(*taken)
    rewards = np.where(led == THERE, 0.0, np.where(led == AWAY, -100.0, -1.0))
    return Transitions(np.arange(4.0)[:, None], began, actions, rewards, led, (led == THERE) | (led == AWAY))


GOES = TabularPolicy(np.arange(4.0)[:, None], np.array([[0.0, 1.0]] * 4))
"""Goes everywhere."""


def probabilities(transitions: Transitions, n: int) -> FloatArray:
    return reach_probabilities(transitions, GOES, steps=n)


def test_a_failure_is_imagined_beside_the_steps_that_were_seen() -> None:
    seen = steps((NEAR, GO, THERE, 3), (FAR, GO, NEAR, 1), (FAR, GO, AWAY, 1), (NEAR, STAY, AWAY, 9))
    assert probabilities(seen, 1)[[FAR, NEAR]].tolist() == [0, 3 / 4]
    assert probabilities(seen, 2)[[FAR, NEAR]] == pytest.approx([1 / 3 * 3 / 4, 3 / 4])
    assert probabilities(seen, 99)[AWAY] == 0  # nobody acted there


def test_who_stays_where_it_is_does_not_get_there_in_time() -> None:
    """A wall that the features do not tell of: of 100 steps ahead 96 lead nowhere."""
    blocked = steps((NEAR, GO, NEAR, 96), (NEAR, GO, THERE, 4))
    assert probabilities(blocked, 1)[NEAR] == pytest.approx(4 / 101)
    assert 0.3 < probabilities(blocked, 15)[NEAR] < 0.5


def test_initiation_keeps_what_leads_there_without_what_is_dropped() -> None:
    initiation = Region(np.array([[FAR], [NEAR]], dtype=float), np.ones(1), 0.5)

    def kept(transitions: Transitions, least: float) -> list[float]:
        part = reliable_part(initiation, transitions, GOES, least=least, steps=15)
        return [float(point) for point in part.points.ravel()]

    sure = steps((NEAR, GO, THERE, 9), (FAR, GO, NEAR, 9))
    assert kept(sure, 0.8) == [FAR, NEAR]
    assert kept(sure, 0.85) == [NEAR]
    # FAR leads half to the subgoal, half to NEAR, from where a third come there: without NEAR it is not enough.
    split = steps((NEAR, GO, THERE, 2), (NEAR, GO, AWAY, 3), (FAR, GO, THERE, 50), (FAR, GO, NEAR, 49))
    assert probabilities(split, 15)[FAR] > 0.6
    assert kept(split, 0.4) == [FAR]
    assert kept(split, 0.6) == []


def test_zero_has_no_sign() -> None:
    """NEAR is at 0."""
    seen = steps((NEAR, GO, THERE, 9))._replace(states=np.array([[9.0], [1.0], [-0.0], [3.0]]))
    initiation = Region(np.zeros((1, 1)), np.ones(1), 0.5)
    assert reliable_part(initiation, seen, GOES, least=0.5, steps=15).points.tolist() == [[0.0]]
