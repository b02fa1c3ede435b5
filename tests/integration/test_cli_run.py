"""One run, trained from the shell: what it leaves, evaluated, taken up by another run, and spoilt."""

import json
import os
import subprocess
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from sb3_options import OptionBank, cli
from sb3_options.cli import parse
from sb3_options.runs import config as configs
from sb3_options.runs.evaluation import evaluate_run
from sb3_options.runs.video import CAPTION_HEIGHT
from tests.support import processes
from tests.support.runs import train
from tests.support.sb3_helpers import read_video

ROOT = Path(__file__).parents[2]
CONFIG = """
algo: dqn
env_kwargs:
  map: |
    SSSS#....
    SSSS#....
    SSSS.....
    SSSS#....
    SSSS#...G
  max_steps: 150
n_timesteps: 4000
progress: false
learning_starts: 200
gamma: 0.9
net_arch: [32]
device: cpu
discovery:
  start_radius: 0.5
  goal_radius: 4.0
  decay: 0.75
option:
  grow: false
"""


class Run(NamedTuple):
    """A run folder, and what was printed while it was made."""

    folder: Path
    printed: str


def shell(*args: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """``python train.py ARGS`` in a new process."""
    environment = {"COLUMNS": "200", "NO_COLOR": "1", "OMP_NUM_THREADS": "1"}
    return processes.python(str(ROOT / "train.py"), *args, cwd=cwd, env=environment)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """One training from the shell, with evaluation and a configuration file."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "config.yml").write_text(CONFIG)
    done = shell(
        "--config",
        "config.yml",
        "--eval-freq",
        "700",
        "--eval-episodes",
        "2",
        "--seed",
        "1",
        "--n-timesteps",
        "8000",
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    return Run(folder / "runs" / "dqn" / "sb3_options-TwoRooms-v0_1", done.stdout)


class TestTrain:
    def test_leaves_a_run_folder(self, run: Run) -> None:
        names = {str(p.relative_to(run.folder)) for p in run.folder.rglob("*") if p.is_file()}
        events = {name for name in names if "events.out.tfevents" in name}
        assert len(events) == 1
        assert names - events == {
            "config.yml", "model.zip", "best_model.zip", "options.safetensors", "subgoals.png", "evaluations.npz",
            "monitor/0.monitor.csv", "checkpoints/000000000000.safetensors",
            "checkpoints/finished.yml",
        }  # fmt: skip


class TestOptions:
    """A run that starts with the options of another."""

    def test_discovery_goes_on_elsewhere(self, run: Run, tmp_path: Path) -> None:
        (tmp_path / "config.yml").write_text(CONFIG)
        args = ["--config", str(tmp_path / "config.yml"), "--options", str(run.folder / "options.safetensors")]
        args += ["--discovery.min-passing", "0", "--discovery.loops", "keep"]  # the doorway is taken: any place will do
        folder = train(parse([*args, "--tensorboard-log", str(tmp_path), "--seed", "1"]))
        bank = OptionBank(4, 4)
        bank.load(folder / "options.safetensors")
        assert bank.filled == (0, 1)
        old, new = (bank[slot].subgoal.points[0] for slot in (0, 1))  # type: ignore[union-attr]  # discovered
        assert np.linalg.norm(old - new) > configs.load(folder / "config.yml").discovery.spacing


class TestEvaluate:
    @pytest.fixture(scope="class")
    @staticmethod
    def evaluated(run: Run) -> subprocess.CompletedProcess[str]:
        """The run, evaluated from the shell with a video."""
        return shell("evaluate", str(run.folder), "--episodes", "5", "--video", "film/f.mp4", cwd=run.folder)

    def test_films_every_primitive_step(self, run: Run, evaluated: subprocess.CompletedProcess[str]) -> None:
        assert evaluated.returncode == 0
        frames = read_video(run.folder / "film" / "f.mp4", 5 * 32 + CAPTION_HEIGHT, 9 * 32)
        kept = json.loads((run.folder / "evaluation.json").read_text())
        assert len(frames) == round(5 * kept["primitive_steps"]["mean"]) + 5  # and the first picture of each episode
        assert all(len(np.unique(frame[: 5 * 32] // 32)) > 2 for frame in frames)
        strips = [frame[5 * 32 + 2 :].mean() for frame in frames]
        assert max(strips) - min(strips) > 0.5  # a primitive action, and an option by its name
        assert any(not np.array_equal(frames[0], frame) for frame in frames[1:])

    def test_the_same_seed_gives_the_same_result_and_another_does_not(self, run: Run) -> None:
        def play(seed: int) -> Any:
            return evaluate_run(run.folder, episodes=4, seed=seed)

        assert play(3) == play(3)
        assert len({play(seed).steps.mean for seed in range(3, 7)}) > 1


class Stopping:
    """Commands that end in an error."""

    def stopped(self, capsys: pytest.CaptureFixture[str], *args: str) -> str:
        with pytest.raises(SystemExit) as stopped:
            cli.main(list(args))
        assert stopped.value.code == 1
        captured = capsys.readouterr()
        return " ".join(captured.err.split())


class TestErrors(Stopping):
    def test_options_that_do_not_fit_leave_no_folder(
        self, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        def text(options: Path, *args: str) -> str:
            logs = ["--tensorboard-log", str(tmp_path / "runs")]
            return self.stopped(capsys, "--options", str(options), *args, *logs)

        file = run.folder / "options.safetensors"
        assert f"{tmp_path / 'no'}" in text(tmp_path / "no")
        assert f"{tmp_path / 'options.safetensors'}" in text(tmp_path)
        assert "config.yml is no options file" in text(run.folder / "config.yml")
        assert "model.zip does not fit: its options were made for" in text(run.folder / "model.zip")
        assert "slot 0" in text(run.folder, "--max-options", "0")
        assert f"{file} does not fit: its options were made for observations Box(0.0, 1.0, (45,), float32)" in text(
            run.folder
        )
        assert not (tmp_path / "runs").exists()

    @pytest.mark.parametrize("missing", ["config.yml", "model.zip", "options.safetensors"])
    def test_a_run_without_its_files(
        self, missing: str, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        for name in {"config.yml", "model.zip", "options.safetensors"} - {missing}:
            (tmp_path / name).write_bytes((run.folder / name).read_bytes())
        text = self.stopped(capsys, "evaluate", str(tmp_path))
        assert f"No such file or directory: '{tmp_path / missing}'" in text

    @pytest.mark.parametrize(
        ("name", "spoil", "expected"),
        [
            ("model.zip", lambda content: b"no zip", "model.zip is damaged"),
            ("model.zip", lambda content: content[: len(content) // 2], "model.zip is damaged"),
            ("options.safetensors", lambda content: content[:99], "options.safetensors is no options file"),
            ("config.yml", lambda content: content.replace(b"- 32", b"- 33"), "does not fit"),
            ("config.yml", lambda content: content + b"\nseed: !!python/object:os.system {}\n", "be read safely"),
        ],
    )  # fmt: skip
    def test_a_run_with_spoilt_files(
        self, name: str, spoil: Any, expected: str, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        for kept in ("config.yml", "model.zip", "options.safetensors"):
            (tmp_path / kept).write_bytes((run.folder / kept).read_bytes())
        (tmp_path / name).write_bytes(spoil((tmp_path / name).read_bytes()))
        assert expected in self.stopped(capsys, "evaluate", str(tmp_path), "--episodes", "1")

    def test_a_stranger_s_model_runs_nothing(
        self, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """A pickle in the place of the weights is refused; SB3's own ``load`` would unpickle the data beside them."""
        import pickle

        class Evil:
            def __reduce__(self) -> Any:
                return os.mkdir, (str(tmp_path / "ran"),)

        for kept in ("config.yml", "model.zip", "options.safetensors"):
            (tmp_path / kept).write_bytes((run.folder / kept).read_bytes())
        with zipfile.ZipFile(tmp_path / "model.zip", "w") as archive:
            archive.writestr("data", json.dumps({"policy_class": {":serialized:": ""}}))
            archive.writestr("policy.pth", pickle.dumps(Evil(), protocol=2))
        text = self.stopped(capsys, "evaluate", str(tmp_path), "--episodes", "1")
        assert "model.zip is damaged" in text
        assert not (tmp_path / "ran").exists()
