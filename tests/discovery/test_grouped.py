from collections.abc import Sequence

import numpy as np
import pytest

from sb3_options import OptionBank
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.contrast import NO_PLACE, Contrast
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.figures import map_figure
from sb3_options.discovery.methods.grouped import GroupedPeaks
from sb3_options.discovery.salience import OutcomeDatabase, Salience
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory
from sb3_options.state import restore, state_of
from tests.discovery.lines import said

# Features: key visible, key ahead, wall visible, wall ahead, noise.
KEY = FeatureGroup("key", [0, 1], present=[[0]], scale=[10, 1])
WALL = FeatureGroup("wall", [2, 3], present=[[2]], scale=[10, 1])
BOTH = FeatureGroup("both", [0, 1, 2, 3], present=[[0], [2]], scale=[10, 1, 10, 1])
AT_KEY = [1, 1, 0, 0, 0]
SOON = DiscoverySettings(start_radius=0, goal_radius=0, min_positive=4, decay=0.5, threshold=0.5)


def trajectory(states: Sequence[Sequence[float]], success: bool) -> tuple[Trajectory, FloatArray]:
    features = np.array(states, dtype=np.float64)
    steps = np.zeros(len(features) - 1)
    return Trajectory(features, np.arange(len(features)), steps.astype(int), steps, True, False, success), features


def walk(rng: np.random.Generator, success: bool) -> tuple[Trajectory, FloatArray]:
    """Each sees walls at all distances; those that succeed come to a key, from where it is 3 ahead to 1 ahead."""
    states = [[0, 0, 1, d] for d in rng.permutation(5)[:4]]
    if success:
        states += [[1, d, 1, 2] for d in (3, 2, 1)][int(rng.integers(2)) :]
    elif rng.random() < 0.5:
        states += [[1, 3, 1, 2]]
    states += [[0, 0, 0, 0]]
    return trajectory([[*state, rng.normal()] for state in states], success)


def discovered(groups: Sequence[FeatureGroup]) -> Discovery:
    return going_on(Discovery(SOON, groups=groups))


def going_on(discovery: Discovery, seed: int = 0) -> Discovery:
    rng = np.random.default_rng(seed)
    for i in range(60):
        discovery.add(*walk(rng, success=i % 2 == 0))
        discovery.search()
    return discovery


def test_the_subgoal_is_in_the_features_of_the_group_that_matters() -> None:
    found = discovered([WALL, KEY]).found
    assert [(f.subgoal.group, f.subgoal.points.tolist()) for f in found] == [(KEY, [[1, 1]])]
    states = np.array([[1, 1, 0, 0, 99], [1, 1, 1, 4, -99], [1, 2, 0, 0, 0], [0, 1, 0, 0, 0]])
    assert found[0].subgoal.contains(states).tolist() == [True, True, False, False]


def test_a_pair_must_contrast_more_than_its_parts() -> None:
    assert {f.subgoal.group for f in discovered([KEY, WALL, BOTH]).found} == {KEY}


