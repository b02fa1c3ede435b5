"""What a user is told where nothing is discovered."""

import logging
from typing import Any

import numpy as np
import pytest

from sb3_options.discovery.diary import SILENT_TRAJECTORIES
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.settings import DiscoverySettings
from tests.discovery.lines import peaks_of, said
from tests.support.helpers import trajectory_of


def add(discovery: Discovery, n: int = 1, **kwargs: Any) -> None:
    for _ in range(n):
        trajectory = trajectory_of([np.array([float(x)]) for x in (0, 5, 20)], **kwargs)
        discovery.add(trajectory, np.asarray(trajectory.states))


@pytest.mark.parametrize(
    ("kwargs", "outcome", "text"),
    [
        ({}, {"terminated": True, "rewards": [-1.0, -100.0]}, "(20 terminated, 0 truncated, returns -101 to -101)."),
        ({}, {"terminated": True, "rewards": [0.0, 0.0]}, "or let PPO or A2C explore by"),
        ({"settings": DiscoverySettings(segmentation="peaks")}, {"is_success": False}, "no success in 20 segments"),
    ],
    ids=["counts", "no reward", "segments"],
)
def test_there_is_one_warning_where_nothing_succeeds(
    kwargs: Any, outcome: Any, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    discovery = Discovery(**kwargs)
    with caplog.at_level(logging.WARNING, "sb3_options"):
        add(discovery, SILENT_TRAJECTORIES - 1, **outcome)
        assert not caplog.records
        add(discovery, **outcome)
        assert len(caplog.records) == 1
        assert text in discovery.why_nothing()
        add(discovery, 2 * SILENT_TRAJECTORIES, **outcome)
    assert len(caplog.records) == 1
    assert said(discovery) == discovery.why_nothing()


def test_there_is_none_where_one_succeeds(caplog: pytest.LogCaptureFixture) -> None:
    discovery = Discovery()
    add(discovery, is_success=True)
    add(discovery, 3 * SILENT_TRAJECTORIES, is_success=False)
    assert not caplog.records
    assert discovery.why_nothing() == (
        "No subgoal was discovered: 1 of 61 episodes succeeded; a search needs 4. Train for longer."
    )


@pytest.mark.parametrize(
    ("settings", "remedy"),
    [
        ({"start_radius": 99.0}, "Lower start_radius, goal_radius (--discovery.start-radius, .goal-radius)."),
        ({"start_radius": 0.0, "goal_radius": 0.0, "min_passing": 0.99}, "Lower min_passing (--discovery.min-passing)"),
    ],
)
def test_the_filter_that_leaves_nothing_is_named(settings: Any, remedy: str) -> None:
    discovery = Discovery(DiscoverySettings(min_positive=2, scale=1.0, **settings))
    add(discovery, 3, is_success=True)
    assert discovery.search() is None
    why = discovery.why_nothing()
    assert "3 of 3 episodes succeeded, but fewer than 2 of them pass a state that" in why
    assert remedy in why


def test_after_a_search() -> None:
    settings = DiscoverySettings(min_positive=2, start_radius=1.0, goal_radius=1.0, scale=1.0, min_passing=0.5)
    discovery = Discovery(settings)
    add(discovery, 2, is_success=True)
    assert discovery.search() is None
    assert peaks_of(discovery).evidence is not None
    why = "no peak of diverse density persisted (threshold) in 2 episodes. Train for longer."
    assert discovery.why_nothing() == said(discovery) == f"No subgoal was discovered: {why}"
