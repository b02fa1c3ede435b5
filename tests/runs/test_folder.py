import sys
from pathlib import Path

import gymnasium as gym
import minigrid  # noqa: F401  # registers its environments, before a test takes a copy of the registry
import numpy as np
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import cli
from sb3_options.runs import folder as runs
from sb3_options.runs.algorithms import make_model
from sb3_options.runs.config import configure


@pytest.mark.parametrize("algo", ["dqn", "a2c"])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_runs_of_different_seeds_share_no_environment(algo: str, n_envs: int) -> None:
    seeds: list[int] = []
    for seed in range(3):
        config = configure(algo=algo, seed=seed, n_envs=n_envs, device="cpu")
        env = runs.make_env(config, n_envs, seed)
        make_model(config, env)
        env.reset()
        seeds += env.get_attr("np_random_seed")
        env.close()
    assert seeds == list(range(3 * n_envs))


@pytest.mark.parametrize(
    ("env_id", "hint"),
    [
        ("MiniGrid-DorKey-5x5-v0", "Did you mean 'MiniGrid-DoorKey-5x5-v0'?"),
        ("TwoRoms-v0", "Did you mean 'sb3_options/TwoRooms-v0'?"),
        ("my/Puzzle-v3", "If a package registers it, name its module: --env module:ID."),
    ],
)
def test_an_unknown_environment(env_id: str, hint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gym, "registry", {key: spec for key, spec in gym.registry.items() if key != env_id})
    with pytest.raises(ValueError, match="There is no environment") as error:
        runs.check_env_id(env_id)
    assert str(error.value) == f"There is no environment {env_id!r}. {hint}"


def test_minigrid_is_ready_for_training_and_its_workers_know_it() -> None:
    for env_id in ("MiniGrid-Empty-5x5-v0", "minigrid:MiniGrid-Empty-5x5-v0"):
        runs.check_env_id(env_id)
        config = configure(algo="maskableppo", env=env_id, device="cpu")
        env = runs.make_env(config, 1, 0, vec_env="subproc" if env_id.startswith("minigrid:") else "dummy")
        assert env.get_attr("traits")[0].feature_kind == "environment"
        env.close()


def test_a_place_that_holds_no_folders_is_named_with_its_flag(tmp_path: Path) -> None:
    (tmp_path / "a file").touch()
    with pytest.raises(NotADirectoryError) as error:
        runs.new_run_folder(configure(algo="dqn", tensorboard_log=tmp_path / "a file"))
    assert str(error.value) == (
        f"--tensorboard-log {tmp_path / 'a file'} cannot hold run folders: Not a directory "
        f"({tmp_path / 'a file' / 'dqn'}). Name another one."
    )


def test_a_run_folder_that_is_discarded_takes_an_empty_one_along(tmp_path: Path) -> None:
    first, second = (runs.new_run_folder(configure(algo="dqn", tensorboard_log=tmp_path)) for _ in range(2))
    runs.discard(first)
    assert second.is_dir()
    runs.discard(second)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("algo", ["qrdqn", "maskableppo"])
def test_an_algorithm_that_is_not_installed_leaves_no_folder(
    algo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "space.yml").write_text(f"base: {{algo: {algo}}}\nsearch: {{gamma: [0.9, 0.99]}}\n")
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    for words in ([algo, "--tensorboard-log"], ["tune", str(tmp_path / "space.yml"), "--out"]):
        with pytest.raises(SystemExit, match="1"):
            cli.main([*words, str(tmp_path / "made")])
        assert "PPO needs sb3-contrib: pip install" in capsys.readouterr().err.replace("QRDQN", "PPO")
        assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    "env_id", ["minigrid:MiniGrid-Empty-5x5-v0", "sb3_options.envs:sb3_options/TwoRooms-v0", "gymnasium:CartPole-v1"]
)
def test_an_id_with_its_module_can_have_shorter_episodes(env_id: str) -> None:
    """As those of an evaluation are."""
    venv = runs.make_env(configure(algo="maskableppo", env=env_id), 1, 0, max_steps=3)
    venv.reset()
    ends = [venv.step(np.array([0]))[2][0] for _ in range(3)]
    assert ends == [False, False, True]
