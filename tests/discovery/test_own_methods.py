"""A user's own method of discovery: what it may do, what is refused, and what it takes."""

import time
from typing import Any

import numpy as np
import pytest

from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.density.regions import Region
from sb3_options.discovery.budget import SHORTEST, TABLE_STEP_SECONDS
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.methods import Experience
from sb3_options.discovery.methods.random_places import RandomPlaces
from sb3_options.discovery.settings import DiscoverySettings
from tests.discovery.told import Told, line, of, searched


def test_a_method_that_fails_goes_on_with_the_next_trajectory() -> None:
    class Failing(Told):
        def update(self, experience: Experience) -> list[Region]:
            super().update(experience)
            if len(self.told) == 2:
                raise ValueError("not this one")
            return []

    method = Failing()
    discovery = of(method)
    searched(discovery, n_states=10)
    with pytest.raises(RuntimeError, match=r"^Failing.update failed: not this one$"):
        searched(discovery, n_states=11)
    searched(discovery, n_states=12)
    assert [len(each.features) for each in method.told] == [10, 11, 12]


def test_what_a_method_takes_that_does_not_say_is_measured() -> None:
    """An update works for twice what a table's training affords for a start, so that the next has to wait."""

    class Working(Told):
        def update(self, experience: Experience) -> list[Region]:
            until = time.process_time() + 2 * 0.05 * TABLE_STEP_SECONDS * SHORTEST
            while time.process_time() < until:
                pass
            return super().update(experience)

    told = {}
    for share in (0.05, None):
        method = Working()
        discovery = Discovery(DiscoverySettings(max_share=share), method=method, kind="environment")
        discovery.diary.step_seconds = TABLE_STEP_SECONDS
        searched(discovery, 3)
        told[share] = len(method.told)
    assert told == {0.05: 1, None: 3}


class Giving:
    """Answers with one thing."""

    def __init__(self, answer: Any) -> None:
        self.answer = answer

    def update(self, experience: Experience) -> Any:
        return self.answer


@pytest.mark.parametrize(
    ("proposal", "message"),
    [
        (Region(np.array([[np.nan]]), np.ones(1), 0.5), "; expected finite numbers of shapes"),
        (Region(np.array([[5.0]]), np.ones(1), -1.0), "; expected finite numbers of shapes"),
        (Region(np.array([5.0]), np.ones(1), 0.5), r"points of shape \(1,\), a scale of shape \(1,\)"),
        (Region(np.array([[5.0]]), np.array(1.0), 0.5), r"a scale of shape \(\) "),
        (Region(np.zeros((0, 1)), np.ones(1), 0.5), r"points of shape \(0, 1\),"),
    ],
)
def test_proposals_that_are_no_places_are_refused_and_others_taken_later(proposal: Region, message: str) -> None:
    method = Giving([proposal])
    discovery = of(method)
    with pytest.raises(ValueError, match=message):
        searched(discovery)
    assert discovery.search() is None
    method.answer = [Region([[5]], np.ones(1), 0.5)]  # type: ignore[arg-type]  # a list will do
    assert searched(discovery) == [5.0]
    assert discovery.found[0].subgoal.contains(np.array([[5.0], [6.0]])).tolist() == [True, False]


def test_a_method_cannot_move_what_was_taken_nor_what_was_lived_through() -> None:
    class Moving:
        mean = np.array([5.0])

        def update(self, experience: Experience) -> list[Region]:
            self.mean += 1.0
            with pytest.raises(ValueError, match="read-only"):
                experience.features -= 1.0
            with pytest.raises(ValueError, match="read-only"):
                experience.visits[0] = 3
            return [Region(self.mean[None], np.ones(1), 0.5), experience.region(self.mean), experience.region([5.0])]

    discovery = of(Moving())
    searched(discovery, 2)
    assert discovery.found[0].subgoal.points.tolist() == [[6.0]]
    assert line()[1].tolist() == next(iter(discovery.database)).features.tolist()


@pytest.mark.parametrize("answer", [None, np.zeros((1, 1)), [3.0]])
def test_answers_that_are_no_proposals_are_refused(answer: object) -> None:
    with pytest.raises(TypeError, match=r"^Giving.update must return a list of Region, got "):
        searched(of(Giving(answer)))


@pytest.mark.parametrize(
    ("method", "message"), [(42, "got 42"), (RandomPlaces, "got <class"), (lambda _: [], "got <function")]
)
def test_what_is_no_method_is_refused(method: object, message: str) -> None:
    with pytest.raises(TypeError, match=r"^method must be a name, or an object with update\(experience\), " + message):
        SubgoalDiscoveryCallback(method=method)  # type: ignore[arg-type]  # that is refused
