"""Discovery by a method: what it is told, and which of its proposals are taken."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.budget import SHORTEST, TABLE_STEP_SECONDS
from sb3_options.discovery.methods import DiscoveryMethod, Experience, Passage, Proposal, Repeat
from sb3_options.discovery.methods.candidates import PLACE_SECONDS
from sb3_options.discovery.methods.covering import CoveringOptions
from sb3_options.discovery.methods.graphs import LCut
from sb3_options.discovery.methods.repeats import RandomRepeats
from sb3_options.discovery.methods.visits import RandomPlaces, VisitFrequency
from sb3_options.discovery.proposed import ProposedDiscovery, discovery_with
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.discovery.subgoals import SubgoalDiscovery
from sb3_options.experience.trajectories import Trajectory


class Told:
    """Proposes what it was given, and remembers what it was told, though not in a checkpoint."""

    def __init__(self, *points: float) -> None:
        self.points = points
        self.told: list[Experience] = []

    def update(self, experience: Experience) -> list[Proposal]:
        self.told.append(experience)
        return [experience.region(np.array([point])) for point in self.points]

    def get_state(self) -> dict[str, Any]:
        return {}

    def set_state(self, state: dict[str, Any]) -> None:
        pass


def line(n: int = 12, *, success: bool = True) -> tuple[Trajectory, np.ndarray]:
    states = np.arange(n, dtype=np.float64)[:, None]
    visits = np.arange(n)
    actions, rewards = np.zeros(n - 1, dtype=np.int64), np.zeros(n - 1)
    return Trajectory(states, visits, actions, rewards, success, not success, success), states


def of(method: DiscoveryMethod, kind: str = "environment", **settings: float) -> SubgoalDiscovery:
    return discovery_with(DiscoverySettings(**settings), method=method, kind=kind)  # type: ignore[arg-type]  # of those that are numbers


def test_the_first_proposal_that_is_far_enough_is_taken() -> None:
    method = Told(5.0, 6.0, 9.0)
    discovery = of(method, spacing=3.0)
    found = []
    for _ in range(4):
        discovery.add(*line())
        subgoal = discovery.search()
        found.append(None if subgoal is None else float(subgoal.points[0, 0]))
    assert found == [5.0, 9.0, None, None]
    assert [f.subgoal.points[0, 0] for f in discovery.found] == [5.0, 9.0]
    assert len(method.told) == 4


def test_methods_are_told_what_may_be_a_subgoal() -> None:
    method = Told(6.0)
    discovery = of(method, start_radius=2.0, goal_radius=3.0, spacing=1.0)
    discovery.add(*line())
    discovery.search()
    discovery.add(*line())
    discovery.search()
    first, second = method.told
    assert np.flatnonzero(first.allowed).tolist() == [3, 4, 5, 6, 7]
    assert np.flatnonzero(second.allowed).tolist() == [3, 4]  # 5, 6 and 7 lie near the subgoal
    assert first.success


def test_a_scale_by_the_range_waits_for_trajectories() -> None:
    method = Told()
    discovery = of(method, kind="identity", min_positive=3)
    for _ in range(3):
        discovery.add(*line())
        assert discovery.search() is None
    assert len(method.told) == 3
    assert method.told[0].scale == pytest.approx(20 / 11)


class OnlyAtFirst(Told):
    """Proposes when it is told of its first trajectory, and never again."""

    def update(self, experience: Experience) -> list[Proposal]:
        proposals = super().update(experience)
        return proposals if len(self.told) == 1 else []


def test_what_was_proposed_of_trajectories_that_waited_is_not_lost() -> None:
    discovery = of(OnlyAtFirst(5.0), kind="identity", min_positive=3)
    found = []
    for _ in range(3):
        discovery.add(*line())
        found.append(discovery.search())
    assert [None if each is None else each.points[0, 0] for each in found] == [None, None, 5.0]


def test_without_distances_spacing_counts_steps() -> None:
    """One-hot codes are all equally far apart: 5, 7 and 9 in a row lie two steps from each other."""

    class States(Told):
        def update(self, experience: Experience) -> list[Proposal]:
            self.told.append(experience)
            return [experience.region(np.eye(12)[int(state)]) for state in self.points]

    discovery = of(States(5, 7, 9), kind="categorical", spacing=3.0)
    found = []
    for _ in range(3):
        trajectory, _ = line()
        discovery.add(trajectory, np.eye(12))
        subgoal = discovery.search()
        found.append(None if subgoal is None else int(subgoal.points[0].argmax()))
    assert found == [5, 9, None]


def test_settings_name_a_method() -> None:
    discovery = discovery_with(DiscoverySettings(method="l-cut"))
    assert isinstance(discovery, ProposedDiscovery)
    assert isinstance(discovery.method, LCut)
    assert type(discovery_with(DiscoverySettings())) is SubgoalDiscovery


def test_groups_are_for_diverse_density() -> None:
    groups = [FeatureGroup("all", (0,))]
    with pytest.raises(ValueError, match=r"^LCut works on all features together, .*groups=\(\)"):
        discovery_with(DiscoverySettings(method="l-cut"), groups)


def test_why_nothing_names_the_method() -> None:
    discovery = of(Told())
    assert discovery.why_nothing().startswith("No subgoal was discovered: no episode has ended. Train")
    discovery.add(*line())
    discovery.search()
    assert discovery.why_nothing() == "No subgoal was discovered: Told proposed none that the filters leave."


def test_why_nothing_tells_of_successes_where_the_method_needs_them(caplog: pytest.LogCaptureFixture) -> None:
    """A method that needs none is not said to lack them."""
    graph, visits = of(LCut()), of(VisitFrequency())
    for discovery in (graph, visits):
        for _ in range(20):
            discovery.add(*line(success=False))
            discovery.search()
    (said,) = [record.getMessage() for record in caplog.records]
    assert said.startswith("Nothing can be discovered so far: none of the 20 episodes seen counts as a success.")
    assert "LCut proposed none" in graph.why_nothing()
    assert "none of the 20 episodes seen counts as a success" in visits.why_nothing()


def test_there_is_no_lack_where_something_was_found() -> None:
    discovery = of(Told(5.0))
    discovery.add(*line())
    discovery.search()
    assert discovery.why_nothing() == "Subgoals discovered that have an option: 1."
    discovery.withdraw()
    assert "no saved trajectory leads to the one that was found" in discovery.why_nothing()


def test_what_no_option_could_be_learned_for_comes_again_and_blocks_nothing_near() -> None:
    discovery = of(Told(5.0, 6.0), spacing=3.0)

    def searched() -> float | None:
        discovery.add(*line())
        subgoal = discovery.search()
        return None if subgoal is None else float(subgoal.points[0, 0])

    assert searched() == 5.0
    discovery.withdraw()
    state = discovery.get_state()  # with methods that tell
    assert searched() == 5.0, "twice as many trajectories"
    discovery.withdraw()
    assert searched() == 6.0, "so near to 5 that an option there would leave it out"
    assert searched() is None
    discovery.set_state(state)
    assert (searched(), discovery.n_kept) == (5.0, 1)


@pytest.mark.parametrize(
    ("method", "waits"),
    [
        (CoveringOptions(min_trajectories=4), "CoveringOptions waits for 4 episodes (min_trajectories)"),
        (RandomPlaces(min_successes=9), "RandomPlaces waits for 9 successful episodes (min_successes)"),
    ],
)
def test_why_nothing_says_what_a_method_waits_for(method: DiscoveryMethod, waits: str) -> None:
    discovery = of(method)
    for _ in range(3):
        discovery.add(*line())
        discovery.search()
    assert discovery.why_nothing() == f"No subgoal was discovered: {waits}, and 3 have ended."


@pytest.mark.parametrize("seconds", [np.nan, -1.0, np.inf, "long", None])
def test_seconds_that_are_none_are_refused(seconds: object) -> None:
    class Timed(Told):
        def seconds(self, experience: Experience) -> object:
            del experience
            return seconds

    discovery = of(Timed(5.0))
    discovery.add(*line())
    with pytest.raises(ValueError, match=r"^Timed.seconds must return a finite number of at least 0, got "):
        discovery.search()
    assert discovery.budget.affords()


class Failing(Told):
    """Fails at its second trajectory."""

    def update(self, experience: Experience) -> list[Proposal]:
        super().update(experience)
        if len(self.told) == 2:
            raise ValueError("not this one")
        return []


def test_a_method_that_fails_goes_on_with_the_next_trajectory() -> None:
    method = Failing()
    discovery = of(method)
    for n in range(10, 14):
        discovery.add(*line(n))
        if n == 11:
            with pytest.raises(RuntimeError, match=r"^Failing.update failed: not this one$"):
                discovery.search()
        else:
            discovery.search()
    assert [len(each.features) for each in method.told] == [10, 11, 12, 13]


def test_what_a_method_takes_that_does_not_say_is_measured() -> None:
    """An update works for twice what a table's training affords for a start, so that the next has to wait."""

    class Working(Told):
        def update(self, experience: Experience) -> list[Proposal]:
            until = time.process_time() + 2 * 0.05 * TABLE_STEP_SECONDS * SHORTEST
            while time.process_time() < until:
                pass
            return super().update(experience)

    told = {}
    for share in (0.05, None):
        method = Working()
        discovery = discovery_with(DiscoverySettings(max_share=share), method=method, kind="environment")
        discovery.budget.step_seconds = TABLE_STEP_SECONDS
        for _ in range(3):
            discovery.add(*line())
            discovery.search()
        told[share] = len(method.told)
    assert told == {0.05: 1, None: 3}


