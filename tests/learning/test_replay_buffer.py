import copy
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize, VecTransposeImage

from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.learning.replay_buffer import OptionReplayBufferSamples
from tests.support.sb3_helpers import (
    ActionLog,
    Corridor,
    Row,
    StepLog,
    TableOption,
    corridor_option,
    expected_rows,
    places,
)

GAMMA = 0.9
KINDS = ["box", "discrete", "dict", "dict_discrete", "image"]
INSIDE = [2 <= p < 8 for p in range(12)]
RIGHT = TableOption(INSIDE, [1] * 12, [p == 8 for p in range(12)], max_duration=4)


def optioned(kind: str, *, limit: int = 25) -> ActionLog:
    """A corridor whose slot 0 is `RIGHT` and whose slot 1 is empty."""
    wrapped = OptionsWrapper(StepLog(Corridor(kind, limit)), 2, gamma=GAMMA, feature_map=places)
    wrapped.set_slots(report_availability=True)
    wrapped.bank.add(corridor_option(max_duration=RIGHT.max_duration), 0)
    return ActionLog(wrapped)


def corridors(kind: str, n_envs: int = 1, *, limit: int = 25) -> VecEnv:
    venv: VecEnv = DummyVecEnv([lambda: optioned(kind, limit=limit)] * n_envs)
    venv.seed(0)
    return VecTransposeImage(venv) if kind in ("image", "dict") else venv


def fill(venv: VecEnv, buffer: OptionReplayBuffer, n_steps: int, rng: np.random.Generator) -> list[list[Row]]:
    """Step and add as SB3's ``_store_transition`` does; per step of the VecEnv, which rows that must have written."""
    logs = cast("list[list[Any]]", venv.get_attr("log"))
    obs = venv.reset()
    written: list[list[Row]] = []
    for _ in range(n_steps):
        actions = rng.integers(4, size=venv.num_envs)
        done_before = [len(log) for log in logs]
        next_obs, rewards, dones, infos = venv.step(actions)
        stored: Any = copy.deepcopy(next_obs)
        for i in np.flatnonzero(dones):
            final = infos[i]["terminal_observation"]
            if isinstance(stored, dict):
                for key in stored:
                    stored[key][i] = final[key]
            else:
                stored[i] = final
        buffer.add(obs, stored, actions, rewards, dones, infos)
        written.append(
            [
                row
                for i, action in enumerate(actions)
                for row in rows_of(logs[i][done_before[i] :], int(action), macro_q=buffer.macro_q)
            ]
        )
        obs = next_obs
    return written


def rows_of(steps: list[Any], action: int, *, macro_q: bool) -> list[Row]:
    in_places = [s._replace(state=place_in(s.state), next_state=place_in(s.next_state)) for s in steps]
    return expected_rows(in_places, [action], {0: RIGHT}, 2, GAMMA, macro_q=macro_q)


def place_in(observation: Any) -> int:
    place = observation["place"] if isinstance(observation, dict) else observation
    return int(np.ravel(place)[0])


def place_of_tensors(observations: Any) -> list[int]:
    batch = observations["place"] if isinstance(observations, dict) else observations
    return [int(row.reshape(-1)[0]) for row in batch]


def all_samples(buffer: OptionReplayBuffer, env: VecNormalize | None = None) -> OptionReplayBufferSamples:
    return cast("OptionReplayBufferSamples", buffer._get_samples(np.arange(buffer.size()), env))


def assert_holds(samples: OptionReplayBufferSamples, rows: list[Row]) -> None:
    assert place_of_tensors(samples.observations) == [r.state for r in rows]
    assert samples.actions[:, 0].tolist() == [r.action for r in rows]
    np.testing.assert_allclose(samples.rewards[:, 0], [r.reward for r in rows], atol=1e-6)
    np.testing.assert_allclose(samples.discounts[:, 0], [r.discount for r in rows], atol=1e-7)
    assert place_of_tensors(samples.next_observations) == [r.next_state for r in rows]
    assert samples.dones[:, 0].tolist() == [float(r.terminal) for r in rows]


def buffer_for(venv: VecEnv, size: int = 2000, **kwargs: Any) -> OptionReplayBuffer:
    spaces = venv.observation_space, venv.action_space
    return OptionReplayBuffer(size, *spaces, "cpu", n_envs=venv.num_envs, **kwargs)


