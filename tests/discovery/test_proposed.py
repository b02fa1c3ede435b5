"""Discovery by a method: what it is told, and which of its proposals are taken."""

import numpy as np
import pytest

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.methods import Experience
from sb3_options.discovery.methods.diverse_density import PersistentPeaks
from sb3_options.discovery.methods.random_places import RandomPlaces
from sb3_options.discovery.methods.relative_novelty import RelativeNovelty
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.state import restore, state_of
from tests.discovery.told import Told, line, of, searched


def test_the_first_proposal_that_is_far_enough_is_taken() -> None:
    method = Told(5.0, 6.0, 9.0)
    discovery = of(method, spacing=3.0)
    assert searched(discovery, 4) == [5.0, 9.0, None, None]
    assert [f.subgoal.points[0, 0] for f in discovery.found] == [5.0, 9.0]
    assert len(method.told) == 4


def test_methods_are_told_what_may_be_a_subgoal() -> None:
    method = Told(6.0)
    discovery = of(method, start_radius=2.0, goal_radius=3.0, spacing=1.0)
    searched(discovery, 2)
    first, second = method.told
    assert np.flatnonzero(first.allowed).tolist() == [3, 4, 5, 6, 7]
    assert np.flatnonzero(second.allowed).tolist() == [3, 4]  # 5, 6 and 7 lie near the subgoal
    assert first.success
    assert first.trajectory is next(iter(discovery.database)).trajectory


def test_a_scale_by_the_range_waits_for_trajectories() -> None:
    method = Told()
    discovery = of(method, kind="identity", min_positive=3)
    assert searched(discovery, 3) == [None] * 3
    assert len(method.told) == 3
    assert method.told[0].scale == pytest.approx(20 / 11)


def test_what_was_proposed_of_trajectories_that_waited_is_not_lost() -> None:
    class OnlyAtFirst(Told):
        def update(self, experience: Experience) -> list[Region]:
            proposals = super().update(experience)
            return proposals if len(self.told) == 1 else []

    assert searched(of(OnlyAtFirst(5.0), kind="identity", min_positive=3), 3) == [None, None, 5.0]


def test_without_distances_spacing_counts_steps() -> None:
    """One-hot codes are all equally far apart: 5, 7 and 9 in a row lie two steps from each other."""

    class States(Told):
        def update(self, experience: Experience) -> list[Region]:
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
    assert isinstance(Discovery(DiscoverySettings(method="relative-novelty")).method, RelativeNovelty)
    assert isinstance(Discovery().method, PersistentPeaks)


def test_groups_are_for_diverse_density() -> None:
    groups = [FeatureGroup("all", (0,))]
    with pytest.raises(ValueError, match=r"^RelativeNovelty works on all features together, .*groups=\(\)"):
        Discovery(DiscoverySettings(method="relative-novelty"), groups=groups)


def test_why_nothing_names_the_method_and_what_it_waits_for() -> None:
    discovery = of(Told())
    assert discovery.why_nothing().startswith("No subgoal was discovered: no episode has ended. Train")
    searched(discovery)
    assert discovery.why_nothing() == "No subgoal was discovered: Told proposed none that the filters leave."
    waiting = of(RandomPlaces(min_successes=9))
    searched(waiting, 3)
    assert "RandomPlaces waits for 9 successful episodes (min_successes), and 3 have ended" in waiting.why_nothing()


def test_why_nothing_tells_of_successes_where_the_method_needs_them(caplog: pytest.LogCaptureFixture) -> None:
    """A method that needs none is not said to lack them."""
    novelty, places = of(RelativeNovelty()), of(RandomPlaces())
    for discovery in (novelty, places):
        searched(discovery, 20, success=False)
    (said,) = [record.getMessage() for record in caplog.records]
    assert said.startswith("Discovery waits for a success: there was none in the first 20 episodes.")
    assert "RelativeNovelty proposed none" in novelty.why_nothing()
    assert "no success in 20 episodes" in places.why_nothing()


def test_there_is_no_lack_where_something_was_found() -> None:
    discovery = of(Told(5.0))
    searched(discovery)
    assert discovery.why_nothing() == "Subgoals discovered that have an option: 1."
    discovery.withdraw()
    assert "no saved trajectory leads to the subgoal" in discovery.why_nothing()


def test_what_no_option_could_be_learned_for_comes_again_and_blocks_nothing_near() -> None:
    discovery = of(Told(5.0, 6.0), spacing=3.0)
    assert searched(discovery) == [5.0]
    discovery.withdraw()
    state = state_of(discovery)  # with methods that tell
    assert searched(discovery) == [5.0], "twice as many trajectories"
    discovery.withdraw()
    assert searched(discovery, 2) == [6.0, None], "so near to 5 that an option there would leave it out"
    restore(discovery, state)
    assert (searched(discovery), len(discovery.found)) == ([5.0], 1)


def test_what_waits_for_the_method_keeps_to_the_memory_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scale by the range waits for four trajectories, of which only two may be kept."""
    monkeypatch.setattr("sb3_options.discovery.discovery.MAX_BYTES", 2 * (line()[0].n_bytes + line()[1].nbytes))
    method = Told()
    discovery = of(method, kind="identity")
    for n in range(1, 7):
        searched(discovery)
        assert (discovery.scale is not None) == (n >= 4)
    assert len(method.told) == 2 + 2
