"""Where nothing can be written, the file that was asked for is named, and a result that was shown is no failure."""

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_options import cli
from sb3_options.atomic import atomic_write
from sb3_options.runs import compare, evaluation
from sb3_options.runs.evaluation import Evaluation
from sb3_options.runs.intervals import Interval
from sb3_options.runs.logged import Curve, Run
from sb3_options.runs.video import video_file
from tests.runs.test_report import file as file


@pytest.fixture(autouse=True)
def read_only(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the file system does once the options file is there: it removes not even what there is not."""

    def refuse(path: Path, *args: Any, **kwargs: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    for name in ("touch", "unlink"):
        monkeypatch.setattr(Path, name, refuse)


def refused(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    with pytest.raises(SystemExit) as stopped:
        cli.main(args)
    assert stopped.value.code == 1
    return " ".join(capsys.readouterr().err.split())


def test_the_error_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="Read-only") as error, atomic_write(tmp_path / "file"):
        pass
    assert error.value.filename == str(tmp_path / "file")


def test_a_picture_of_options(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "options.png"
    said = f"Error: --out {picture} cannot be written: Read-only file system. Name another one."
    assert refused(capsys, "options", str(file), "--out", str(picture)) == said


def test_a_picture_of_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    steps = np.arange(1.0, 11.0)
    run = Run(tmp_path, {}, {"eval": {}, "rollout": {"success": Curve(steps, steps, steps / 10)}})
    monkeypatch.setattr(compare, "groups_of", lambda names: {"this": [run], "that": [run]})
    picture = tmp_path / "compare.png"
    said = f"Error: --out {picture} cannot be written: Read-only file system. Name another one."
    assert refused(capsys, "compare", "this", "that", "--out", str(picture)) == said


def test_a_video(tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    said = f"^--video {film} cannot be written: Read-only file system. Name another one.$"
    with pytest.raises(OSError, match=said), video_file(film, 10.0):
        pass


def test_an_evaluation_is_shown_all_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    one = Interval(1.0, 0.5, 1.5)
    monkeypatch.setattr(evaluation, "evaluate_run", lambda **asked: Evaluation(7, one, one, one))
    cli.main(["evaluate", str(tmp_path)])
    printed = " ".join(capsys.readouterr().out.split())
    assert "0.500 to 1.500" in printed
    assert f"Not kept: {tmp_path / 'evaluation.json'} cannot be written: Read-only file system. Evaluate a" in printed
