"""``train.py resume RUN``, in this process; ``experiments.kills`` kills real ones."""

import shutil
from pathlib import Path

import pytest

from experiments.kills.comparison import differences, scalars
from sb3_options import cli
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.runs import folder as runs

CONFIG = """
algo: ppo
env: sb3_options/TwoRooms-v0
env_kwargs:
  map: |
    SSSS#....
    SSSS#....
    SSSS.....
    SSSS#....
    SSSS#...G
  max_steps: 150
n_timesteps: 2000
n_envs: 2
n_steps: 64
batch_size: 64
n_epochs: 1
net_arch: [8]
eval_freq: 700
eval_episodes: 1
checkpoint_freq: 400
compare: true
progress: false
discovery: {min_positive: 3, start_radius: 0.5, goal_radius: 3.0, decay: 0.5}
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that has ended, with checkpoints every 400 steps."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "config.yml").write_text(CONFIG, encoding="utf-8")
    cli.main(["--config", str(folder / "config.yml"), "--tensorboard-log", str(folder)])
    return folder / "ppo" / "sb3_options-TwoRooms-v0_1"


def cut_off(run: Path, folder: Path, *, before_the_last: bool = False) -> Path:
    """The run as a process leaves it that is killed after the last checkpoint, or after the one before."""
    copy = folder / run.name
    shutil.copytree(run, copy)
    for name in (runs.MODEL, runs.SUBGOALS):
        (copy / name).unlink()
    if before_the_last:
        next(iter(CheckpointFolder(copy / runs.CHECKPOINTS))).unlink()
    return copy


@pytest.mark.parametrize("before_the_last", [False, True])
def test_a_resumed_run_is_the_run_that_was_not_cut_off(run: Path, before_the_last: bool, tmp_path: Path) -> None:
    copy = cut_off(run, tmp_path, before_the_last=before_the_last)
    cli.main(["resume", str(copy), "--no-progress"])
    assert {what: those for what, those in differences(run, copy).items() if those} == {}
    points = scalars(copy)
    assert points
    assert all(len({step for step, _ in of_tag}) == len(of_tag) for of_tag in points.values()), "doubled points"
    assert (copy / runs.SUBGOALS).is_file()


def test_a_run_that_is_cut_off_again_and_again(run: Path, tmp_path: Path) -> None:
    copy = cut_off(run, tmp_path, before_the_last=True)
    for _ in range(2):  # what a process that was killed leaves: events and episodes after the checkpoint
        (copy / "tensorboard_1" / "events.out.tfevents.9.killed").write_bytes(b"rest")
        for file in (copy / runs.MONITOR).iterdir():
            with file.open("a", encoding="utf-8") as opened:
                opened.write("9,9,9\n")
        cli.main(["resume", str(copy), "--no-progress"])
    assert {what: those for what, those in differences(run, copy).items() if those} == {}


def test_shows_how_far_it_is(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    steps = int(next(iter(CheckpointFolder(run / runs.CHECKPOINTS))).stem)
    cli.main(["resume", str(cut_off(run, tmp_path))])
    assert f"Going on after {steps:,} primitive steps." in capsys.readouterr().out


class TestRefuses:
    def refusal(self, capsys: pytest.CaptureFixture[str], *args: str) -> str:
        with pytest.raises(SystemExit) as stopped:
            cli.main(["resume", *args])
        assert stopped.value.code == 1
        return capsys.readouterr().err

    def test_what_is_no_run(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        assert "is no run folder: there is no config.yml in it." in self.refusal(capsys, str(tmp_path))

    def test_a_run_without_checkpoints(self, run: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        copy = cut_off(run, tmp_path)
        shutil.rmtree(copy / runs.CHECKPOINTS)
        assert "There is no checkpoint in" in self.refusal(capsys, str(copy))
        assert (copy / runs.CONFIG).is_file()

    def test_a_run_whose_checkpoints_are_damaged(
        self, run: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
    ) -> None:
        copy = cut_off(run, tmp_path)
        for file in CheckpointFolder(copy / runs.CHECKPOINTS):
            file.write_bytes(file.read_bytes()[:-9])
        assert "is no checkpoint, or it is damaged" in self.refusal(capsys, str(copy), "--no-progress")
        assert (copy / runs.CONFIG).is_file()
        assert not (copy / runs.MODEL).exists()


def test_an_environment_that_does_not_tell_its_state_is_trained_without(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--n-timesteps", "64", "--n-envs", "1", "--n-steps", "32", "--batch-size", "32", "--no-progress"]
    cli.main(["ppo", "--env", "CartPole-v1", *flags, "--tensorboard-log", str(tmp_path)])
    assert "No checkpoints: Checkpoints of CartPoleEnv are not supported yet" in capsys.readouterr().out
    assert not (tmp_path / "ppo" / "CartPole-v1_1" / runs.CHECKPOINTS).exists()
