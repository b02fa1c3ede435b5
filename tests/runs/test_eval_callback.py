"""Evaluation while training: limited, shown, ended by an interrupt; the best model is kept with its options."""

import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN

from sb3_options import OptionBank, cli
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.runs import folder as runs
from sb3_options.runs import training
from sb3_options.runs.config import configure
from sb3_options.runs.evaluation import evaluate_run
from sb3_options.runs.logged import read_run
from tests.support.helpers import CountingEnv
from tests.support.runs import train

Register = Callable[..., list[int]]


@pytest.fixture
def register() -> Iterator[Register]:
    """Registers an environment that ends after some steps, and counts the steps of all its copies."""

    def register(*, ends_after: float, in_step: Callable[[int], object] = lambda _: None, **spec: Any) -> list[int]:
        steps = [0]

        def step(env: CountingEnv, action: int) -> Any:
            steps[0] += 1
            in_step(steps[0])
            return np.array([float(env.time)]), 1.0, env.time >= ends_after, False, {}

        gym.register("Evaluated-v0", lambda: CountingEnv(step=step), **spec)  # type: ignore[arg-type]  # no arguments
        return steps

    yield register
    gym.registry.pop("Evaluated-v0", None)


def settings(tmp_path: Path, algo: str = "dqn", **kwargs: Any) -> Any:
    common: dict[str, Any] = {"eval_freq": 50, "progress": False, "device": "cpu", "tensorboard_log": tmp_path}
    return configure(algo=algo, env="Evaluated-v0", **(common | kwargs))


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

    gym.register("Evaluated-v0", lambda: CountingEnv(step=step))  # type: ignore[arg-type]  # no arguments
    try:
        folder = train(settings(tmp_path, success=rule, n_envs=1, n_timesteps=400, eval_episodes=4))
    finally:
        gym.registry.pop("Evaluated-v0")
    curves = read_run(folder).curves
    if rate is None:
        assert "success" not in curves["eval"] | curves["rollout"]
        return
    assert set(curves["eval"]["success"].values) == {np.float32(rate)}
    assert curves["rollout"]["success"].values[-1] == pytest.approx(rate, abs=0.02)


@pytest.mark.parametrize(("own", "limit", "expected"), [(None, 30, 30), (20, 30, 20), (200, 30, 30)])
def test_an_evaluation_ends_where_the_policy_never_arrives(
    own: int | None, limit: int, expected: int, register: Register, tmp_path: Path
) -> None:
    register(ends_after=np.inf, max_episode_steps=own)
    folder = train(settings(tmp_path, n_timesteps=60, eval_max_steps=limit, eval_episodes=2))
    assert np.load(folder / "evaluations.npz")["ep_lengths"].tolist() == [[expected] * 2]


def test_the_limit_is_for_evaluation_only(register: Register, tmp_path: Path) -> None:
    register(ends_after=40)
    folder = train(settings(tmp_path, n_timesteps=100, eval_max_steps=30, eval_episodes=1))
    assert [line.split(",")[1] for line in (folder / "monitor" / "0.monitor.csv").read_text().splitlines()[2:]] == [
        "40"
    ] * 2


@pytest.mark.parametrize("algo", ["dqn", "maskableppo"])
def test_the_progress_bar_says_where_an_evaluation_is(
    algo: str, register: Register, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    bar = "stable_baselines3.common.callbacks.tqdm.set_description"
    monkeypatch.setattr(bar, lambda self, text, refresh=True: said.append(text))
    register(ends_after=150)
    train(settings(tmp_path, algo, n_envs=1, n_timesteps=110, eval_freq=100, eval_episodes=2, progress=True))
    assert said == [
        "evaluating: episode 1 of 2, decision 0",
        "evaluating: episode 1 of 2, decision 100",
        "evaluating: episode 2 of 2, decision 0",
        "evaluating: episode 2 of 2, decision 100",
        "evaluated: 150",
    ]


def test_an_interrupt_ends_an_evaluation_and_training(
    register: Register, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    steps = register(ends_after=10, in_step=lambda step: os.kill(os.getpid(), signal.SIGINT) if step == 75 else None)
    folder = train(settings(tmp_path, eval_episodes=1_000, checkpoint_freq=0))
    assert steps == [75]
    assert "Interrupted after 50 primitive steps" in capfd.readouterr().out
    assert DQN.load(folder / "model.zip").num_timesteps == 50
    assert not (folder / "evaluations.npz").exists()


@pytest.mark.parametrize(("patience", "ends"), [(60.0, 52), (0.3, 50)])
def test_a_short_evaluation_is_waited_for_to_write_a_checkpoint(
    patience: float, ends: int, register: Register, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow(step: int) -> None:
        if step == 75:
            os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01 * (step > 75))

    monkeypatch.setattr(training, "PATIENCE", patience)
    register(ends_after=10, in_step=slow)
    folder = train(settings(tmp_path, eval_episodes=10))
    assert DQN.load(folder / "model.zip").num_timesteps == ends
    there = next(iter(CheckpointFolder(folder / runs.CHECKPOINTS)))
    assert int(there.stem) == (ends if patience > 1 else 0)
    assert (folder / "evaluations.npz").exists() == (patience > 1)


class TestBestModel:
    def test_is_kept_and_can_be_played_without_the_last_one(
        self, register: Register, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        register(ends_after=10)
        folder = train(settings(tmp_path, n_timesteps=120))
        assert DQN.load(folder / "best_model.zip").num_timesteps == 50  # no later one was better
        OptionBank(2, 4).load(folder / "best_model.zip")
        (folder / "model.zip").unlink()
        shutil.copy(folder / "config.yml", folder / "options.safetensors")  # of the last model, and damaged
        cli.main(["evaluate", str(folder), "--best", "--episodes", "2"])
        assert "2 episodes" in capsys.readouterr().out

    def test_is_missed_with_the_remedy(self, register: Register, tmp_path: Path) -> None:
        register(ends_after=10)
        folder = train(settings(tmp_path, n_timesteps=20, eval_freq=0))
        assert not (folder / runs.BEST).exists()
        with pytest.raises(FileNotFoundError, match=r"has no best_model\.zip: train with --eval-freq, which"):
            evaluate_run(folder, best=True)