@pytest.mark.parametrize("macro_q", [True, False])
@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("kind", KINDS)
def test_holds_what_the_primitive_steps_were(kind: str, n_envs: int, macro_q: bool, rng: np.random.Generator) -> None:
    venv = corridors(kind, n_envs)
    buffer = buffer_for(venv, macro_q=macro_q)
    rows = [row for step in fill(venv, buffer, 400 // n_envs, rng) for row in step]
    discounts = {round(r.discount, 6) for r in rows}
    assert len(discounts) >= 4  # options of several durations ran
    assert any(r.terminal for r in rows)
    assert len(rows) == buffer.size()
    assert_holds(all_samples(buffer), rows)


@pytest.mark.parametrize(("n_envs", "limit"), [(1, 37), (4, 37), (1, 3)])
def test_wraps_around_in_the_middle_of_an_option(n_envs: int, limit: int, rng: np.random.Generator) -> None:
    """Of a run longer than the buffer the last rows stay."""
    venv = corridors("box", n_envs)
    buffer = buffer_for(venv, limit)
    buffer.track_availability(2)
    rows: list[Row] = []
    crossed = 0
    for _ in range(60):
        before = buffer.pos
        written = fill(venv, buffer, 3, rng)
        rows += [row for step in written for row in step]
        crossed += buffer.pos < before
        size = min(len(rows), limit)
        assert (buffer.size(), buffer.pos, buffer.full) == (size, len(rows) % limit, len(rows) >= limit)
        newest = range(len(rows) - size, len(rows))
        in_order = [row for _, row in sorted((i % limit, rows[i]) for i in newest)]
        samples = all_samples(buffer)
        assert_holds(samples, in_order)
        assert samples.next_available is not None
        assert samples.next_available.tolist() == [[INSIDE[r.next_state], False] for r in in_order]
    assert crossed > 5


@pytest.mark.parametrize("handle", [True, False])
def test_timeouts_inside_options_bootstrap_unless_told_otherwise(handle: bool, rng: np.random.Generator) -> None:
    venv = corridors("box", limit=5)
    buffer = buffer_for(venv, handle_timeout_termination=handle)
    fill(venv, buffer, 300, rng)
    samples = all_samples(buffer)
    cut_off_in_option = (samples.actions[:, 0] == 2).numpy() & (buffer.dones[: buffer.size()] == 1)
    assert cut_off_in_option.sum() > 5
    terminal = np.array(place_of_tensors(samples.next_observations)) == Corridor.LAST
    assert not (cut_off_in_option & terminal).any()
    assert samples.dones.numpy()[cut_off_in_option].tolist() == [[0.0 if handle else 1.0]] * cut_off_in_option.sum()
    macro_rows = np.flatnonzero(cut_off_in_option)
    ends = [int(np.flatnonzero(buffer.dones[i + 1 :])[0]) + i + 1 for i in macro_rows]
    assert samples.dones.numpy()[ends].tolist() == [[0.0 if handle else 1.0]] * len(ends)


def test_normalizes_with_vec_normalize_as_the_stock_buffer_does(rng: np.random.Generator) -> None:
    venv = corridors("box")
    buffer = buffer_for(venv)
    fill(venv, buffer, 200, rng)
    normalize = VecNormalize(venv, gamma=GAMMA)
    statistics = cast("RunningMeanStd", normalize.obs_rms)
    statistics.mean, statistics.var = np.array([1.0, 3.0]), np.array([4.0, 9.0])
    normalize.ret_rms.var = np.array(4.0)
    raw, normal = all_samples(buffer), all_samples(buffer, normalize)
    for name in ("observations", "next_observations"):
        expected = np.clip((getattr(raw, name).numpy() - [1.0, 3.0]) / np.sqrt(np.array([4.0, 9.0]) + 1e-8), -10, 10)
        np.testing.assert_allclose(getattr(normal, name), expected, atol=1e-6)
    np.testing.assert_allclose(normal.rewards, raw.rewards / 2.0, rtol=1e-6)
    assert torch.equal(normal.discounts, raw.discounts)


def test_what_it_cannot_store_is_refused() -> None:
    with pytest.raises(ValueError, match=r"OptionReplayBuffer needs optimize_memory_usage=False"):
        OptionReplayBuffer(10, spaces.Discrete(3), spaces.Discrete(2), optimize_memory_usage=True)
    settings: dict[str, Any] = {"gamma": GAMMA, "replay_buffer_class": OptionReplayBuffer, "buffer_size": np.int64(100)}
    bare = DQN("MlpPolicy", gym.make("CartPole-v1"), **settings)
    with pytest.raises(ValueError, match=r'There is no info\["option"\]: wrap the environment in OptionsWrapper'):
        bare.learn(10)
    stacked = DQN("CnnPolicy", VecFrameStack(corridors("image"), 2), **settings, seed=0)
    with pytest.raises(ValueError, match=r"a VecEnv wrapper changes them\. Pass replay_buffer_kwargs="):
        stacked.learn(200)


@pytest.mark.parametrize("macro_q", [True, False])
def test_a_removed_option_is_named_no_more(macro_q: bool, rng: np.random.Generator) -> None:
    """Each of its runs becomes the transition that was stored after it; all others stay."""
    venv = corridors("box")
    buffer = buffer_for(venv, 500, macro_q=macro_q)
    rows = [row for step in fill(venv, buffer, 80, rng) for row in step]
    assert sum(row.action == 2 for row in rows) > 5
    buffer.forget_action(2)
    following = rows + rows  # after the last comes the first
    expected = [next(r for r in following[i:] if r.action != 2) for i in range(len(rows))]
    assert_holds(all_samples(buffer), expected)


def test_a_removed_option_leaves_nothing_of_its_rows(rng: np.random.Generator) -> None:
    """Every column of a row that named it is that of the row behind, the timeouts among them."""
    buffer = OptionReplayBuffer(60, spaces.Box(0.0, 1.0, (2,)), spaces.Discrete(4))
    buffer.track_availability(2)
    columns = buffer._columns()
    assert any(column is buffer.timeouts for column in columns)
    for column in columns:
        column[:] = rng.integers(2, size=column.shape) if column.dtype == bool else rng.random(column.shape)
    buffer.timeouts[:] = rng.integers(2, size=60)
    buffer.actions[:, 0] = np.where(np.arange(60) % 3 == 0, 2, 1)
    buffer.full = True
    before = [column.copy() for column in columns]
    buffer.forget_action(2)
    rows = np.arange(0, 60, 3)
    for column, was in zip(columns, before, strict=True):
        np.testing.assert_array_equal(column[rows], was[rows + 1])
        others = np.setdiff1d(np.arange(60), rows)
        np.testing.assert_array_equal(column[others], was[others])
