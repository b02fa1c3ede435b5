"""Primitive steps recorded beneath `OptionsWrapper`, and reported above it."""

import logging
import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import OptionsWrapper
from sb3_options.execution.recording import RecordTrajectories
from sb3_options.experience import recording
from sb3_options.experience.recording import TrajectoryRecorder
from sb3_options.experience.trajectories import Trajectory
from tests.support.helpers import CountingEnv, steady_option


def states_of(segment: Trajectory) -> Any:
    return np.asarray(segment.states)[segment.visits].ravel()


def recorder_in(env: OptionsWrapper) -> TrajectoryRecorder:
    assert env._recording is not None
    assert env._recording.recorder is not None
    return env._recording.recorder


def test_the_wrapper_records_primitive_steps_inside_options() -> None:
    env = OptionsWrapper(CountingEnv(terminate_at=5), max_options=2)
    env.bank.add(steady_option(1, max_duration=3), 0)
    env.set_slots(record=True)
    env.reset(seed=0)
    env.step(2)
    env.step(0)
    info = env.step(3)[4]
    drawn = int(info["option"]["actions"][0])
    trajectory = info["trajectory"]
    assert (trajectory.actions.tolist(), trajectory.rewards.tolist()) == ([1, 1, 1, 0, drawn], [1, 2, 3, 4, 5])
    assert states_of(trajectory).tolist() == [0, 1, 2, 3, 4, 5]


def test_recording_can_begin_and_end_at_any_time() -> None:
    env = OptionsWrapper(CountingEnv(truncate_at=4))
    env.reset(seed=0)
    env.step(0)
    for action in (1, 1):
        env.set_slots(record=True)
        env.step(action)
    trajectory = env.step(0)[4]["trajectory"]
    assert states_of(trajectory).tolist() == [1, 2, 3, 4]
    assert (trajectory.actions.tolist(), trajectory.truncated) == ([1, 1, 0], True)
    env.set_slots(record=False)
    env.reset()
    assert all("trajectory" not in env.step(0)[4] for _ in range(4))


@pytest.mark.parametrize("max_segment", [None, 7])
def test_it_goes_on_from_a_checkpoint(max_segment: int | None) -> None:
    """Rewards grow until the end, so that nothing is cut before."""
    inner = CountingEnv(
        step=lambda env, _: (np.array([float(env.time)]), float(env.time), env.time == 3, False, {"is_success": True})
    )
    env, later = RecordTrajectories(inner), RecordTrajectories(inner)
    env.set(True, max_segment, None)
    env.reset()
    env.step(1)
    later.set_state(env.get_state())
    later.step(0)
    later.step(1)
    report = later.take()
    whole = report["trajectory"] if max_segment is None else report["segments"][0]
    assert (whole.actions.tolist(), states_of(whole).tolist()) == ([1, 0, 1], [0, 1, 2, 3])
    assert (whole.is_success, later.max_segment) == (True, max_segment)
    later.set_state(RecordTrajectories(inner).get_state())
    assert later.take() == {}


def test_an_info_dictionary_used_again_does_not_bring_the_trajectory_back() -> None:
    shared: dict[str, Any] = {}
    env = OptionsWrapper(
        CountingEnv(step=lambda env, _: (np.array([float(env.time)]), 0.0, env.time == 2, False, shared))
    )
    env.set_slots(record=True)
    env.reset(seed=0)
    env.step(0)
    assert "trajectory" in env.step(0)[4]
    env.reset()
    assert "trajectory" not in env.step(0)[4]
    assert shared == {}


def test_what_never_ends_is_forgotten(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "LONGEST_EPISODE", 50)
    env = OptionsWrapper(CountingEnv(truncate_at=120))
    env.set_slots(record=True)
    env.reset(seed=0)
    recorder = recorder_in(env)
    with caplog.at_level(logging.WARNING, "sb3_options"):
        infos = [env.step(0)[4] for _ in range(120)]
    assert not any("trajectory" in info for info in infos)
    assert (len(recorder), len(recorder.finished)) == (0, 0)
    (warning,) = caplog.messages
    assert re.search(r"has not ended after 50 primitive steps .+DiscoverySettings\(segmentation='peaks'\)", warning)
    env.reset()
    assert [env.step(0)[0].item() for _ in range(20)][-1] == 20
    assert len(recorder) == 20


def cut_at_peaks(max_segment: int = 10_000, **kwargs: Any) -> OptionsWrapper:
    """Rewards 1 at every third step."""

    def step(env: CountingEnv, action: int) -> Any:
        return np.array([float(env.time)]), float(env.time % 3 == 0), False, env.time == 12, {}

    env = OptionsWrapper(CountingEnv(step=step), **kwargs)
    env.set_slots(record=True, max_segment=max_segment)
    env.reset(seed=0)
    return env


def test_a_segment_comes_one_step_after_its_peak() -> None:
    env = cut_at_peaks()
    infos = [env.step(0)[4] for _ in range(8)]
    assert [i for i, info in enumerate(infos) if "segments" in info] == [3, 6]
    assert [states_of(s).tolist() for s in infos[6]["segments"]] == [[3, 4, 5, 6]]
    assert not any("trajectory" in info for info in infos)


def test_several_while_one_option_runs() -> None:
    env = cut_at_peaks()
    env.bank.add(steady_option(1, max_duration=8))
    env.step(0)
    info = env.step(2)[4]
    assert [states_of(s).tolist() for s in info["segments"]] == [[0, 1, 2, 3], [3, 4, 5, 6]]
    assert info["segments"][0].actions.tolist() == [0, 1, 1]
    later = env.step(0)[4]
    assert [states_of(s).tolist() for s in later["segments"]] == [[6, 7, 8, 9]]
    assert len(info["segments"]) == 2
    assert "segments" not in env.step(0)[4]


def test_another_way_to_cut_replaces_the_first() -> None:
    env = cut_at_peaks()
    env.step(0)
    env.set_slots(record=True, max_segment=10_000)  # the same again changes nothing
    assert len(recorder_in(env)) == 1
    env.set_slots(record=True, max_segment=None)
    infos = [env.step(0)[4] for _ in range(11)]
    assert not any("segments" in info for info in infos)
    assert states_of(infos[-1]["trajectory"]).tolist() == list(range(1, 13))


def test_it_stands_beneath_a_monitor_and_is_no_part_of_the_spec() -> None:
    env = OptionsWrapper(Monitor(CountingEnv()))
    env.set_slots(record=True)
    assert [type(each) for each in (env.env, env.env.env)] == [Monitor, RecordTrajectories]  # type: ignore[attr-defined]
    again = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"))
    spec = again.spec
    again.set_slots(record=True)
    assert isinstance(again.env, RecordTrajectories)
    assert again.spec == spec is not None


@pytest.mark.parametrize("name", ["trajectory", "segments"])
def test_an_environment_that_uses_the_names_itself_is_refused_while_recording(name: str) -> None:
    def step(env: CountingEnv, _: int) -> Any:
        return np.array([float(env.time)]), 0.0, False, False, {name: [1, 2]}

    env = OptionsWrapper(CountingEnv(step=step))
    env.reset(seed=0)
    assert env.step(0)[4][name] == [1, 2]
    env.set_slots(record=True)
    with pytest.raises(ValueError, match=rf'^The environment has an info.+"{name}"\].* of its own.+another name there'):
        env.step(0)
