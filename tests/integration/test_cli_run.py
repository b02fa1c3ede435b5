"""One run, trained from the shell: what it leaves, evaluated, taken up by another run, and spoilt."""

import json
import os
import shutil
import subprocess
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from sb3_options import OptionBank
from sb3_options.cli import parse
from sb3_options.runs import config as configs
from sb3_options.runs.evaluation import evaluate_run
from sb3_options.runs.video import CAPTION_HEIGHT
from tests.support import processes
from tests.support.runs import Refused, train
from tests.support.sb3_helpers import SMALL_ROOMS, read_video

ROOT = Path(__file__).parents[2]
CONFIG = f"""
algo: dqn
env_kwargs: {{map: {json.dumps(SMALL_ROOMS)}, max_steps: 150}}
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
    words = "--config config.yml --eval-freq 700 --eval-episodes 2 --seed 1 --n-timesteps 8000"
    done = shell(*words.split(), cwd=folder)
    assert done.returncode == 0, done.stderr
    return Run(folder / "runs" / "dqn" / "sb3_options-TwoRooms-v0_1", done.stdout)


@pytest.fixture
def copied(run: Run, tmp_path: Path) -> Path:
    """A folder with what evaluation needs of the run."""
    for name in ("config.yml", "model.zip", "options.safetensors"):
        shutil.copy(run.folder / name, tmp_path)
    return tmp_path


class TestTrain:
    def test_leaves_a_run_folder(self, run: Run) -> None:
        names = {str(p.relative_to(run.folder)) for p in run.folder.rglob("*") if p.is_file()}
        events = {name for name in names if "events.out.tfevents" in name}
        assert len(events) == 1
        assert names - events == {
            "config.yml", "model.zip", "best_model.zip", "options.safetensors", "subgoals.png", "evaluations.npz",
            "monitor/0.monitor.csv", "checkpoints/000000000000.safetensors", "checkpoints/finished.yml",
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


class TestErrors:
    def test_options_that_do_not_fit_leave_no_folder(self, run: Run, tmp_path: Path, refused: Refused) -> None:
        def text(options: Path, *args: str) -> str:
            return refused("--options", str(options), *args, "--tensorboard-log", str(tmp_path / "runs"))

        file = run.folder / "options.safetensors"
        assert f"{tmp_path / 'no'}" in text(tmp_path / "no")
        assert f"{tmp_path / 'options.safetensors'}" in text(tmp_path)
        assert "config.yml is no options file" in text(run.folder / "config.yml")
        assert "model.zip does not fit: its options were made for" in text(run.folder / "model.zip")
        assert "slot 0" in text(run.folder, "--max-options", "0")
        said = f"{file} does not fit: its options were made for observations Box(0.0, 1.0, (45,), float32)"
        assert said in text(run.folder)
        assert not (tmp_path / "runs").exists()

    @pytest.mark.parametrize("missing", ["config.yml", "model.zip", "options.safetensors"])
    def test_a_run_without_its_files(self, missing: str, copied: Path, refused: Refused) -> None:
        (copied / missing).unlink()
        assert f"No such file or directory: '{copied / missing}'" in refused("evaluate", str(copied))

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
        self, name: str, spoil: Any, expected: str, copied: Path, refused: Refused
    ) -> None:
        (copied / name).write_bytes(spoil((copied / name).read_bytes()))
        assert expected in refused("evaluate", str(copied), "--episodes", "1")

    def test_a_stranger_s_model_runs_nothing(self, copied: Path, refused: Refused) -> None:
        """A pickle in the place of the weights is refused; SB3's own ``load`` would unpickle the data beside them."""
        import pickle

        class Evil:
            def __reduce__(self) -> Any:
                return os.mkdir, (str(copied / "ran"),)

        with zipfile.ZipFile(copied / "model.zip", "w") as archive:
            archive.writestr("data", json.dumps({"policy_class": {":serialized:": ""}}))
            archive.writestr("policy.pth", pickle.dumps(Evil(), protocol=2))
        said = refused("evaluate", str(copied), "--episodes", "1")
        assert said.endswith(": its weights are damaged, or hold Python objects, which are not read.\n")
        assert not (copied / "ran").exists()
