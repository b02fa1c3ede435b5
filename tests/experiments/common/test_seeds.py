"""Studies go on where they were, and only there."""

import dataclasses
import importlib
import json
from pathlib import Path
from typing import Any

import experiments
from experiments.common.machines import Machines
from experiments.common.seeds import Part, run_parts, run_seeds


def doubled(seed: int) -> dict[str, Any]:
    return {"doubled": 2 * seed}


def broken(seed: int) -> dict[str, Any]:
    raise AssertionError(f"seed {seed} was run again")


def test_results_are_in_order_of_seeds(tmp_path: Path) -> None:
    results = run_seeds(doubled, [5, 3], tmp_path, settings={"a": 1}, on=Machines(jobs=1))
    assert results == [{"doubled": 10}, {"doubled": 6}]


def test_finished_seeds_are_not_run_again(tmp_path: Path) -> None:
    run_seeds(doubled, [3, 5], tmp_path, settings={"a": 1}, on=Machines(jobs=1))
    assert run_seeds(broken, [5], tmp_path, settings={"a": 1}, on=Machines(jobs=1)) == [{"doubled": 10}]


def test_other_settings_run_again(tmp_path: Path) -> None:
    (tmp_path / "seeds").mkdir()
    (tmp_path / "seeds" / "3.json").write_text(json.dumps({"settings": {"a": 2}, "result": {"doubled": 0}}))
    assert run_seeds(doubled, [3], tmp_path, settings={"a": 1}, on=Machines(jobs=1)) == [{"doubled": 6}]


def squared(seed: int) -> dict[str, Any]:
    return {"squared": seed * seed}


def test_parts_share_the_processes_and_keep_their_results_apart(tmp_path: Path) -> None:
    parts = [Part("double", doubled, tmp_path / "a"), Part("square", squared, tmp_path / "b")]
    results = run_parts(parts, [5, 3], settings={}, on=Machines(jobs=2))
    assert results == {"double": [{"doubled": 10}, {"doubled": 6}], "square": [{"squared": 25}, {"squared": 9}]}
    assert len(list(tmp_path.glob("*/seeds/*.json"))) == 4


def test_every_study_can_run_on_a_cluster() -> None:
    modules = [path.parent.name for path in Path(experiments.__file__).parent.glob("*/__main__.py")]
    studies = [importlib.import_module(f"experiments.{name}.__main__").Study for name in modules]
    with_jobs = [study for study in studies if "jobs" in {field.name for field in dataclasses.fields(study)}]
    assert len(with_jobs) >= 12
    assert all(issubclass(study, Machines) for study in with_jobs)
