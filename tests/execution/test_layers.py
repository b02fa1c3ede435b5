"""The state of an environment, wrapper by wrapper: what a ``Monitor`` goes on with, and what need not tell anything."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from stable_baselines3.common.monitor import Monitor

from sb3_options.execution import layers
from sb3_options.execution.repeating import RecordActions
from tests.support.helpers import CountingEnv, equal


@pytest.fixture
def monitored() -> Iterator[Callable[[Path | None], Any]]:
    """Makes environments in a `Monitor` that writes a file, or none; closes them."""
    made: list[Monitor[Any, Any]] = []

    def make(path: Path | None) -> Any:
        made.append(Monitor(CountingEnv(terminate_at=3), None if path is None else str(path)))
        return layers.prepare(made[-1])

    yield make
    for monitor in made:
        monitor.close()


def episodes(env: Any, n_steps: int) -> list[dict[str, Any]]:
    """Steps on; what the monitor said at the ends of episodes."""
    said = []
    for _ in range(n_steps):
        _, _, terminated, _, info = env.step(0)
        if terminated:
            said.append(info["episode"])
            env.reset()
    return said


def test_a_monitor_goes_on_where_it_was(tmp_path: Path, monitored: Any) -> None:
    env, later = monitored(tmp_path / "a"), monitored(tmp_path / "b")
    env.t_start -= 100.0
    env.reset(seed=0)
    episodes(env, 4)
    before = (tmp_path / "a.monitor.csv").read_text("utf-8")
    states = layers.states_of(env)
    later.reset(seed=1)
    assert layers.set_states(later, states) is None
    assert abs(time.time() - later.t_start - 100.0) < 10.0
    assert (later.episode_returns, later.episode_lengths, later.rewards) == ([6.0], [3], [1.0])
    assert (later.total_steps, later.needs_reset, later.current_reset_info) == (4, False, env.current_reset_info)
    assert later.episode_times == env.episode_times
    (ended,) = episodes(later, 2)
    assert (ended["r"], ended["l"], ended["t"] >= 100.0) == (6.0, 3, True)
    # What was written after the checkpoint is cut off, where the file is that of before.
    episodes(env, 5)
    layers.set_states(env, states)
    assert (tmp_path / "a.monitor.csv").read_text("utf-8") == before
    assert episodes(env, 2)[0]["l"] == 3
    assert (tmp_path / "a.monitor.csv").read_text("utf-8").startswith(before)


@pytest.mark.parametrize("written", [True, False])
def test_a_file_that_is_shorter_or_not_there_stays_as_it_is(tmp_path: Path, monitored: Any, written: bool) -> None:
    env, new = monitored(tmp_path / "a" if written else None), monitored(tmp_path / "b")
    env.reset(seed=0)
    episodes(env, 30)
    new.reset(seed=0)
    before = (tmp_path / "b.monitor.csv").read_bytes()
    for later in (new, monitored(None)):
        later.reset(seed=0)
        layers.set_states(later, layers.states_of(env))
        assert later.total_steps == 30
    assert (tmp_path / "b.monitor.csv").read_bytes() == before


def test_a_wrapper_that_remembers_nothing_need_not_tell() -> None:
    class Same(gym.Wrapper[Any, Any, Any, Any]):
        remembers_nothing = True

    class Silent(gym.Wrapper[Any, Any, Any, Any]):
        pass

    class Told(CountingEnv):
        def get_state(self) -> dict[str, Any]:
            return {"time": self.time}

    told = Same(Told())
    assert layers.prepare(told) is told
    assert isinstance(layers.prepare(Silent(Told())), RecordActions)
    assert layers.states_of(told)[0] == {"class": "Same"}
    assert equal(layers.states_of(told)[1]["own"], {"time": 0})
