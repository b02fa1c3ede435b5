"""``train.py resume RUN``, in this process; ``experiments.kills`` kills real ones."""

import dataclasses
import json
import os
import shutil
import signal
import time
import zipfile
from pathlib import Path

import pytest

from experiments.kills.comparison import differences, scalars, texts
from sb3_options import cli
from sb3_options.callbacks import CheckpointCallback
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs import training
from sb3_options.runs.folder import held
from sb3_options.runs.training import is_finished
from tests.support.runs import Refused
from tests.support.sb3_helpers import FAST_DISCOVERY, SMALL_ROOMS

CONFIG = f"""
algo: ppo
env: sb3_options/TwoRooms-v0
env_kwargs: {{map: {json.dumps(SMALL_ROOMS)}, max_steps: 150}}
n_timesteps: 2000
n_envs: 2
n_steps: 64
batch_size: 64
n_epochs: 1
net_arch: [8]
eval_freq: 700
eval_episodes: 1
checkpoint_freq: 400
progress: false
discovery: {FAST_DISCOVERY}
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that has ended, with checkpoints every 400 steps."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "config.yml").write_text(CONFIG, encoding="utf-8")
    cli.main(["--config", str(folder / "config.yml"), "--tensorboard-log", str(folder)])
    return folder / "ppo" / "sb3_options-TwoRooms-v0_1"


def wait_for_the_next_second() -> None:
    """TensorBoard's files are read in the order of their names: a second, then how many this process has written.

    As texts 9 comes after 10. Users resume in another process, and later.
    """
    began = int(time.time())
    while int(time.time()) == began:
        time.sleep(0.01)


def cut_off(run: Path, folder: Path, *, before_the_last: bool = False) -> Path:
    """The run as a process leaves it that is killed after the last checkpoint, or after the one before."""
    copy = Path(shutil.copytree(run, folder / run.name))
    for name in (runs.MODEL, runs.SUBGOALS):
        (copy / name).unlink()
    if before_the_last:
        next(iter(CheckpointFolder(copy / runs.CHECKPOINTS))).unlink()
    return copy


@pytest.mark.parametrize("before_the_last", [False, True])
def test_a_resumed_run_is_the_run_that_was_not_cut_off(run: Path, before_the_last: bool, tmp_path: Path) -> None:
    copy = cut_off(run, tmp_path, before_the_last=before_the_last)
    wait_for_the_next_second()
    cli.main(["resume", str(copy), "--no-progress"])
    assert {what: those for what, those in differences(run, copy).items() if those} == {}
    points, told = scalars(copy), texts(copy)
    assert points
    for resumed, whole in ((points, scalars(run)), (told, texts(run))):
        assert {tag: [step for step, _ in those] for tag, those in resumed.items()} == {
            tag: [step for step, _ in those] for tag, those in whole.items()
        }
    assert any(name.endswith("/_hparams_/session_start_info") for name in told)
    assert (copy / runs.SUBGOALS).is_file()


@pytest.mark.parametrize("algo", ["ppo", "dqn"])
def test_an_interrupted_run_goes_on_where_it_ended(
    algo: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    flags = ["--n-timesteps", "1200", "--checkpoint-freq", "700", "--eval-freq", "150", "--eval-episodes", "1"]
    flags += ["--env-kwargs", "max_steps:50", "--no-progress", "--device", "cpu"]
    own = {"ppo": "--n-envs 1 --n-steps 64 --batch-size 64", "dqn": "--learning-starts 50"}
    flags += own[algo].split()
    alone, victim = (tmp_path / name / algo / "sb3_options-TwoRooms-v0_1" for name in ("alone", "victim"))
    cli.main([algo, *flags, "--tensorboard-log", str(alone.parents[1])])

    class Interrupted(CheckpointCallback):
        at: int | None = 333

        def _on_step(self) -> bool:
            if Interrupted.at is not None and self.model.num_timesteps >= Interrupted.at:
                os.kill(os.getpid(), signal.SIGTERM)
                Interrupted.at = {333: 555}.get(Interrupted.at)
            return super()._on_step()

    Interrupted.__name__ = CheckpointCallback.__name__  # which checkpoints hold
    monkeypatch.setattr(training, "CheckpointCallback", Interrupted)
    monkeypatch.setattr(training, "PATIENCE", 600.0)  # the machine may be busy
    for args in ([algo, *flags, "--tensorboard-log", str(victim.parents[1])], ["resume", str(victim), "--no-progress"]):
        capsys.readouterr()
        wait_for_the_next_second()
        with pytest.raises(SystemExit) as stopped:
            cli.main(args)
        assert stopped.value.code == 128 + signal.SIGTERM
        assert "Resume: " in capsys.readouterr().out
        file, _ = CheckpointFolder(victim / runs.CHECKPOINTS).newest()
        ended = zipped_steps(victim / runs.MODEL)
        assert ended == int(file.stem) > 300
    wait_for_the_next_second()
    cli.main(["resume", str(victim), "--no-progress"])
    assert f"Going on after {ended:,} primitive steps." in capsys.readouterr().out
    assert {what: those for what, those in differences(alone, victim).items() if those} == {}


def zipped_steps(model: Path) -> int:
    with zipfile.ZipFile(model) as archive:
        return int(json.loads(archive.read("data"))["num_timesteps"])


class TestFinished:
    def test_goes_on_for_longer(self, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        copy = Path(shutil.copytree(run, tmp_path / run.name))
        steps = int(next(iter(CheckpointFolder(run / runs.CHECKPOINTS))).stem)
        cli.main(["resume", str(copy), "--no-progress", "--n-timesteps", "2600"])
        said = capsys.readouterr().out
        assert f"Going on after {steps:,} primitive steps." in said
        assert "for 2,600 primitive steps" in said
        assert zipped_steps(copy / runs.MODEL) >= 2600
        kept = configs.load(copy / runs.CONFIG)
        assert dataclasses.replace(kept, n_timesteps=2000) == configs.load(run / runs.CONFIG)
        assert is_finished(kept, copy)


def test_a_run_that_is_being_trained_is_refused(run: Path, refused: Refused, tmp_path: Path) -> None:
    copy = cut_off(run, tmp_path)
    with held(copy):
        assert f"{copy} is being trained by another process: wait" in refused("resume", str(copy), "--no-progress")
    assert not (copy / runs.MODEL).exists()
