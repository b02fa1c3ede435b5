"""Training ends with its budget, and settings that a machine cannot hold end in a sentence."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_options import OptionsWrapper, cli
from sb3_options.callbacks import PrimitiveStepsCallback
from sb3_options.learning.replay_buffer import OptionReplayBuffer
from sb3_options.runs.algorithms import check_device
from sb3_options.runs.budget import KeepToBudget, rounded_up
from sb3_options.runs.config import TrainConfig, configure
from tests.support.helpers import CountingEnv, steady_option
from tests.support.runs import train


def trained(train_freq: int, budget: int, *, option: bool = False) -> DQN:
    env = OptionsWrapper(CountingEnv(truncate_at=50), 1, gamma=0.9)
    if option:
        env.bank.add(steady_option(max_duration=7), 0)
    model = DQN(
        "MlpPolicy", env, gamma=0.9, device="cpu", learning_starts=0, train_freq=train_freq, seed=0,
        replay_buffer_class=OptionReplayBuffer, buffer_size=1_000, exploration_fraction=1.0,
    )  # fmt: skip
    model.learn(budget, [PrimitiveStepsCallback(), KeepToBudget()])
    left: Any = model.train_freq
    assert left == TrainFreq(train_freq, TrainFrequencyUnit.STEP)
    return model


@pytest.mark.parametrize(
    ("train_freq", "budget", "updates"), [(4, 100, 25), (70, 100, 2), (500, 60, 1), (4, 101, 26), (60, 60, 1)]
)
def test_off_policy_training_ends_with_its_budget(train_freq: int, budget: int, updates: int) -> None:
    model = trained(train_freq, budget)
    assert model.num_timesteps == budget
    assert model._n_updates == updates, "the last, shorter rollout is learned from"


def test_options_overshoot_by_less_than_one_of_them() -> None:
    assert 300 <= trained(250, 300, option=True).num_timesteps < 300 + 7


def test_a_budget_of_whole_rollouts_is_as_stock() -> None:
    ours = trained(4, 100)
    env = OptionsWrapper(CountingEnv(truncate_at=50), 1, gamma=0.9)
    stock = DQN(
        "MlpPolicy", env, gamma=0.9, device="cpu", learning_starts=0, train_freq=4, seed=0,
        replay_buffer_class=OptionReplayBuffer, buffer_size=1_000, exploration_fraction=1.0,
    )  # fmt: skip
    stock.learn(100, PrimitiveStepsCallback())
    for one, other in zip(ours.policy.parameters(), stock.policy.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["dqn", "--buffer-size", "10" + "0" * 14], "Unable to allocate"),
        (["ppo", "--n-steps", "10" + "0" * 11], "Unable to allocate"),
        (["dqn", "--max-options", "1" + "0" * 11], "max_options should be less than or equal to 10000"),
        (["dqn", "--device", "foo"], "--device 'foo' cannot be used: choose auto, cpu or cuda"),
        (["dqn", "--device", "meta"], "--device 'meta' cannot be used: choose auto, cpu or cuda"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(flags: list[str], said: str, tmp_path: Path, capsys: Any) -> None:
    gym.register("Small-v0", lambda: CountingEnv(terminate_at=5))  # type: ignore[arg-type]  # it takes no arguments
    try:
        with pytest.raises(SystemExit) as stopped:
            cli.main([*flags, "--env", "Small-v0", "--no-progress", "--tensorboard-log", str(tmp_path)])
    finally:
        gym.registry.pop("Small-v0")
    error = capsys.readouterr().err
    assert stopped.value.code == (2 if "max_options" in said else 1)
    assert said in error
    assert len(error.strip().splitlines()) == 1
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize(("flag", "value"), [("--seed", str(2**32)), ("--n-envs", "9" * 20), ("--net-arch", "-1")])
def test_numbers_that_are_too_large_are_named(flag: str, value: str, capsys: Any) -> None:
    with pytest.raises(SystemExit):
        cli.main(["dqn", flag, value])
    assert flag.removeprefix("--").replace("-", "_") in capsys.readouterr().err.replace("-", "_")


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (
            configure(algo="ppo", n_timesteps=500, algo_kwargs={"n_steps": 128}),
            "--n-timesteps 500 is rounded up to 1,024, for ppo learns from whole rollouts: --n-steps 128 times "
            "--n-envs 8. Smaller ones come closer.",
        ),
        (
            configure(algo="a2c", n_timesteps=1_200),
            "--n-timesteps 1,200 is rounded up to 1,280, for a2c learns from whole",
        ),
        (configure(algo="ppo", n_timesteps=1_024, algo_kwargs={"n_steps": 128}), ""),
        (configure(algo="ppo", n_timesteps=60_000), ""),
        (configure(algo="dqn", n_timesteps=501), ""),
    ],
)
def test_a_budget_that_whole_rollouts_make_larger_is_told(config: TrainConfig, said: str) -> None:
    assert rounded_up(config).startswith(said)
    assert bool(rounded_up(config)) == bool(said)


def test_training_tells_it_and_keeps_to_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = configure(
        algo="a2c",
        n_timesteps=40,
        n_steps=30,
        n_envs=1,
        max_options=0,
        progress=False,
        device="cpu",
        tensorboard_log=tmp_path,
    )
    train(config)
    said = capsys.readouterr().out
    assert "--n-timesteps 40 is rounded up to 60, for a2c learns from whole rollouts: --n-steps 30 times" in said
    assert "Finished after 60 primitive steps" in said


def test_devices_that_are_there() -> None:
    for name in ("auto", "cpu", "cuda"):
        check_device(name)
