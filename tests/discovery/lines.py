"""Trajectories along a line, and settings with which a few of them are searched."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from sb3_options.discovery.bags import FilteredBags
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.figures import subgoals_figure
from sb3_options.discovery.methods.diverse_density import PersistentPeaks
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import Trajectory
from sb3_options.options.bank import OptionBank
from tests.support.helpers import trajectory_of

SMALL: dict[str, Any] = {
    "min_positive": 1, "start_radius": 0.0, "goal_radius": 0.0, "search": "exhaustive", "decay": 0.5, "threshold": 0.4,
    "negative_strength": 1.0, "loops": "keep", "min_passing": 0.0, "leak": 0.0, "search_growth": 0.0,
}  # fmt: skip
"""The paper's bags and diverse density, of few trajectories, which may be searched again and again."""

SEARCHES: tuple[Literal["gradient", "exhaustive"], ...] = ("gradient", "exhaustive")


def settings_of(**changes: Any) -> DiscoverySettings:
    return DiscoverySettings(**{**SMALL, **changes})


def on_a_line(*places: float, success: bool = True) -> tuple[Trajectory, FloatArray]:
    """A trajectory and its features: the places themselves."""
    trajectory = trajectory_of([np.array([float(p)]) for p in places], is_success=success)
    return trajectory, np.asarray(trajectory.states)


def walked(discovery: Discovery, *ways: Sequence[float]) -> Discovery:
    """The same after a success along each way."""
    for way in ways:
        discovery.add(*on_a_line(*way))
    return discovery


def found(discovery: Discovery) -> list[float] | None:
    subgoal = discovery.search()
    return None if subgoal is None else subgoal.points.ravel().tolist()


def peaks_of(discovery: Discovery) -> PersistentPeaks:
    """Its method, where that is diverse density on all features."""
    assert isinstance(discovery.method, PersistentPeaks)
    return discovery.method


def bags_of(discovery: Discovery) -> FilteredBags | None:
    return peaks_of(discovery).bags(discovery.experience([*discovery.database][-1]))


def said(discovery: Discovery, text: str | None = None) -> str:
    """What the figure says where there is no map."""
    (shown,) = subgoals_figure(discovery, OptionBank(4, 2), text).axes[0].texts
    return " ".join(shown.get_text().split())
