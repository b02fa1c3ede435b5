"""What a user is told where nothing is discovered."""

import logging
from typing import Any

import numpy as np
import pytest

from sb3_options.discovery.diary import SILENT_TRAJECTORIES
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.figures import subgoals_figure
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.options.bank import OptionBank
from tests.discovery.lines import peaks_of
from tests.support.helpers import trajectory_of


def add(discovery: Discovery, n: int = 1, **kwargs: Any) -> None:
    for _ in range(n):
        trajectory = trajectory_of([np.array([float(x)]) for x in (0, 5, 20)], **kwargs)
        discovery.add(trajectory, np.asarray(trajectory.states))


FOR_TRAIN_PY = "On the command line and in YAML that is success: terminated, or success: return:NUMBER."


@pytest.mark.parametrize(
    ("kwargs", "outcome", "text"),
    [
        (
            {},
            {"terminated": True, "rewards": [-1.0, -100.0]},
            "none of the 20 episodes seen counts as a success. 20 ended in a terminal state, 0 were cut off, with "
            'returns from -101 to -101; the environment reports no info["is_success"], and no terminal state brought '
            "a positive reward above all earlier ones. Say what success is: "
            "SubgoalDiscoveryCallback(success=lambda trajectory: trajectory.terminated) where every terminal state is "
            "a good one, or sb3_options.experience.success.success_by_return(threshold). " + FOR_TRAIN_PY,
        ),
        (
            {},
            {"terminated": True, "rewards": [0.0, 0.0]},
            "none of the 20 episodes seen counts as a success. 20 ended in a terminal state, 0 were cut off, with "
            'returns from 0 to 0; the environment reports no info["is_success"], and no terminal state brought a '
            "positive reward above all earlier ones. If the goal is a reward, it was not found so far: explore more. "
            "Else say what success is: SubgoalDiscoveryCallback(success=lambda trajectory: trajectory.terminated) "
            "where every terminal state is a good one, or sb3_options.experience.success.success_by_return(threshold). "
            + FOR_TRAIN_PY,
        ),
        (
            {},
            {"rewards": [-1.0, -1.0]},
            "none of the 20 episodes seen counts as a success. 0 ended in a terminal state, 20 were cut off, with "
            'returns from -2 to -2; the environment reports no info["is_success"], and no terminal state brought a '
            "positive reward above all earlier ones. All went alike, so perhaps the goal was not found so far: explore "
            "more. Else say what success is: SubgoalDiscoveryCallback(success=lambda trajectory: "
            "trajectory.terminated) where every terminal state is a good one, or "
            "sb3_options.experience.success.success_by_return(threshold). " + FOR_TRAIN_PY,
        ),
        (
            {},
            {"is_success": False},
            "none of the 20 episodes seen counts as a success. 0 ended in a terminal state, 20 were cut off, with "
            'returns from 0 to 0; info["is_success"] was false in all of them. If it means something else, pass '
            "success=...",
        ),
        (
            {"success": lambda trajectory: False},
            {"is_success": True},
            "none of the 20 episodes seen counts as a success. 0 ended in a terminal state, 20 were cut off, with "
            "returns from 0 to 0; the rule given as success=... was true of none of them.",
        ),
        (
            {"settings": DiscoverySettings(segmentation="peaks")},
            {"is_success": False},
            "none of the 20 segments seen ended with a peak of reward. Choose max_segment of "
            "DiscoverySettings for this task.",
        ),
    ],
    ids=["nothing reported", "no reward", "all alike", "reported", "a rule of the user", "segments"],
)
def test_there_is_one_warning_where_nothing_succeeds(
    kwargs: Any, outcome: Any, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    discovery = Discovery(**kwargs)
    with caplog.at_level(logging.WARNING, "sb3_options"):
        add(discovery, SILENT_TRAJECTORIES - 1, **outcome)
        assert not caplog.records
        add(discovery, **outcome)
        assert [record.getMessage() for record in caplog.records] == [f"Nothing can be discovered so far: {text}"]
        assert discovery.why_nothing() == f"No subgoal was discovered: {text}"
        add(discovery, 2 * SILENT_TRAJECTORIES, **outcome)
    assert len(caplog.records) == 1
    (shown,) = subgoals_figure(discovery, OptionBank(4, 2)).axes[0].texts
    assert " ".join(shown.get_text().split()) == discovery.why_nothing()


def test_there_is_none_where_one_succeeds(caplog: pytest.LogCaptureFixture) -> None:
    discovery = Discovery()
    add(discovery, is_success=True)
    add(discovery, 3 * SILENT_TRAJECTORIES, is_success=False)
    assert not caplog.records
    assert discovery.why_nothing() == (
        "No subgoal was discovered: 1 of 61 episodes were successful; a search needs 4 (min_positive) of which the "
        "filters leave something."
    )


def test_filters_that_leave_nothing_are_named() -> None:
    discovery = Discovery(DiscoverySettings(min_positive=2, start_radius=99.0))
    add(discovery, 3, is_success=True)
    assert discovery.search() is None
    assert discovery.why_nothing().endswith(
        "3 of 3 episodes were successful; a search needs 2 (min_positive) of which the filters leave something. They "
        "leave out what is near start and goal (start_radius, goal_radius), near the subgoal of an option (spacing), "
        "and what few ways lead through (min_passing, min_cut)."
    )


def test_after_a_search() -> None:
    discovery = Discovery(
        DiscoverySettings(min_positive=2, start_radius=1.0, goal_radius=1.0, scale=1.0, min_passing=0.5)
    )
    add(discovery, 2, is_success=True)
    assert discovery.search() is None
    assert peaks_of(discovery).evidence is not None
    text = "No subgoal was discovered: no peak of diverse density persisted long enough."
    assert discovery.why_nothing() == text
    title = subgoals_figure(discovery, OptionBank(4, 2)).get_suptitle()
    assert " ".join(title.split()) == text
