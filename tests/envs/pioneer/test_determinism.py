"""One seed, one trajectory: bit for bit, whatever was simulated before, in one process or several."""

import hashlib
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_options.envs.pioneer.env import PioneerTask
from tests.support import processes

IDS = [
    f"sb3_options/{name}-v0"
    for module, names in {
        "pybullet": ("Pioneer", "PioneerCorner", "PioneerClutter", "PioneerTwoBalls"),
        "mujoco": ("PioneerMuJoCo",),
    }.items()
    for name in names
    if find_spec(module) is not None
]
N_STEPS = 100
SEED = 3

FRESH = f"""
from tests.envs.pioneer.test_determinism import IDS, digest, make
print(*[digest(make(env_id), {SEED}) for env_id in IDS])
"""


def make(env_id: str) -> gymnasium.Env[Any, Any]:
    # Truncating early, so that several resets are part of the trajectory.
    return gymnasium.make(env_id, max_steps=40, observation="retina")


def digest(env: gymnasium.Env[Any, Any], seed: int) -> str:
    """Of all that a trajectory shows, and of the hidden positions."""
    actions = np.random.default_rng(seed).integers(7, size=N_STEPS)
    core = env.unwrapped
    assert isinstance(core, PioneerTask)
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


def test_fresh_process() -> None:
    result = processes.python("-c", FRESH)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split()[-len(IDS) :] == [digest(make(env_id), SEED) for env_id in IDS]


def vector_trajectory(env_id: str, n: int, start_method: str | None = None) -> list[bytes]:
    """What each of ``n`` environments shows, in this process or in one each."""

    def make_one() -> gymnasium.Env[Any, Any]:
        import sb3_options.envs  # noqa: F401  # a fresh process has to register them

        return gymnasium.make(env_id, n_obstacles=4, max_steps=20)

    vec = SubprocVecEnv([make_one] * n, start_method) if start_method else DummyVecEnv([make_one] * n)
    vec.seed(SEED)
    record = [[observation.tobytes()] for observation in np.asarray(vec.reset())]
    rngs = [np.random.default_rng(SEED + i) for i in range(n)]
    for _ in range(50):
        observations, rewards, dones, infos = vec.step(np.array([rng.integers(7) for rng in rngs]))
        for i in range(n):
            record[i].append(
                np.asarray(observations)[i].tobytes() + bytes([bool(dones[i])]) + np.float32(rewards[i]).tobytes()
            )
            record[i].append(repr(sorted((k, v) for k, v in infos[i].items() if isinstance(v, bool))).encode())
    vec.close()
    return [b"".join(parts) for parts in record]


# Forking is fast; SB3's own default is the fork server, each of whose processes imports everything anew.
@pytest.mark.parametrize("env_id", [IDS[0], IDS[-1]])
@pytest.mark.parametrize("start_method", ["fork", pytest.param("forkserver", marks=pytest.mark.slow)])
def test_vectorised(env_id: str, start_method: str) -> None:
    expected = vector_trajectory(env_id, 4)
    assert len(set(expected)) == 4
    for n in (1, 2):
        assert vector_trajectory(env_id, n) == expected[:n]
    for n in (1, 2, 4):
        assert vector_trajectory(env_id, n, start_method) == expected[:n]