@pytest.mark.parametrize("make", [RandomPlaces, RandomRepeats])
def test_no_method_of_the_library_is_measured(make: Callable[[], DiscoveryMethod]) -> None:
    """Two runs with one seed, and one that was resumed, spend the same."""
    spent = []
    for _ in range(2):
        discovery = of(make())
        for _ in range(5):
            discovery.add(*line())
            discovery.search()
        spent.append(discovery.budget.spent)
    assert spent[0] == spent[1]


def test_methods_see_the_trajectory_and_cannot_change_it() -> None:
    method = Told()
    discovery = of(method)
    lived, features = line()
    discovery.add(lived, features)
    discovery.search()
    seen = method.told[0].trajectory
    for name in ("states", "visits", "actions", "rewards"):
        array = getattr(seen, name)
        assert array.tolist() == getattr(lived, name).tolist()
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 7
    assert seen.terminated
    pictures = {"image": np.zeros((12, 2)), "carried": np.zeros(12)}
    discovery.add(dataclasses.replace(lived, states=pictures), features)
    discovery.search()
    states = method.told[1].trajectory.states
    assert isinstance(states, dict)
    assert not any(of.flags.writeable for of in states.values())
    alone = Experience(
        features, lived.visits, success=True, allowed=np.ones(12, dtype=bool), scale=np.ones(1), radius=0.5
    )
    with pytest.raises(AttributeError, match="made of features and visits alone"):
        _ = alone.trajectory


