from typing import Any

import numpy as np
import pytest

from sb3_options.density.groups import FeatureGroup, checked_groups
from sb3_options.density.regions import Region

DOOR = FeatureGroup("door", [3, 1], present=[[3]], scale=[10, 1])


def test_a_region_on_a_group_does_not_see_the_other_features() -> None:
    region = Region(np.array([[1.0, 2.0]]), np.array([10.0, 1.0]), 0.5, group=DOOR)
    features = np.array([[9, 2, 9, 1], [-7, 2, 0, 1], [9, 3, 9, 1], [9, 2, 9, 0.0]])
    np.testing.assert_array_equal(region.contains(features), [True, True, False, False])
    np.testing.assert_array_equal(region.own(features), features[:, [3, 1]])


def test_what_is_not_there_is_no_place_however_wide_the_region() -> None:
    region = Region(np.array([[1.0, 0.0]]), np.array([10.0, 1.0]), 1000.0, group=DOOR)
    np.testing.assert_array_equal(region.contains(np.array([[0, 0, 0, 0.0], [0, 0, 0, 1.0]])), [False, True])


def test_all_sets_of_a_pair_must_be_present_and_any_feature_of_a_set_will_do() -> None:
    pair = FeatureGroup("pair", [0, 1, 2], present=[[0, 1], [2]])
    features = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 1], [1, 1, 0.0]])
    np.testing.assert_array_equal(pair.is_place(features), [True, True, False, False])


def test_groups_of_lists_and_of_tuples_are_the_same() -> None:
    assert FeatureGroup("door", (3, 1), ((3,),), (10, 1)) == DOOR
    assert hash(DOOR) == hash(FeatureGroup("door", (3, 1), ((3,),), (10, 1)))


def test_labels_tell_where_a_concept_is_and_make_no_other_group() -> None:
    labelled = FeatureGroup("door", [3, 1], present=[[3]], scale=[10, 1], labels=["", "forward"])
    assert labelled.told(np.array([1.0, 2.0])) == "door at forward 2"
    assert FeatureGroup("doorway", [3], labels=[""]).told(np.array([1.0])) == "doorway"
    assert DOOR.told(np.array([1.0, 2.0])) is None
    assert labelled == DOOR


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"features": [0, 1], "labels": ["forward"]}, "labels must be 2 texts"),
        ({"features": [0, 1], "labels": "forward"}, "labels must be 2 texts"),
        ({"features": [0, 1], "labels": [1, 2]}, "labels must be 2 texts"),
        ({"features": []}, "features must be distinct numbers"),
        ({"features": [1, 1]}, "features must be distinct numbers"),
        ({"features": [-1]}, "features must be distinct numbers"),
        ({"features": [0], "present": [[1]]}, r"present must be sets of its features \(0,\)"),
        ({"features": [0], "present": [[]]}, "present must be sets of its features"),
        ({"features": [0], "scale": [1, 1]}, "scale must be 1 numbers above 0"),
        ({"features": [0], "scale": [0]}, "scale must be 1 numbers above 0"),
    ],
)
def test_arguments_out_of_range(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=f"group 'it': {message}"):
        FeatureGroup("it", **wrong)  # type: ignore[arg-type]  # that is the test


def test_what_options_see_begins_with_the_groups_own_features() -> None:
    seen = {"name": "door, and the cell ahead", "features": [3, 1, 2], "present": [[3, 2]], "scale": [10, 1, 10]}
    group = FeatureGroup("door", [3, 1], present=[[3]], scale=[10, 1], seen=seen)
    assert group.sees == FeatureGroup(**seen)  # type: ignore[arg-type]  # fields of several types
    assert DOOR.sees is DOOR
    assert group != DOOR
    with pytest.raises(ValueError, match="group 'door, and the cell ahead' names feature 3, the feature map gives 3"):
        checked_groups([FeatureGroup("door", [1], seen={"name": "door, and the cell ahead", "features": [1, 3]})], 3)


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        ({"name": "x", "features": [0, 1]}, r"seen must begin with its features \(1,\), got \(0, 1\)"),
        ({"features": [1]}, "seen must have the fields of a group: .*name"),
        ({"name": "x", "features": [1], "colour": 1}, "seen must have the fields of a group: .*colour"),
        ({"name": "x", "features": [1], "seen": {"name": "y", "features": [1]}}, "seen .* has no other one to see"),
        (7, "seen must be a group that has no other one to see, got 7"),
    ],
)
def test_what_options_cannot_see(seen: Any, message: str) -> None:
    with pytest.raises(ValueError, match=f"group 'it': {message}"):
        FeatureGroup("it", [1], seen=seen)


def test_groups_must_fit_the_feature_map_and_have_names_of_their_own() -> None:
    with pytest.raises(ValueError, match="group 'door' names feature 3, the feature map gives 3"):
        checked_groups([DOOR], 3)
    with pytest.raises(ValueError, match="two groups of features have the same name"):
        checked_groups([DOOR, DOOR], 4)
