import dataclasses
from typing import Any

import numpy as np
import pytest

from sb3_options.density.groups import FeatureGroup, checked_groups
from sb3_options.density.regions import Region

DOOR = FeatureGroup("door", [3, 1], present=[[3]], scale=[10, 1])


def test_a_region_on_a_group_does_not_see_the_other_features() -> None:
    region = Region(np.array([[1.0, 2.0]]), np.array([10.0, 1.0]), 0.5, group=DOOR)
    features = np.array([[9, 2, 9, 1], [-7, 2, 0, 1], [9, 3, 9, 1], [9, 2, 9, 0.0]])
    assert region.contains(features).tolist() == [True, True, False, False]
    assert region.own(features).tolist() == features[:, [3, 1]].tolist()
    wide = dataclasses.replace(region, radius=1000.0)
    assert wide.contains(features).tolist() == [True, True, True, False], "what is not there is no place"


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
        ({"labels": ["forward"]}, "group 'it': labels must be 2 texts"),
        ({"labels": [1, 2]}, "labels.0 should be a valid string"),
        ({"features": []}, "group 'it': features must be distinct numbers"),
        ({"features": [1, 1]}, "group 'it': features must be distinct numbers"),
        ({"features": [-1]}, "features.0 should be greater than or equal to 0"),
        ({"present": [[2]]}, "group 'it': present must be sets of its features"),
        ({"present": [[]]}, "group 'it': present must be sets of its features"),
        ({"coordinates": [2]}, "group 'it': coordinates must be some of its features"),
        ({"scale": [1]}, "group 'it': scale must be 2 numbers"),
        ({"scale": [0, 1]}, "scale.0 should be greater than 0"),
        ({"seen": {"name": "x", "features": [1, 0]}}, "group 'it': seen must begin with its features"),
        ({"seen": {"features": [0, 1]}}, "seen.name is missing"),
        ({"seen": {"name": "x", "features": [0, 1], "colour": 1}}, "seen.colour"),
        ({"seen": FeatureGroup("x", [0, 1], seen=FeatureGroup("y", [0, 1]))}, "features, and see no other group"),
        ({"seen": 7}, "seen should be"),
    ],
)
def test_arguments_out_of_range(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        FeatureGroup(**{"name": "it", "features": [0, 1], **wrong})


def test_what_options_see_begins_with_the_groups_own_features() -> None:
    seen = {"name": "door, and the cell ahead", "features": [3, 1, 2], "present": [[3, 2]], "scale": [10, 1, 10]}
    group = FeatureGroup("door", [3, 1], present=[[3]], scale=[10, 1], seen=seen)  # type: ignore[arg-type]  # as in YAML
    assert group.sees == FeatureGroup(**seen)  # type: ignore[arg-type]  # fields of several types
    assert DOOR.sees is DOOR
    assert group != DOOR


@pytest.mark.parametrize("group", [DOOR, FeatureGroup("wide", [1], seen=FeatureGroup("door", [1, 3]))])
def test_groups_must_fit_the_feature_map(group: FeatureGroup) -> None:
    with pytest.raises(ValueError, match="group 'door' names feature 3, the feature map gives 3"):
        checked_groups([group], 3)
