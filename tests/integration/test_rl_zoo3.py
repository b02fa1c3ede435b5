"""Train, play and record with rl-zoo3 itself, by the YAML files that ship."""

import csv
import importlib.util
import os
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from sb3_options import OptionBank
from sb3_options.zoo import FILES, loaded_model
from tests.support import processes
from tests.support.sb3_helpers import FAST_DISCOVERY, SMALL_ROOMS

ROOT = Path(__file__).parents[2]
ENV = "sb3_options/TwoRooms-v0"
RUN = "sb3_options-TwoRooms-v0_1"
# So that the option is chosen now and then in play, whatever these few steps have taught.
EXPLORING = {"dqn": ["exploration_final_eps:0.5"], "qrdqn": ["exploration_final_eps:0.5"]}
# Eight environments at once end fewer episodes each, and options move in between rollouts.
N_TIMESTEPS = {"dqn": 5000, "qrdqn": 2500, "ppo": 8000}

needs_zoo = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("rl_zoo3", "requests")),  # which it does not declare
    reason="rl-zoo3 is not installed: pip install '.[zoo]'",
)


def zoo(program: str, folder: Path, *arguments: str, env_id: str = ENV) -> str:
    """Run a program of rl-zoo3 as a user does, and return what it printed."""
    (folder / "custom_envs.py").write_text("import sb3_options.envs\n")
    result = processes.python(
        "-m", f"rl_zoo3.{program}", "--env", env_id, *arguments,
        cwd=folder, env={"PYTHONPATH": f"{ROOT}{os.pathsep}{folder}", "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-4000:]
    return result.stdout


def train(folder: Path, algo: str, n_timesteps: int, *arguments: str) -> str:
    """Train with the file that ships, in the small rooms and with a discovery that finds their doorway soon."""
    callback = {"sb3_options.callbacks.ZooDiscoveryCallback": {"settings": FAST_DISCOVERY, "max_new_options": 1}}
    return zoo(
        "train", folder, "--algo", algo, "--conf-file", str(FILES / f"{algo}.yml"), "--num-threads", "1",
        "--n-timesteps", str(n_timesteps), "--seed", "0", "--eval-freq", "1000", "--eval-episodes", "2",
        "--env-kwargs", f"map:{SMALL_ROOMS.strip()!r}", "max_steps:150", "--hyperparams", f"callback:[{callback}]",
        *EXPLORING.get(algo, []), *arguments,
    )  # fmt: skip


def filled_slots(path: Path) -> tuple[int, ...]:
    bank = OptionBank(4, 4)
    bank.load(path)
    return bank.filled


@pytest.mark.parametrize("path", sorted(FILES.glob("*.yml")), ids=lambda path: path.stem)
def test_files_name_classes_that_are_there_and_one_gamma(path: Path) -> None:
    tasks: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    for hyperparameters in tasks.values():
        ((wrapper, arguments),) = hyperparameters["env_wrapper"][0].items()
        assert wrapper == "sb3_options.zoo.ZooOptionsWrapper"
        assert arguments["gamma"] == hyperparameters["gamma"]
        assert list(hyperparameters["callback"][0]) == ["sb3_options.callbacks.ZooDiscoveryCallback"]


@needs_zoo
@pytest.mark.slow
def test_the_guide_s_file_for_minigrid_trains(tmp_path: Path) -> None:
    page = (ROOT / "docs/guide/minigrid.md").read_text(encoding="utf-8")
    (content,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    (env_id,) = yaml.safe_load(content)
    (tmp_path / "minigrid.yml").write_text(content, encoding="utf-8")
    zoo(
        "train", tmp_path, "--algo", "ppo", "--conf-file", "minigrid.yml", "--gym-packages", "minigrid",
        "--n-timesteps", "2500", "--seed", "0", "--num-threads", "1", "--eval-freq", "-1", env_id=env_id,
    )  # fmt: skip
    (model,) = (tmp_path / "logs" / "ppo").glob("*/*.zip")
    assert model.stem == env_id


@needs_zoo
@pytest.mark.slow
@pytest.mark.parametrize("algo", [path.stem for path in sorted(FILES.glob("*.yml"))])
def test_train_enjoy_and_record(tmp_path: Path, algo: str) -> None:
    train(tmp_path, algo, N_TIMESTEPS[algo])
    run = tmp_path / "logs" / algo / RUN
    assert filled_slots(run / f"{ENV.replace('/', '-')}.zip") == (0,)

    where = ("--algo", algo, "-f", "logs")
    printed = zoo("enjoy", tmp_path, *where, "--no-render", "--stochastic", "-n", "300", "--reward-log", "played")
    decisions = [int(length) for length in re.findall(r"Episode Length (\d+)", printed)]
    with (tmp_path / "played" / "0.monitor.csv").open(encoding="utf-8") as file:
        file.readline()
        primitive_steps = [int(row["l"]) for row in csv.DictReader(file)]
    assert decisions
    # Everything but the option takes one primitive step a decision.
    assert sum(decisions) < sum(primitive_steps[: len(decisions)])

    zoo("record_video", tmp_path, *where, "-n", "20")
    (video,) = (run / "videos").glob("*.mp4")
    assert video.stat().st_size > 1000


@needs_zoo
def test_which_run_is_played(tmp_path: Path) -> None:
    for name in ("Rooms-v0_1", "Rooms-v0_2", "a-Rooms-v0_1"):
        (tmp_path / "dqn" / name).mkdir(parents=True)
    for player, words, played in (
        ("enjoy", "Rooms-v0", "Rooms-v0_2/Rooms-v0.zip"),
        ("enjoy", "a/Rooms-v0", "a-Rooms-v0_1/a-Rooms-v0.zip"),
        ("enjoy", "Rooms-v0 --exp-id 1", "Rooms-v0_1/Rooms-v0.zip"),
        ("record_video", "Rooms-v0 --exp-id -1", "Rooms-v0.zip"),
        ("push_to_hub", "Rooms-v0 --exp-id -1", "Rooms-v0.zip"),
    ):
        arguments = ["--algo", "dqn", "-f", str(tmp_path), "--no-render", "-n", "10", "--env", *words.split()]
        assert loaded_model(player, arguments) == tmp_path / "dqn" / played
