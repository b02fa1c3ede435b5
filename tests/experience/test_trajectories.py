import logging
import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import OptionsWrapper
from sb3_options.experience import trajectories
from sb3_options.experience.trajectories import EpisodeRecorder, Trajectory, TrajectoryDatabase, TrajectoryRecorder
from tests.support.helpers import CountingEnv, DictEnv, line, place_of, steady_option


def ended(recorder: TrajectoryRecorder, **kwargs: Any) -> Trajectory:
    """What the recorder makes of the end of an episode."""
    recorder.end(**{"terminated": True, "truncated": False, "is_success": None, **kwargs})
    return recorder.finished[-1]


def record(observations: list[Any], actions: list[int]) -> EpisodeRecorder:
    recorder = EpisodeRecorder()
    recorder.begin(observations[0])
    for action, observation in zip(actions, observations[1:], strict=True):
        recorder.record(action, 10.0 * action, observation)
    return recorder


def test_each_distinct_observation_is_stored_once_in_order_of_first_visit() -> None:
    trajectory = ended(record([7, 3, 7, 5, 3], [1, 0, 2, 1]), is_success=True)
    assert np.asarray(trajectory.states).tolist() == [7, 3, 5]
    assert trajectory.visits.tolist() == [0, 1, 0, 2, 1]
    assert trajectory.actions.tolist() == [1, 0, 2, 1]
    assert trajectory.rewards.tolist() == [10.0, 0.0, 20.0, 10.0]
    assert (trajectory.terminated, trajectory.truncated, trajectory.is_success) == (True, False, True)
    assert len(trajectory) == 4


def test_begin_forgets_the_episode_before() -> None:
    recorder = record([1, 2, 3], [0, 0])
    recorder.begin(9)
    trajectory = ended(recorder, terminated=False, truncated=True)
    assert np.asarray(trajectory.states).tolist() == [9]
    assert (len(trajectory), trajectory.visits.tolist(), trajectory.is_success) == (0, [0], None)
    assert trajectory.actions.dtype == trajectory.visits.dtype == np.int64


def test_observations_written_in_place_are_copied() -> None:
    array = np.zeros(2)
    recorder = EpisodeRecorder()
    recorder.begin(array)
    for i in range(1, 4):
        array[:] = i
        recorder.record(0, 0.0, array)
    states = ended(recorder).states
    np.testing.assert_array_equal(states, [[0, 0], [1, 1], [2, 2], [3, 3]])


def test_dictionaries_written_in_place_are_copied() -> None:
    observation = {"a": np.zeros(2), "b": np.zeros(1, dtype=np.int64)}
    recorder = EpisodeRecorder()
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


def test_dict_observations_by_way_of_the_wrapper() -> None:
    env = OptionsWrapper(DictEnv(), feature_map=place_of)
    env.record_trajectories(True)
    env.reset(seed=0)
    first = int(env.unwrapped.place)  # type: ignore[attr-defined]  # of DictEnv
    over, n_steps, info = False, 0, dict[str, Any]()
    while not over:
        assert "trajectory" not in info
        _, _, over, _, info = env.step(1)
        n_steps += 1
    trajectory = info["trajectory"]
    assert place_of(trajectory.states).ravel().tolist() == list(range(first, 10))
    assert (len(trajectory), trajectory.terminated, trajectory.is_success) == (n_steps, True, None)


def test_the_wrapper_records_primitive_steps_inside_options() -> None:
    env = OptionsWrapper(CountingEnv(terminate_at=5), max_options=2)
    env.bank.add(steady_option(1, max_duration=3), 0)
    env.record_trajectories(True)
    env.reset(seed=0)
    env.step(2)
    env.step(0)
    info = env.step(3)[4]
    drawn = int(info["option"]["actions"][0])
    trajectory = info["trajectory"]
    assert trajectory.actions.tolist() == [1, 1, 1, 0, drawn]
    assert trajectory.rewards.tolist() == [1, 2, 3, 4, 5]
    assert np.asarray(trajectory.states).ravel().tolist() == [0, 1, 2, 3, 4, 5]


def test_recording_can_begin_and_end_at_any_time() -> None:
    env = OptionsWrapper(CountingEnv(truncate_at=4))
    env.reset(seed=0)
    env.step(0)
    env.record_trajectories(True)
    env.record_trajectories(True)
    for _ in range(2):
        env.step(1)
    trajectory = env.step(0)[4]["trajectory"]
    assert np.asarray(trajectory.states).ravel().tolist() == [1, 2, 3, 4]
    assert (trajectory.actions.tolist(), trajectory.truncated) == ([1, 1, 0], True)
    env.record_trajectories(False)
    env.reset()
    assert all("trajectory" not in env.step(0)[4] for _ in range(4))


def test_is_success_of_the_last_step() -> None:
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", map="SG", success_probability=1.0))
    env.record_trajectories(True)
    env.reset(seed=0)
    assert env.step(3)[4]["trajectory"].is_success is True


def test_an_info_dictionary_used_again_does_not_bring_the_trajectory_back() -> None:
    shared: dict[str, Any] = {}
    env = OptionsWrapper(
        CountingEnv(step=lambda env, _: (np.array([float(env.time)]), 0.0, env.time == 2, False, shared))
    )
    env.record_trajectories(True)
    env.reset(seed=0)
    env.step(0)
    assert "trajectory" in env.step(0)[4]
    env.reset()
    assert "trajectory" not in env.step(0)[4]
    assert shared == {}


def test_what_never_ends_is_forgotten(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectories, "LONGEST_EPISODE", 50)
    env = OptionsWrapper(CountingEnv(truncate_at=120))
    env.record_trajectories(True)
    env.reset(seed=0)
    recorder = env._recorder
    assert recorder is not None
    with caplog.at_level(logging.WARNING, "sb3_options"):
        infos = [env.step(0)[4] for _ in range(120)]
    assert not any("trajectory" in info for info in infos)
    assert (len(recorder), len(recorder.finished)) == (0, 0)
    (warning,) = caplog.messages
    assert re.search(r"has not ended after 50 primitive steps .+DiscoverySettings\(segmentation='peaks'\)", warning)
    env.reset()
    assert [env.step(0)[0].item() for _ in range(20)][-1] == 20
    assert len(recorder) == 20


class TestDatabase:
    def test_keeps_the_last_n(self) -> None:
        database = TrajectoryDatabase(3)
        trajectories = [line([i, i + 1]) for i in range(7)]
        for n, trajectory in enumerate(trajectories, start=1):
            database.add(trajectory)
            assert len(database) == min(n, 3)
        assert [id(t) for t in database] == [id(t) for t in trajectories[4:]]

    @pytest.mark.parametrize("capacity", [0, -1])
    def test_capacity(self, capacity: int) -> None:
        with pytest.raises(ValueError, match=rf"^capacity must be at least 1 trajectory, got {capacity}\.$"):
            TrajectoryDatabase(capacity)
