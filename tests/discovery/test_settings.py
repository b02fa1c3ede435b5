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


OUT_OF_RANGE: dict[str, tuple[Any, ...]] = {
    **dict.fromkeys(("capacity", "min_positive", "max_segment"), (0, -1, 2.5, math.nan)),
    **dict.fromkeys(("start_radius", "goal_radius"), (-0.1, math.nan)),
    **dict.fromkeys(("subgoal_radius", "spacing"), (-0.1, math.nan)),
    **dict.fromkeys(("search_growth", "leak", "min_passing"), (-0.1, 1.0, math.nan)),
    **dict.fromkeys(("salient_share", "threshold"), (-0.1, 1.0, math.nan)),
    "negative_strength": (-0.5, 1.5, math.nan),
    "max_share": (0.0, -0.5, 1.5, math.nan),
    "scale": (0.0, -1.0, math.nan, math.inf),
    "decay": (0.0, 1.0, math.nan),
    "search": ("random", None),
    "method": ("hand", None),
    "segmentation": ("lives", None),
    "loops": ("cut", 1),
}


@pytest.mark.parametrize("name", OUT_OF_RANGE)
def test_settings_out_of_range(name: str) -> None:
    for value in OUT_OF_RANGE[name]:
        with pytest.raises(ValueError, match=rf"^DiscoverySettings: {name} should be .*, got {value!r}$"):
            DiscoverySettings(**{name: value})


def test_every_setting_has_a_range() -> None:
    """A new field needs a row above."""
    assert {f.name for f in dataclasses.fields(DiscoverySettings)} == {*OUT_OF_RANGE}