def test_what_waits_to_be_told_keeps_to_the_memory_too() -> None:
    """The scale by the range waits for four trajectories, of which only two may be kept."""
    size = line()[0].n_bytes + line()[1].nbytes
    method = Told()
    discovery = of(method, kind="identity", max_bytes=2 * size)
    for n in range(1, 7):
        discovery.add(*line())
        assert len(discovery._untold) <= 2  # type: ignore[attr-defined]  # of `ProposedDiscovery`
        discovery.search()
        assert (discovery.scale is not None) == (n >= 4)
    assert len(method.told) == 2 + 2


class Giving:
    """Proposes one thing."""

    def __init__(self, proposal: Any) -> None:
        self.proposal = proposal

    def update(self, experience: Experience) -> list[Proposal]:
        return [self.proposal]


@pytest.mark.parametrize(
    ("proposal", "message"),
    [
        (Region(np.array([[np.nan]]), np.ones(1), 0.5), r"^Giving proposed a Region with points, scale or radius that"),
        (Region(np.array([[5.0]]), np.ones(1), -1.0), r"^Giving proposed a Region with points, scale or radius that"),
        (
            Region(np.array([5.0]), np.ones(1), 0.5),
            r"points have shape \(1,\) and whose scale has \(1,\); they must be",
        ),
        (Region(np.array([[5.0]]), 1.0, 0.5), r"whose scale has \(\); they must be \(n, 1\) and \(1,\), n ≥ 1, for φ"),  # type: ignore[arg-type]  # that is refused
        (Region(np.zeros((0, 1)), np.ones(1), 0.5), r"points have shape \(0, 1\) and"),
        (
            Repeat(0, 3, np.ones(2)),
            r"a Repeat whose points have shape \(1, 2\) and whose scale",
        ),
        (
            Passage(Region(np.ones((1, 1)), np.ones(1), 0.5), Region(np.ones((1, 2)), np.ones(2), 0.5)),
            r"a Passage whose",
        ),
    ],
)
def test_proposals_that_are_no_places_are_refused_and_others_taken_later(proposal: Proposal, message: str) -> None:
    method = Giving(proposal)
    discovery = of(method)
    discovery.add(*line())
    with pytest.raises(ValueError, match=message):
        discovery.search()
    assert discovery.search() is None
    method.proposal = Region([[5]], np.ones(1), 0.5)  # type: ignore[arg-type]  # a list will do
    discovery.add(*line())
    found = discovery.search()
    assert found is not None
    assert found.contains(np.array([[5.0], [6.0]])).tolist() == [True, False]


