import os
import signal
import subprocess
import sys
from pathlib import Path

import minigrid  # noqa: F401  # registers its environments, before a test takes a copy of the registry
import numpy as np
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.runs import folder as runs
from sb3_options.runs.algorithms import make_model
from sb3_options.runs.config import configure
from tests.runs.conftest import Register
from tests.support.runs import Refused


@pytest.mark.parametrize(("algo", "n_envs"), [("dqn", 1), ("a2c", 3)])
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


def test_minigrid_is_ready_for_training_and_its_workers_know_it() -> None:
    for env_id in ("MiniGrid-Empty-5x5-v0", "minigrid:MiniGrid-Empty-5x5-v0"):
        config = configure(algo="maskableppo", env=env_id, device="cpu")
        env = runs.make_env(config, 1, 0, vec_env="subproc" if env_id.startswith("minigrid:") else "dummy")
        assert env.get_attr("traits")[0].feature_kind == "environment"
        env.close()


def test_a_run_folder_that_is_discarded_takes_an_empty_one_along(tmp_path: Path) -> None:
    first, second = (runs.new_run_folder(configure(algo="dqn", tensorboard_log=tmp_path / "runs")) for _ in range(2))
    runs.discard(first)
    assert second.is_dir()
    runs.discard(second)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("algo", ["qrdqn", "maskableppo"])
def test_an_algorithm_that_is_not_installed_leaves_no_folder(
    algo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    said = refused(algo, "--tensorboard-log", str(tmp_path / "made"))
    assert "PPO needs sb3-contrib: pip install" in said.replace("QRDQN", "PPO")
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("env_id", ["minigrid:MiniGrid-Empty-5x5-v0", "sb3_options.envs:sb3_options/TwoRooms-v0"])
def test_an_id_with_its_module_can_have_shorter_episodes(env_id: str) -> None:
    """As those of an evaluation are."""
    venv = runs.make_env(configure(algo="maskableppo", env=env_id), 1, 0, max_steps=3)
    venv.reset()
    ends = [venv.step(np.array([0]))[2][0] for _ in range(3)]
    assert ends == [False, False, True]


HOLDS = """
import sys, time
from pathlib import Path
from sb3_options.runs.folder import held
with held(Path(sys.argv[1])):
    print("holds it", flush=True)
    time.sleep(600)
"""


def test_another_process_is_refused_until_the_first_is_gone(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", HOLDS, str(tmp_path)], stdout=subprocess.PIPE) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == b"holds it\n"
            with pytest.raises(ValueError, match="is being trained by another process"), runs.held(tmp_path):
                pytest.fail("two hold it")
        finally:
            os.kill(other.pid, signal.SIGKILL)
    assert (tmp_path / runs.LOCK).is_file()  # which keeps nobody
    with runs.held(tmp_path):
        pass
    assert not (tmp_path / runs.LOCK).exists()


def test_no_lock_is_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "users").write_text("own")
    (tmp_path / runs.LOCK).symlink_to(tmp_path / "users")
    with pytest.raises(OSError, match="symbolic links"), runs.held(tmp_path):
        pytest.fail("it was followed")
    assert (tmp_path / "users").read_text() == "own"


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["dqn", "--buffer-size", "10" + "0" * 14], "Unable to allocate"),
        (["ppo", "--n-steps", "10" + "0" * 11], "Unable to allocate"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(
    flags: list[str], said: str, register: Register, tmp_path: Path, refused: Refused
) -> None:
    register(ends_after=5)
    command = [*flags, "--env", "Counted-v0", "--no-progress", "--tensorboard-log", str(tmp_path)]
    assert said in refused(*command)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
