"""What an earlier release saved is loaded by this one, and does what it did there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.runs.evaluation import evaluate_run

RELEASES = sorted(path for path in Path(__file__).parent.iterdir() if (path / "expected.json").is_file())
EVALUATION_SEED = 10_000


@pytest.fixture(params=RELEASES, ids=lambda path: path.name)
def release(request: pytest.FixtureRequest) -> Path:
    path: Path = request.param
    return path


def expected(release: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((release / "expected.json").read_text(encoding="utf-8"))
    return content


def test_there_is_a_release() -> None:
    assert [path.name for path in RELEASES][:1] == ["0.1.0"]


def test_an_options_file_holds_the_same_options(release: Path) -> None:
    then = expected(release)
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", observation="xy"), max_options=3)
    env.bank.load(release / "bank.safetensors")
    observations = np.array(then["observations"], dtype=np.float32)
    np.testing.assert_array_equal(env.available(observations), np.array(then["available"], dtype=bool))
    for slot in env.bank.filled:
        option, was = env.bank[slot], then[str(slot)]
        assert option is not None
        assert (option.name, option.max_duration) == (was["name"], was["max_duration"])
        np.testing.assert_array_equal(option.policy(observations), was["actions"])
        np.testing.assert_array_equal(option.termination(observations), was["termination"])


def test_a_run_folder_is_evaluated_alike(release: Path) -> None:
    result = evaluate_run(release / "run", episodes=5, seed=EVALUATION_SEED)
    assert expected(release)["evaluation"] == {
        "return": result.mean_return.mean,
        "success": result.success_rate.mean,
        "steps": result.steps.mean,
    }


def test_stable_baselines3_loads_the_model(release: Path) -> None:
    model = DQN.load(release / "run" / "model.zip", device="cpu")
    assert model.replay_buffer_class is OptionReplayBuffer
