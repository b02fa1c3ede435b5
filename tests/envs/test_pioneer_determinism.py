"""One seed, one trajectory: bit for bit, whatever was simulated before, in one process or several."""

import hashlib
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_options.envs.pioneer import Pioneer

IDS = [f"sb3_options/{name}-v0" for name in ("Pioneer", "PioneerCorner", "PioneerClutter", "PioneerTwoBalls")]
N_STEPS = 150
SEED = 3

FRESH = """
from tests.envs.test_pioneer_determinism import digest, make
print(digest(make({env_id!r}), {seed}))
"""


def make(env_id: str) -> gymnasium.Env[Any, Any]:
    # Truncating early, so that several resets are part of the trajectory.
    return gymnasium.make(env_id, max_steps=60, observation="retina")


def digest(env: gymnasium.Env[Any, Any], seed: int) -> str:
    """Of all that a trajectory shows, and of the hidden positions."""
    actions = np.random.default_rng(seed).integers(7, size=N_STEPS)
    core = env.unwrapped
    assert isinstance(core, Pioneer)
    sha = hashlib.sha256(env.reset(seed=seed)[0].tobytes())
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        sha.update(observation.tobytes())
        sha.update(repr((reward, terminated, truncated, info, core.robot_pose, core.ball_positions)).encode())
        if terminated or truncated:
            sha.update(env.reset()[0].tobytes())
    return sha.hexdigest()


@pytest.mark.parametrize("env_id", IDS)
def test_any_history(env_id: str) -> None:
    first = make(env_id)
    expected = digest(first, SEED)
    second = make(env_id)
    for seed in (7, 8):
        digest(second, seed)
    second.reset(seed=0)
    for _ in range(5):
        second.step(2)
    assert digest(second, SEED) == expected
    assert digest(first, SEED) == expected
    assert digest(first, SEED + 1) != expected
    first.close()
    second.close()


@pytest.mark.parametrize("env_id", IDS)
def test_fresh_process(env_id: str) -> None:
    script = FRESH.format(env_id=env_id, seed=SEED)
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.split()[-1] == digest(make(env_id), SEED)


def vector_trajectory(n: int, *, processes: bool) -> list[bytes]:
    """Observations and rewards of each of ``n`` environments."""

    def make_one() -> gymnasium.Env[Any, Any]:
        import sb3_options.envs  # noqa: F401  # a fresh process has to register them

        return gymnasium.make("sb3_options/PioneerClutter-v0", max_steps=20)

    vec = SubprocVecEnv([make_one] * n) if processes else DummyVecEnv([make_one] * n)
    vec.seed(SEED)
    record = [[observation.tobytes()] for observation in np.asarray(vec.reset())]
    rngs = [np.random.default_rng(SEED + i) for i in range(n)]
    for _ in range(50):
        observations, rewards, dones, infos = vec.step(np.array([rng.integers(7) for rng in rngs]))
        for i in range(n):
            record[i].append(np.asarray(observations)[i].tobytes() + bytes([dones[i]]) + rewards[i].tobytes())
            record[i].append(repr(sorted((k, v) for k, v in infos[i].items() if isinstance(v, bool))).encode())
    vec.close()
    return [b"".join(parts) for parts in record]


def test_vectorised() -> None:
    expected = vector_trajectory(4, processes=False)
    assert len(set(expected)) == 4
    for n in (1, 2):
        assert vector_trajectory(n, processes=False) == expected[:n]
    for n in (1, 2, 4):
        assert vector_trajectory(n, processes=True) == expected[:n]
