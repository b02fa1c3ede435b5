"""Transitions of SB3's replay buffers, found again in an `OptionReplayBuffer`."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.utils import set_random_seed

from sb3_options import OptionReplayBuffer

GAMMA = 0.9
BOX = spaces.Box(0.0, 1000.0, (2,), np.float32)
SPACES: dict[str, Any] = {
    "box": BOX,
    "discrete": spaces.Discrete(1000),
    "image": spaces.Box(0, 255, (3, 4, 5), np.uint8),
    "dict": spaces.Dict({"a": BOX, "b": spaces.Discrete(1000)}),
}


def see(kind: str, values: Any) -> Any:
    """A batch of observations that show ``values``."""
    values = np.asarray(values)
    box = np.stack([values, 2 * values], axis=1).astype(np.float32)
    image = np.broadcast_to(values[:, None, None, None], (len(values), 3, 4, 5)).astype(np.uint8)
    return {"box": box, "discrete": values, "image": image, "dict": {"a": box, "b": values.copy()}}[kind]


def stock_buffer(kind: str, n_envs: int, n_steps: int, size: int, **kwargs: Any) -> Any:
    """Step t of environment e goes from 10 t + e to 10 t + e + 10; every third is a timeout, every fifth an end."""
    cls = DictReplayBuffer if kind == "dict" else ReplayBuffer
    buffer = cls(size, SPACES[kind], spaces.Discrete(4), device="cpu", n_envs=n_envs, **kwargs)
    for t in range(n_steps):
        here = 10 * t + np.arange(n_envs)
        infos = [{"TimeLimit.truncated": t % 3 == 2} for _ in range(n_envs)]
        done = np.full(n_envs, t % 3 == 2 or t % 5 == 4)
        buffer.add(see(kind, here), see(kind, here + 10), here % 4, here * 0.5, done, infos)
    return buffer


def values_of(rows: dict[str, Any]) -> list[int]:
    """What `see` showed, oldest row first."""
    first = next(iter(rows.values()))
    return [int(v) for v in first.reshape(len(first), -1)[:, 0]]


@pytest.mark.parametrize("kind", list(SPACES))
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("n_steps", [4, 8, 11])
def test_every_transition_is_kept(kind: str, n_envs: int, n_steps: int) -> None:
    """8 steps find room: some, all, and more."""
    stock = stock_buffer(kind, n_envs, n_steps, 8 * n_envs)
    buffer = OptionReplayBuffer.from_stock(stock, spaces.Discrete(7), GAMMA)
    assert buffer.buffer_size == 8 * n_envs
    assert buffer.size() == min(n_steps, 8) * n_envs
    assert buffer.full == (n_steps >= 8)
    assert buffer.action_space == spaces.Discrete(7)
    rows = np.arange(buffer.size())
    expected = [10 * t + e for t in range(max(n_steps - 8, 0), n_steps) for e in range(n_envs)]
    times = np.array(expected) // 10
    assert values_of({k: v[rows] for k, v in buffer._observations.items()}) == expected
    assert values_of({k: v[rows] for k, v in buffer._next_observations.items()}) == [v + 10 for v in expected]
    assert np.array_equal(buffer.actions[rows, 0], np.array(expected) % 4)
    assert np.array_equal(buffer.rewards[rows], np.array(expected) * 0.5)
    assert np.array_equal(buffer.timeouts[rows], times % 3 == 2)
    assert np.array_equal(buffer.dones[rows], (times % 3 == 2) | (times % 5 == 4))
    assert (buffer.discounts[rows] == np.float32(GAMMA)).all()


def test_samples_are_those_of_the_stock_buffer() -> None:
    stock = stock_buffer("box", 1, 8, 8)
    set_random_seed(0)
    expected = stock.sample(64)
    buffer = OptionReplayBuffer.from_stock(stock, spaces.Discrete(7), GAMMA)
    set_random_seed(0)
    samples: Any = buffer.sample(64)
    for name in ("observations", "actions", "next_observations", "dones", "rewards"):
        assert getattr(expected, name).equal(getattr(samples, name)), name
    assert (samples.discounts == GAMMA).all()
