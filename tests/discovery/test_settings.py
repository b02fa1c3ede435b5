"""Ranges of the settings of discovery, and the scale that each kind of features gets."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.settings import CATEGORICAL_SCALE, DiscoverySettings, default_scale
from tests.discovery.lines import bags_of, on_a_line, peaks_of, settings_of
from tests.support.helpers import trajectory_of


class TestScale:
    features = np.array([[0.0, 5.0, -1.0], [4.0, 5.0, 1.0], [2.0, 5.0, 0.0]])

    @pytest.mark.parametrize(
        ("kind", "expected"),
        [
            ("given", [1, 1, 1]),
            ("environment", [1, 1, 1]),
            (None, [1, 1, 1]),
            ("categorical", [CATEGORICAL_SCALE] * 3),
            ("identity", [5, 1, 10]),  # 20 units along the range; nothing to go by where nothing changes
        ],
    )
    def test_default(self, kind: str | None, expected: list[float]) -> None:
        assert default_scale(kind, self.features).tolist() == expected

    def test_given(self) -> None:
        discovery = Discovery(settings_of(scale=3.0), kind="identity")
        discovery.add(*on_a_line(0, 5, 20))
        assert bags_of(discovery) is not None
        assert discovery.scale is not None
        assert discovery.scale.tolist() == [3.0]

    @pytest.mark.parametrize(("kind", "method"), [("categorical", "exhaustive"), ("identity", "gradient")])
    def test_categorical_concepts_are_searched_exhaustively(self, kind: str, method: str) -> None:
        assert peaks_of(Discovery(kind=kind)).engine().method == method

    def test_categorical_states_are_equal_or_far_apart(self) -> None:
        """One-hot features of a Discrete space: the state that both walks share is found."""
        discovery = Discovery(settings_of(min_positive=1, start_radius=1.0, goal_radius=1.0), kind="categorical")
        for path in ([0, 1, 7, 5, 8, 2, 9], [3, 4, 6, 5, 1, 2, 9]):
            discovery.add(trajectory_of(path, is_success=True), np.eye(10)[path])
        subgoal = discovery.search()
        assert subgoal is not None
        assert subgoal.points.argmax() == 5
        assert subgoal.contains(np.eye(10)).tolist() == [i == 5 for i in range(10)]


WHOLE = r"should be (greater than or equal to 1|a valid integer|a finite number)"
RANGES: list[tuple[str, tuple[Any, ...], str]] = [
    *((name, (0, -1, 2.5, math.nan), WHOLE) for name in ("capacity", "min_positive", "max_places", "max_segment")),
    *(
        (name, (-0.1, math.nan), "should be greater than or equal to 0")
        for name in (
            "start_radius",
            "goal_radius",
            "peak_radius",
            "max_extent",
            "subgoal_radius",
            "spacing",
        )
    ),
    ("cut_threshold", (1.0, -0.1, math.nan), "should be (greater than or equal to 0|less than 1)"),
    ("search_growth", (-0.1, 1.0, math.nan), "should be (greater than or equal to 0|less than 1)"),
    ("scale", (0.0, -1.0, math.nan, math.inf), "should be (greater than 0|a finite number)"),
    ("negative_strength", (0.0, -0.5, 1.5, math.nan), "should be (greater than 0|less than or equal to 1)"),
    ("leak", (-0.1, 1.0, math.nan), "should be (greater than or equal to 0|less than 1)"),
    ("search", ("random", None), "should be 'gradient' or 'exhaustive'"),
    ("max_share", (0.0, -0.1, 1.1, math.nan), "should be (greater than 0|less than or equal to 1)"),
    ("method", ("hand", None), "should be 'diverse-density', 'first-visits',"),
    ("segmentation", ("lives", None), "should be 'episodes' or 'peaks'"),
    ("min_cut", (-0.1, 0.5, math.nan), "should be (greater than or equal to 0|less than 0.5)"),
    ("min_passing", (-0.1, 1.0, math.nan), "should be (greater than or equal to 0|less than 1)"),
    ("min_contrast", (-1.1, 1.0, math.nan), "should be (greater than or equal to -1|less than 1)"),
    ("salient_share", (-0.1, 1.0, math.nan), "should be (greater than or equal to 0|less than 1)"),
    ("loops", ("cut", 1), "should be 'erase' or 'keep'"),
    ("decay", (0.0, 1.0, -0.1, math.nan), "should be (greater than 0|less than 1)"),
    ("threshold", (1.0, -0.1, math.nan), "should be (greater than or equal to 0|less than 1)"),
]


@pytest.mark.parametrize(("name", "values", "message"), RANGES)
def test_settings_out_of_range(name: str, values: tuple[Any, ...], message: str) -> None:
    for value in values:
        with pytest.raises(ValueError, match=rf"^DiscoverySettings: {name} {message}.*, got {value!r}$"):
            DiscoverySettings(**{name: value})


def test_every_setting_has_a_range() -> None:
    """A new field needs a row above."""
    switches = {"negative_bags"}
    assert {f.name for f in dataclasses.fields(DiscoverySettings)} == {name for name, *_ in RANGES} | switches
