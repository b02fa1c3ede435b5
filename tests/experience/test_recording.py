"""Recorders by hand: whole episodes, and segments between peaks of reward."""

from typing import Any

import numpy as np
import pytest

from sb3_options.experience import recording
from sb3_options.experience.recording import SegmentRecorder, TrajectoryRecorder
from sb3_options.experience.trajectories import Trajectory


def ended(recorder: TrajectoryRecorder, **kwargs: Any) -> Trajectory:
    """What the recorder makes of the end of an episode."""
    recorder.end(**{"terminated": True, "truncated": False, "is_success": None, **kwargs})
    return recorder.finished[-1]


def test_each_distinct_observation_is_stored_once_in_order_of_first_visit() -> None:
    recorder = TrajectoryRecorder()
    recorder.begin(7)
    for action, observation in ((1, 3), (0, 7), (2, 5), (1, 3)):
        recorder.record(action, 10.0 * action, observation)
    trajectory = ended(recorder, is_success=True)
    assert np.asarray(trajectory.states).tolist() == [7, 3, 5]
    assert trajectory.visits.tolist() == [0, 1, 0, 2, 1]
    assert trajectory.actions.tolist() == [1, 0, 2, 1]
    assert trajectory.rewards.tolist() == [10.0, 0.0, 20.0, 10.0]
    assert (trajectory.terminated, trajectory.truncated, trajectory.is_success) == (True, False, True)
    assert len(trajectory) == 4


def test_dictionaries_written_in_place_are_copied() -> None:
    observation = {"a": np.zeros(2), "b": np.zeros(1, dtype=np.int64)}
    recorder = TrajectoryRecorder()
    recorder.begin(observation)
    for value in (1, 2, 1):
        observation["a"][:] = value
        observation["b"][:] = -value
        recorder.record(0, 0.0, observation)
    trajectory = ended(recorder)
    assert not isinstance(trajectory.states, np.ndarray)
    np.testing.assert_array_equal(trajectory.states["a"], [[0, 0], [1, 1], [2, 2]])
    np.testing.assert_array_equal(trajectory.states["b"], [[0], [-1], [-2]])
    assert trajectory.visits.tolist() == [0, 1, 2, 1]


def segments(
    rewards: list[float], *, max_segment: int = 1000, terminated: bool = False, truncated: bool = False
) -> list[tuple[int, int, bool | None]]:
    """First state, last state and success of each segment; step t leads from state t to t + 1."""
    recorder = SegmentRecorder(max_segment)
    recorder.begin(np.array([0]))
    for t, reward in enumerate(rewards):
        recorder.record(0, reward, np.array([t + 1]))
    if terminated or truncated:
        recorder.end(terminated=terminated, truncated=truncated, is_success=None)
    return [(int(states_of(s)[0]), int(states_of(s)[-1]), s.is_success) for s in recorder.finished]


def states_of(segment: Trajectory) -> Any:
    return np.asarray(segment.states)[segment.visits].ravel()


@pytest.mark.parametrize(
    ("rewards", "expected"),
    [
        ([0, 0, 1, 0, 0], [(0, 3, True)]),
        ([0, 0, 1], []),  # the next reward may be higher
        ([0, 1, 0, 0, 1, 0], [(0, 2, True), (2, 5, True)]),
        ([0.1, 0.2, 0.9, 0.4, 0.3], [(0, 3, True)]),  # a climb peaks at its top
        ([0, 1, 1, 1, 0], [(0, 2, True)]),  # a plateau peaks where it began
        ([1, 0], [(0, 1, True)]),  # nothing lies before the first step
        ([0, -1, -0.5, -1, 0], []),
        ([0.0, float("nan"), 0.0], []),
    ],
)
def test_peaks_by_hand(rewards: list[float], expected: list[Any]) -> None:
    assert segments(rewards) == expected


def test_a_segment_too_long_without_a_peak() -> None:
    assert segments([0] * 7, max_segment=3) == [(0, 3, False), (3, 6, False)]
    assert segments([0, 0, 1, 0], max_segment=3) == [(0, 3, True)]
    # Where the reward still rises there is no peak yet.
    assert segments([1, 2, 3, 4, 5], max_segment=2) == [(0, 2, False), (2, 4, False)]
    assert segments([0, 0, 0, 0, 1, 3, 0], max_segment=5) == [(0, 5, False), (5, 6, True)]
    assert segments([0, 0, 1], max_segment=3, truncated=True) == [(0, 3, True)]


def test_an_episode_may_have_as_many_steps_as_the_longest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "LONGEST_EPISODE", 5)
    for length, n_finished in ((4, 1), (5, 1), (6, 0)):
        recorder = TrajectoryRecorder()
        recorder.begin(np.array([0]))
        for t in range(length):
            recorder.record(0, 0.0, np.array([t + 1]))
        recorder.end(terminated=True, truncated=False, is_success=None)
        assert len(recorder.finished) == n_finished


def test_a_segment_at_the_end_of_an_episode() -> None:
    assert segments([0, 0, 1], truncated=True) == segments([0, 0, 1], terminated=True) == [(0, 3, True)]
    assert segments([0, 1, 0, 0], terminated=True) == [(0, 2, True), (2, 4, False)]
    # What was under way might have led to a peak.
    assert segments([0, 1, 0, 0], truncated=True) == [(0, 2, True)]
    assert segments([0, 0, 0], max_segment=3, terminated=True) == [(0, 3, False)]


def test_nothing_is_lost_and_memory_is_bounded() -> None:
    rng = np.random.default_rng(0)
    recorder = SegmentRecorder(max_segment=40)
    recorder.begin(np.array([0]))
    cut: list[Trajectory] = []
    for t in range(5000):
        recorder.record(int(rng.integers(4)), float(rng.random() < 0.02), np.array([t + 1]))
        assert len(recorder) <= 40
        cut += recorder.finished
        recorder.finished.clear()
    joined = [states_of(cut[0])[0], *(s for segment in cut for s in states_of(segment)[1:])]
    assert joined == list(range(len(joined)))
    assert len(joined) > 5000 - 42
    assert {len(s) for s in cut if not s.is_success} == {40}
    assert all(s.rewards[-1] == 1.0 for s in cut if s.is_success)
