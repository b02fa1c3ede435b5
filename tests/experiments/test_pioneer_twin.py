"""The study of the twin: that it runs, goes on where it was, and counts right."""

import json
from pathlib import Path

import pytest

pytest.importorskip("pybullet")
pytest.importorskip("mujoco")

from experiments.pioneer import twin
from experiments.pioneer.settings import PioneerSettings
from experiments.pioneer.twin import Study, main

TINY = PioneerSettings(trials=8, step_limit=60, min_positive=2, threshold=0.05, network_updates=20)


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


def test_numbers_are_of_paired_trials() -> None:
    def side(reached: list[bool], steps: list[int]) -> dict[str, object]:
        return {"reached": reached, "steps": steps, "task": {"successes": [True] * 4, "steps": [10, 20, 30, 40]}}

    runs = [
        {"PyBullet": side([True, True, True, False], [1, 2, 3, 4]), "MuJoCo": side([True] * 4, [2, 3, 4, 5])},
        {"PyBullet": side([True] * 4, [1, 1, 1, 1]), "MuJoCo": side([False] + [True] * 3, [2, 2, 2, 2])},
    ]
    numbers = twin.numbers_of(runs, {"PyBullet": [100.0, 200.0], "MuJoCo": [200.0, 400.0]})
    assert numbers["option"]["success"]["PyBullet"]["mean"] == 7 / 8
    assert numbers["option"]["success_of_runs"] == {"PyBullet": [0.75, 1.0], "MuJoCo": [1.0, 0.75]}
    assert numbers["option"]["success_difference"]["mean"] == 0
    assert numbers["option"]["success_difference"]["low"] < 0 < numbers["option"]["success_difference"]["high"]
    assert numbers["option"]["steps_difference"] == {"mean": 1, "low": 1, "high": 1}
    assert numbers["task"]["success_difference"] == {"mean": 0, "low": 0, "high": 0, "bar": 0.05, "reached": True}
    assert numbers["speed"]["ratio"]["mean"] == 2
    assert "| the option alone: success | 0.875 (" in twin.table(numbers)
