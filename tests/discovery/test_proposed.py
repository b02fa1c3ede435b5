"""Discovery by a method: what it is told, and which of its proposals are taken."""

import numpy as np
import pytest

from sb3_options.density.groups import FeatureGroup
from sb3_options.discovery.methods import DiscoveryMethod, Experience, Proposal
from sb3_options.discovery.methods.graphs import LCut
from sb3_options.discovery.proposed import ProposedDiscovery, discovery_with
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.discovery.subgoals import SubgoalDiscovery
from sb3_options.experience.trajectories import Trajectory


class Told:
    """Proposes what it was given, and remembers what it was told."""

    def __init__(self, *points: float) -> None:
        self.points = points
        self.told: list[Experience] = []

    def update(self, experience: Experience) -> list[Proposal]:
        self.told.append(experience)
        return [experience.region(np.array([point])) for point in self.points]


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
    assert discovery.why_nothing() == "No subgoal was discovered: no episode has ended."
    discovery.add(*line())
    discovery.search()
    assert discovery.why_nothing() == "No subgoal was discovered: Told proposed none that the filters leave."