def test_a_method_cannot_move_what_was_taken_nor_what_was_lived_through() -> None:
    class Moving:
        mean = np.array([5.0])

        def update(self, experience: Experience) -> list[Proposal]:
            self.mean += 1.0
            with pytest.raises(ValueError, match="read-only"):
                experience.features -= 1.0
            with pytest.raises(ValueError, match="read-only"):
                experience.visits[0] = 3
            return [Region(self.mean[None], np.ones(1), 0.5), experience.region(self.mean), experience.region([5.0])]

    discovery = of(Moving())
    for _ in range(2):
        discovery.add(*line())
        discovery.search()
    assert discovery.found[0].subgoal.points.tolist() == [[6.0]]
    assert line()[1].tolist() == next(iter(discovery.database)).features.tolist()


def test_a_checkpoint_needs_both_ways() -> None:
    class HalfWay(Giving):
        def get_state(self) -> dict[str, Any]:
            return {}

    with pytest.raises(ValueError, match=r"^Checkpoints of discovery by HalfWay are not supported: give it get_state"):
        of(HalfWay(None)).get_state()


@pytest.mark.parametrize("answer", [None, np.zeros((1, 1)), [3.0]])
def test_answers_that_are_no_proposals_are_refused(answer: object) -> None:
    class Odd:
        def update(self, experience: Experience) -> object:
            return answer

    discovery = of(Odd())  # type: ignore[arg-type]  # that is refused
    discovery.add(*line())
    with pytest.raises(TypeError, match=r"^Odd.update must return a list of Region, Passage, IntrinsicReward, Repeat"):
        discovery.search()


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (42, "got 42"),
        (LCut, "got the class LCut, which is not made yet"),
        (lambda _: [], "got <function"),
        ({"name": "l-cut"}, "got {'name': 'l-cut'}"),
        ({"l-cut"}, "got {'l-cut'}"),
    ],
)
def test_what_is_no_method_is_refused(method: object, message: str) -> None:
    with pytest.raises(TypeError, match=r"^method must be a name, or an object with update\(experience\), " + message):
        SubgoalDiscoveryCallback(method=method)  # type: ignore[arg-type]  # that is refused


def test_what_it_takes_grows_with_the_places_remembered() -> None:
    method = LCut()
    discovery = of(method)
    costs = []
    for start in (0, 100, 200):
        trajectory, states = line()
        discovery.add(trajectory, states + start)
        discovery.search()
        costs.append(discovery.cost)
    assert np.diff(costs) == pytest.approx([12 * PLACE_SECONDS] * 2)
