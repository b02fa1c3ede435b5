"""The study of the twin: that it runs, goes on where it was, and counts right."""

import json
from pathlib import Path

import pytest

pytest.importorskip("pybullet")
pytest.importorskip("mujoco")

from experiments.pioneer.settings import PioneerSettings
from experiments.pioneer.twin import Study, main
from sb3_options.options import creation

TINY = PioneerSettings(trials=8, step_limit=60, min_positive=2, threshold=0.05)


@pytest.fixture(autouse=True)
def _learned_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(creation, "NETWORK_UPDATES", 20)


def test_an_option_is_tried_in_both_and_again_from_its_file(tmp_path: Path) -> None:
    study = Study(out=tmp_path / "learned", runs=1, first_seed=3, trials=3, rounds=2, jobs=1, settings=TINY)
    main(study)
    results = json.loads((study.out / "results.json").read_text())
    assert (study.out / "twin.png").is_file()
    for kind in ("option", "task"):
        assert set(results[kind]["success"]) == {"PyBullet", "MuJoCo"}
        assert len(results[kind]["success_of_runs"]["MuJoCo"]) == 1
    file = study.out / "artifacts" / "3.safetensors"
    main(Study(out=tmp_path / "file", runs=1, first_seed=3, trials=3, rounds=2, jobs=1, settings=TINY, options=file))
    again = json.loads((tmp_path / "file" / "results.json").read_text())
    assert again["option"] == results["option"]
    assert "task" not in again
    assert f"--options {file}" in again["command"]
