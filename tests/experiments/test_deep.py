"""The deep study, small: its arithmetic against numbers worked out by hand, and that it runs and resumes."""

import json
from pathlib import Path
from typing import Any

import pytest

from experiments.deep import __main__ as deep
from experiments.deep import tasks, tune
from experiments.deep.settings import DeepSettings
from experiments.deep.summary import steps_to_success, summarise


def result(steps: list[int], success: list[float], length: float = 20.0, **kwargs: Any) -> dict[str, Any]:
    return {"steps": steps, "success": success, "final_length": length, "final_success": 1.0, "options": []} | kwargs


def test_steps_to_success() -> None:
    lucky_once = result([0, 1000, 2000, 3000, 4000], [0.0, 0.9, 0.5, 1.0, 0.9])
    assert steps_to_success(lucky_once, 9000) == 3000
    assert steps_to_success(result([0, 1000, 2000], [0.0, 0.85, 1.0]), 9000) == 9000


def test_summary_by_hand() -> None:
    stock = [result([0, 2000, 3000], [0.0, 1.0, 1.0], 20.0) for _ in range(4)]
    ours = [result([0, 1000, 2000], [0.0, 1.0, 1.0], 22.0, brought=[[1.0, 2.0]]) for _ in range(3)]
    ours.append(result([0, 1000], [0.0, 0.2], 22.0))
    numbers = summarise({"stock": stock, "options": ours}, 4000)
    assert numbers["stock"]["steps_to_90"]["mean"] == 2000
    assert numbers["options"]["steps_to_90"]["mean"] == 1000  # the interquartile mean leaves the failure out
    assert numbers["options"]["mean_steps_to_90"]["mean"] == 1750
    assert numbers["options"]["never"] == 1
    assert numbers["options"]["with_option"] == 3
    assert numbers["options"]["steps_to_90_of_stock"]["mean"] == 0.5
    assert numbers["options"]["probability_of_improvement"]["mean"] == 0.75
    assert numbers["options"]["final_steps_of_stock"]["mean"] == pytest.approx(1.1)


def test_study_writes_results_and_picture_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = DeepSettings(evaluate_every=250, evaluation_episodes=2, final_evaluations=1)
    short = {key: tasks.Task(t.env, t.target, t.source, 500, 300) for key, t in tasks.TASKS.items()}
    monkeypatch.setattr(deep, "TASKS", short)
    study = deep.Study(out=tmp_path, task="transfer", env="FourRooms", runs=1, jobs=1, settings=settings)
    deep.main(study)
    content = json.loads((tmp_path / "results.json").read_text())
    for algo in ("dqn", "ppo"):
        for arm in ("stock", "options", "repeats"):
            assert content["results"]["FourRooms"][algo][arm]["n_runs"] == 1
    assert (tmp_path / "curves.png").stat().st_size > 10_000
    kept = sorted(tmp_path.glob("runs/*/seeds/*.json"))
    assert len(kept) == 6
    assert (tmp_path / "seconds.png").stat().st_size > 10_000
    for run in content["runs"]["FourRooms"]["dqn"]["options"]:
        assert len(run["seconds"]) == len(run["steps"])
        assert run["seconds"] == sorted(run["seconds"])
        assert 0 <= run["seconds"][0] < run["seconds"][-1] < content["seconds"]
    before = [path.stat().st_mtime_ns for path in kept]
    deep.main(study)
    assert [path.stat().st_mtime_ns for path in kept] == before


def test_tuning_writes_what_was_best_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    key = ("transfer", "FourRooms")
    task = tasks.TASKS[key]
    monkeypatch.setattr(tune, "TASKS", {key: tasks.Task(task.env, task.target, task.source, 300, 200)})
    tune.main(tune.Tuning(out=tmp_path, algo="ppo", arm="options", trials=1, seeds=1, jobs=1))
    tune.main(tune.Tuning(out=tmp_path, algo="ppo", arm="options", trials=2, seeds=1, jobs=1))
    written = json.loads((tmp_path / "ppo-options" / "tuned.json").read_text())
    assert written["finished"] + written["pruned"] == 2
    assert written["steps_to_90"] == {"transfer, FourRooms": [300]}
    assert set(written["best"]) >= {"learning_rate", "n_steps", "net_arch"}
