"""Segments between peaks of reward, by hand, through the wrapper, and for discovery."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # type: ignore[import-untyped]  # no stubs

from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.experience.recording import RewardPeaks, SegmentRecorder
from sb3_options.experience.trajectories import Trajectory
from tests.support.helpers import CountingEnv, steady_option
from tests.support.sb3_helpers import DOORWAY, FAST_DISCOVERY, RANDOM, TINY, optioned_rooms

NEVER_ENDS: dict[str, Any] = {"continuing": True, "max_steps": None}


def segments(
    rewards: list[float],
    *,
    peak_reward: float | None = None,
    max_segment: int = 1000,
    terminated: bool = False,
    truncated: bool = False,
) -> list[tuple[int, int, bool | None]]:
    """First state, last state and success of each segment; step t leads from state t to t + 1."""
    recorder = SegmentRecorder(RewardPeaks(peak_reward, max_segment))
    recorder.begin(np.array([0]))
    for t, reward in enumerate(rewards):
        recorder.record(0, reward, np.array([t + 1]))
    if terminated or truncated:
        recorder.end(terminated=terminated, truncated=truncated, is_success=None)
    return [(int(states_of(s)[0]), int(states_of(s)[-1]), s.is_success) for s in recorder.finished]


def states_of(segment: Trajectory) -> Any:
    return np.asarray(segment.states)[segment.visits].ravel()


class TestCuts:
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
    def test_by_hand(self, rewards: list[float], expected: list[Any]) -> None:
        assert segments(rewards) == expected

    def test_the_least_reward_of_a_peak(self) -> None:
        rewards: list[float] = [0, 1, 0, 5, 0, -3, -1, -3]
        assert segments(rewards) == [(0, 2, True), (2, 4, True)]
        assert segments(rewards, peak_reward=5) == [(0, 4, True)]
        assert segments(rewards, peak_reward=5.1) == []
        assert segments(rewards, peak_reward=-1) == [(0, 2, True), (2, 4, True), (4, 7, True)]

    def test_too_long_without_a_peak(self) -> None:
        assert segments([0] * 7, max_segment=3) == [(0, 3, False), (3, 6, False)]
        assert segments([0, 0, 1, 0], max_segment=3) == [(0, 3, True)]
        assert segments([1, 2, 3, 4, 5], max_segment=2) == [(0, 2, True), (2, 4, True)]

    def test_the_end_of_an_episode(self) -> None:
        assert segments([0, 0, 1], truncated=True) == segments([0, 0, 1], terminated=True) == [(0, 3, True)]
        assert segments([0, 1, 0, 0], terminated=True) == [(0, 2, True), (2, 4, False)]
        # What was under way might have led to a peak.
        assert segments([0, 1, 0, 0], truncated=True) == [(0, 2, True)]
        assert segments([0, 0, 0], max_segment=3, terminated=True) == [(0, 3, False)]

    def test_a_new_episode_starts_anew(self) -> None:
        recorder = SegmentRecorder(RewardPeaks())
        recorder.begin(np.array([0]))
        recorder.record(0, 5.0, np.array([1]))
        recorder.begin(np.array([7]))
        recorder.record(0, 1.0, np.array([8]))
        recorder.record(0, 0.0, np.array([9]))
        (segment,) = recorder.finished
        assert states_of(segment).tolist() == [7, 8]
        assert (segment.terminated, segment.truncated, segment.rewards.tolist()) == (False, False, [1.0])

    def test_nothing_is_lost_and_memory_is_bounded(self) -> None:
        rng = np.random.default_rng(0)
        recorder = SegmentRecorder(RewardPeaks(max_segment=40))
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


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"peak_reward": float("nan")}, r"^peak_reward must be finite, got nan\.$"),
        ({"max_segment": 0}, r"^max_segment must be a whole number of primitive steps, at least 1, got 0\.$"),
        ({"max_segment": 2.5}, r"^max_segment must be a whole number"),
    ],
)
def test_values_out_of_range(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RewardPeaks(**kwargs)


class TestWrapper:
    def wrapped(self, peaks: RewardPeaks | None = None, **kwargs: Any) -> OptionsWrapper:
        """Rewards 1 at every third step."""

        def step(env: CountingEnv, action: int) -> Any:
            return np.array([float(env.time)]), float(env.time % 3 == 0), False, env.time == 12, {}

        env = OptionsWrapper(CountingEnv(step=step), **kwargs)
        env.record_trajectories(True, peaks or RewardPeaks())
        env.reset(seed=0)
        return env

    def test_a_segment_comes_one_step_after_its_peak(self) -> None:
        env = self.wrapped()
        infos = [env.step(0)[4] for _ in range(8)]
        assert [i for i, info in enumerate(infos) if "segments" in info] == [3, 6]
        assert [states_of(s).tolist() for s in infos[6]["segments"]] == [[3, 4, 5, 6]]
        assert not any("trajectory" in info for info in infos)

    def test_several_while_one_option_runs(self) -> None:
        env = self.wrapped()
        env.bank.add(steady_option(1, max_duration=8))
        env.step(0)
        info = env.step(2)[4]
        assert [states_of(s).tolist() for s in info["segments"]] == [[0, 1, 2, 3], [3, 4, 5, 6]]
        assert info["segments"][0].actions.tolist() == [0, 1, 1]
        later = env.step(0)[4]
        assert [states_of(s).tolist() for s in later["segments"]] == [[6, 7, 8, 9]]
        assert len(info["segments"]) == 2
        assert "segments" not in env.step(0)[4]

    def test_the_end_of_an_episode_inside_an_option(self) -> None:
        env = self.wrapped()
        env.bank.add(steady_option(1, max_duration=100))
        info = env.step(2)[4]
        assert info["option"]["termination"] == "truncated"
        assert [states_of(s)[-1] for s in info["segments"]] == [3, 6, 9, 12]
        env.reset()
        assert "segments" not in env.step(0)[4]

    def test_another_way_to_cut_replaces_the_first(self) -> None:
        env = self.wrapped()
        env.step(0)
        env.record_trajectories(True, RewardPeaks())  # the same again changes nothing
        assert len(env._recorder or ()) == 1
        env.record_trajectories(True)
        infos = [env.step(0)[4] for _ in range(11)]
        assert not any("segments" in info for info in infos)
        assert states_of(infos[-1]["trajectory"]).tolist() == list(range(1, 13))

    def test_travels_between_processes(self) -> None:
        assert pickle.loads(pickle.dumps(RewardPeaks(0.5, 7))) == RewardPeaks(0.5, 7)


def make_endless_rooms() -> OptionsWrapper:
    """What a worker process calls."""
    return optioned_rooms(**NEVER_ENDS)


PEAKS: dict[str, Any] = {
    **FAST_DISCOVERY,
    "start_radius": 3.0,  # a segment begins where the last one ended: at the goal
    "segmentation": "peaks",
    "max_segment": 400,
}


def learned(env: Any, settings: dict[str, Any] = PEAKS, **kwargs: Any) -> SubgoalDiscoveryCallback:
    """A callback that has seen 6,000 random steps."""
    callback = SubgoalDiscoveryCallback(settings, max_new_options=1)
    model = DQN("MlpPolicy", env, gamma=0.9, replay_buffer_class=OptionReplayBuffer, **TINY | RANDOM | kwargs)
    model.learn(6000, callback=callback)
    return callback


class TestDiscovery:
    @pytest.mark.parametrize("venv", [DummyVecEnv, SubprocVecEnv])
    def test_finds_the_doorway_in_rooms_that_never_end(self, venv: Any) -> None:
        env = venv([make_endless_rooms, make_endless_rooms])
        callback = learned(env)
        env.close()
        (found,) = callback.discoveries
        assert np.abs(found.subgoal - DOORWAY).sum() <= 1
        assert 3 <= found.episode <= callback.episodes
        assert callback.discovery is not None
        assert all(len(t.trajectory) <= 400 for t in callback.discovery.database)

    def test_without_segments_nothing_is_found(self) -> None:
        callback = learned(make_endless_rooms(), FAST_DISCOVERY)
        assert (callback.episodes, callback.discoveries) == (0, [])

    def test_where_episodes_are_cut_off_by_time(self) -> None:
        callback = learned(optioned_rooms(continuing=True, max_steps=500))
        assert np.abs(callback.discoveries[0].subgoal - DOORWAY).sum() <= 1

    def test_the_log_is_written_though_no_episode_ends(self, tmp_path: Path) -> None:
        learned(make_endless_rooms(), tensorboard_log=str(tmp_path))
        scalars = EventAccumulator(str(tmp_path / "DQN_1"))
        scalars.Reload()
        steps = [event.step for event in scalars.Scalars("options/count")]
        assert len(steps) > 3
        assert steps == sorted(steps)
        assert scalars.Scalars("options/count")[-1].value == 1
