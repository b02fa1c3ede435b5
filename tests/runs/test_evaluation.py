import dataclasses
import shlex
import shutil
from pathlib import Path

import gymnasium as gym
import pytest
from gymnasium.envs.registration import EnvSpec

from sb3_options import cli, record_demonstrations, save_demonstrations
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs.config import configure
from sb3_options.runs.evaluation import evaluate_run
from tests.support.helpers import CountingEnv
from tests.support.runs import Refused, trained


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(tmp_path_factory.mktemp("runs"), algo="dqn", n_timesteps=50)


def test_an_environment_with_other_spaces_is_refused(run: Path) -> None:
    with pytest.raises(ValueError, match=r"model\.zip is damaged, or does not fit"):
        evaluate_run(run, env="CartPole-v1")


def test_sampled_actions_differ_from_greedy_ones(tmp_path: Path) -> None:
    run = trained(tmp_path, algo="ppo", env="FrozenLake-v1", n_timesteps=64, n_steps=64)  # its episodes are short
    greedy, sampled = (evaluate_run(run, episodes=9, stochastic=stochastic) for stochastic in (False, True))
    assert greedy == evaluate_run(run, episodes=9)
    assert greedy.steps != sampled.steps


def test_a_greedy_policy_samples_nothing(run: Path) -> None:
    with pytest.raises(ValueError, match=r"^The policy of dqn is greedy and samples no actions: leave --stochastic"):
        evaluate_run(run, stochastic=True)


def test_the_limit_of_runs_is_that_of_the_environment() -> None:
    assert runs.make_env(configure(max_runs=3), 1, 0).get_attr("max_runs") == [3]


def test_weights_that_do_not_fit_are_named_in_one_line(run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    config = configs.load(copy / runs.CONFIG)
    others = config.algo_kwargs | {"policy_kwargs": {"net_arch": [3]}}
    configs.save(dataclasses.replace(config, algo_kwargs=others), copy / runs.CONFIG)
    with pytest.raises(ValueError, match=r"model\.zip is damaged, or does not fit \S+config\.yml: .+q_net") as error:
        evaluate_run(copy)
    assert "\n" not in str(error.value)


def test_a_run_that_was_cut_off_is_refused(run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    (copy / runs.MODEL).unlink()
    with pytest.raises(FileNotFoundError, match=r"model\.zip"):
        evaluate_run(copy)
    with pytest.raises(FileNotFoundError, match=r"config\.yml"):
        evaluate_run(tmp_path)


def test_of_an_environment_that_draws_nothing_no_video_is_proposed_or_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    monkeypatch.setitem(gym.registry, "Blank-v0", EnvSpec("Blank-v0", blank))  # type: ignore[arg-type]  # no arguments
    run = trained(tmp_path, algo="dqn", env="Blank-v0", n_timesteps=50)
    (proposed,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Evaluate:")]
    words = shlex.split(proposed)
    assert "--video" not in words
    cli.main([*words[words.index("evaluate") :], "--episodes", "1"])
    said = "Error: Blank-v0 draws no pictures, for it has no render_mode 'rgb_array': leave --video out.\n"
    assert refused("evaluate", str(run), "--video", str(tmp_path / "film.mp4")) == said
    assert not (tmp_path / "film.mp4").exists()


@pytest.mark.parametrize("clone", [True, False])
def test_of_a_cloned_policy_sampled_actions_are_proposed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], clone: bool
) -> None:
    lake = {"is_slippery": False}
    way = {0: 2, 1: 2, 2: 1, 6: 1, 10: 1, 14: 2}
    shown = tmp_path / "shown"
    save_demonstrations(shown, record_demonstrations(gym.make("FrozenLake-v1", **lake), way.__getitem__, 2))
    short = {"n_timesteps": 64, "n_steps": 64, "n_envs": 1, "success": "terminated"}
    trained(tmp_path, env="FrozenLake-v1", env_kwargs=lake, demonstrations=shown, clone=clone, **short)
    (proposed,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Evaluate:")]
    assert ("--stochastic" in shlex.split(proposed)) == clone


def blank() -> CountingEnv:
    """It takes no arguments, ``render_mode`` neither."""
    return CountingEnv(terminate_at=5)


def test_a_run_without_options_lacks_none(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    short = {"n_timesteps": 64, "n_steps": 64, "n_envs": 1, "env_kwargs": {"max_steps": 50}}
    evaluate_run(trained(tmp_path, max_new_options=0, **short), episodes=1)
    assert "No slot holds an option" not in caplog.text
