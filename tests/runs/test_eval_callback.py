"""Evaluation while training: limited, judged by the rule of success; the best model is kept with its options."""

import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN

from sb3_options import OptionBank, cli
from sb3_options.runs import folder as runs
from sb3_options.runs.compare import read_run
from sb3_options.runs.evaluation import evaluate_run
from sb3_options.runs.training import EVAL_STEPS
from tests.runs.conftest import Register
from tests.support import runs as support
from tests.support.helpers import CountingEnv


def trained(tmp_path: Path, **kwargs: Any) -> Path:
    return support.trained(tmp_path, **{"algo": "dqn", "env": "Counted-v0", "eval_freq": 50, **kwargs})


@pytest.mark.parametrize(
    ("rule", "told", "rate"),
    [
        ("reported", "of successes", 0.25),
        ("reported", "always", 0.25),
        ("reported", "never", None),
        ("steps:4", "always", 0.0),
        ("terminated", "never", 1.0),
    ],
)
def test_success_is_logged_by_the_rule(rule: str, told: str, rate: float | None, tmp_path: Path) -> None:
    """Also where the environment reports another, or reports it at the end of successes alone."""
    episodes = [0]

    def step(env: CountingEnv, action: int) -> Any:
        over = env.time >= 5
        episodes[0] += over
        good = episodes[0] % 4 == 0
        says = over and (told == "always" or (told == "of successes" and good))
        return np.array([float(env.time)]), 1.0, over, False, {"is_success": good} if says else {}

    gym.register("Counted-v0", lambda: CountingEnv(step=step))  # type: ignore[arg-type]  # no arguments
    try:
        folder = trained(tmp_path, success=rule, n_envs=1, n_timesteps=400, eval_episodes=4)
    finally:
        gym.registry.pop("Counted-v0")
    curves = read_run(folder).curves
    if rate is None:
        assert "success" not in curves["eval"] | curves["rollout"]
        return
    assert set(curves["eval"]["success"].values) == {np.float32(rate)}
    assert curves["rollout"]["success"].values[-1] == pytest.approx(rate, abs=0.02)


@pytest.mark.parametrize(("own", "expected"), [(None, EVAL_STEPS), (20, 20), (EVAL_STEPS + 50, EVAL_STEPS + 50)])
def test_an_evaluation_ends_where_the_policy_never_arrives(
    own: int | None, expected: int, register: Register, tmp_path: Path
) -> None:
    register(ends_after=np.inf, max_episode_steps=own)
    folder = trained(tmp_path, n_timesteps=60, eval_episodes=2)
    assert np.load(folder / "evaluations.npz")["ep_lengths"].tolist() == [[expected] * 2]


def test_the_limit_is_for_evaluation_only(register: Register, tmp_path: Path) -> None:
    register(ends_after=EVAL_STEPS + 50)
    folder = trained(tmp_path, n_timesteps=EVAL_STEPS + 100, eval_freq=EVAL_STEPS, eval_episodes=1)
    (episode,) = (folder / "monitor" / "0.monitor.csv").read_text().splitlines()[2:]
    assert episode.split(",")[1] == str(EVAL_STEPS + 50)


class TestBestModel:
    def test_is_kept_and_can_be_played_without_the_last_one(
        self, register: Register, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        register(ends_after=10)
        folder = trained(tmp_path, n_timesteps=120)
        assert DQN.load(folder / "best_model.zip").num_timesteps == 50  # no later one was better
        OptionBank(2, 4).load(folder / "best_model.zip")
        (folder / "model.zip").unlink()
        shutil.copy(folder / "config.yml", folder / "options.safetensors")  # of the last model, and damaged
        cli.main(["evaluate", str(folder), "--best", "--episodes", "2"])
        assert "2 episodes" in capsys.readouterr().out

    def test_is_missed_with_the_remedy(self, register: Register, tmp_path: Path) -> None:
        register(ends_after=10)
        folder = trained(tmp_path, n_timesteps=20, eval_freq=0)
        assert not (folder / runs.BEST).exists()
        with pytest.raises(FileNotFoundError, match=r"best_model\.zip"):
            evaluate_run(folder, best=True)