def test_what_persists_is_no_subgoal_while_its_bags_are_empty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two concepts that persist the second comes with a later search, where its bags may be empty."""
    same = FeatureGroup("same", KEY.features, present=[[0]], scale=[10, 1])
    discovery = Discovery(SOON, groups=[KEY, same])
    assert isinstance(discovery.method, GroupedPeaks)
    rng = np.random.default_rng(0)
    success = True
    while not discovery.found:
        discovery.add(*walk(rng, success))
        discovery.search()
        success = not success
    second = discovery.method.members[same]
    assert list(second.tracker.persistent(SOON.threshold))
    with monkeypatch.context() as patched:
        patched.setattr(second, "bags", lambda _: None)
        discovery.add(*walk(rng, success=True))
        assert discovery.search() is None
        assert second.evidence is None
    discovery.add(*walk(rng, success=True))
    assert discovery.search() is not None


def test_where_nothing_stands_out_it_says_so() -> None:
    assert "much more often than failures do" in discovered([WALL]).why_nothing()


def test_the_picture_names_the_subgoals() -> None:
    discovery = discovered([WALL, KEY])
    assert said(discovery).startswith("Subgoals: key at 1, 1.")
    assert map_figure(discovery, OptionBank(2, 1)) is None


def values_of(contrast: Contrast, *states: Sequence[float]) -> FloatArray:
    """The contrast of states by all their features."""
    features = np.array(states, dtype=np.float64)
    own = contrast.group.own(features)
    numbers = [contrast._numbers.get(state.tobytes(), -1) for state in own]
    values: FloatArray = contrast._values[np.where(contrast.group.is_place(features), numbers, -1)]
    return values


def labelled(states: Sequence[Sequence[float]], success: bool) -> LabelledTrajectory:
    return LabelledTrajectory(*trajectory(states, success), success)


def test_contrast_by_hand() -> None:
    contrast = Contrast(KEY, radius=0.5)
    trajectories = [
        labelled([[0, 0, 0, 0, 0], [1, 2, 0, 0, 0], [1, 1, 0, 0, 0], [1, 1, 0, 0, 1]], True),
        labelled([[0, 0, 0, 0, 0], [1, 1, 0, 0, 0]], True),
        labelled([[0, 0, 0, 0, 0], [1, 2, 0, 0, 0]], False),
        labelled([[0, 0, 0, 0, 0], [0, 0, 1, 0, 0]], False),
        labelled([[0, 0, 0, 0, 0], [0, 0, 1, 1, 0]], False),
    ]
    contrast.update(trajectories)
    values = values_of(contrast, [1, 1, 7, 7, 7], [1, 2, 0, 0, 0], [0, 1, 0, 0, 0])
    np.testing.assert_allclose(values, [3 / 4 - 1 / 5, 2 / 4 - 2 / 5, NO_PLACE])
    assert contrast.largest() == pytest.approx(3 / 4 - 1 / 5)
    # 2 is a neighbour of 1 within a wider radius.
    wide = Contrast(KEY, radius=1.0)
    wide.update(trajectories)
    np.testing.assert_allclose(values_of(wide, AT_KEY), [3 / 4 - 2 / 5])


def test_where_most_begin_is_no_place_to_reach() -> None:
    contrast = Contrast(KEY, radius=0.5)
    begins = [labelled([[1, 1, 0, 0, 0], [0, 0, 0, 0, 0]], True) for _ in range(4)]
    others = [labelled([[0, 0, 0, 0, 0], [1, 1, 0, 0, 0]], True), *(labelled([[0] * 5, [1, 3, 0, 0, 0]], False),) * 2]
    contrast.update([*begins, *others])
    assert values_of(contrast, AT_KEY).tolist() == [NO_PLACE]
    contrast.update([*begins[:2], *others])
    assert values_of(contrast, AT_KEY)[0] > 0


def test_few_successes_are_not_pushed_out_by_many_failures() -> None:
    database = OutcomeDatabase(2, np.inf, Salience((), 0.0, 0))
    first, second, third = (labelled([[0] * 5, [i] * 5], True) for i in range(3))
    for success in (first, second, third):
        database.add(success)
        for _ in range(5):
            database.add(labelled([[0] * 5, [1] * 5], False))
    assert len(database) == 4
    assert [t for t in database if t.success] == [second, third]


def test_the_unsuccessful_count_for_what_they_did_in_the_time_of_a_success() -> None:
    """The key is reached after 1 or 3 steps by the successful, after 2 by one of the others, after 9 by the other."""

    def comes_to_the_key(after: int, duration: int, success: bool) -> LabelledTrajectory:
        states = [[0, 0, 0, 0, i] for i in range(duration + 1)]
        states[after][:2] = [1, 1]
        return labelled(states, success)

    lived = [comes_to_the_key(*how) for how in ((1, 2, True), (3, 4, True), (2, 9, False), (9, 9, False))]
    own = Contrast(KEY, 0.5)
    own.update(lived)
    assert values_of(own, AT_KEY) == pytest.approx(0.75 - 2 / 4)


def test_what_is_near_counts_with_when_it_was_first() -> None:
    near, early = Contrast(KEY, 1.0), labelled([[0, 0, 0, 0, 0], [1, 2, 0, 0, 0], [1, 1, 0, 0, 0]], False)
    near.update([early, labelled([[0, 0, 0, 0, 0], [1, 1, 0, 0, 0]], True)])
    assert values_of(near, AT_KEY) == pytest.approx(2 / 3 - 2 / 3)  # near in time


def test_a_subgoal_that_is_withdrawn_comes_again() -> None:
    discovery = discovered([WALL, KEY])
    discovery.withdraw()
    assert discovery.found == []
    assert "no saved trajectory leads to the subgoal reliably enough" in discovery.why_nothing()
    state = state_of(discovery)
    going_on(discovery, seed=1)
    assert [(f.subgoal.group, f.subgoal.points.tolist()) for f in discovery.found] == [(KEY, [[1, 1]])]
    other = Discovery(SOON, groups=[WALL, KEY])
    restore(other, state)
    assert (other.found, other.diary.n_withdrawn) == ([], 1)


def test_options_on_other_features_do_not_count() -> None:
    """A subgoal of a group has fewer features than those that discovery on all of them compares."""
    of_group = Region(np.zeros((1, 2)), np.ones(2), 0.5, group=KEY)
    of_all = Region(np.zeros((1, 5)), np.ones(5), 0.5)
    assert list(Discovery(SOON, taken=[of_group, of_all]).taken) == [of_all]
    grouped = Discovery(SOON, groups=[KEY, WALL], taken=[of_group, of_all])
    assert list(grouped.taken) == [of_group, of_all]


@pytest.mark.parametrize("scale", [None, 0.1, 4.0])
def test_contrast_joins_what_a_subgoal_reaches(scale: float | None) -> None:
    discovery = Discovery(DiscoverySettings(**{**vars(SOON), "scale": scale}), groups=[KEY])
    assert isinstance(discovery.method, GroupedPeaks)
    contrast = discovery.method.members[KEY].contrast
    assert contrast is not None
    assert contrast.radius == SOON.subgoal_radius / (scale or 1.0)


def test_what_is_for_groups_alone_is_told_to_have_no_effect(caplog: pytest.LogCaptureFixture) -> None:
    Discovery(DiscoverySettings(salient_share=0.5), groups=[KEY])
    assert not caplog.text
    Discovery(DiscoverySettings(salient_share=0.5))
    assert "salient_share=0.5 has no effect: it is for groups of features, and there are none." in caplog.text
