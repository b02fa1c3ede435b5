"""The robot's study leaves every picture and number it promises; what its pieces say is checked by hand."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

pytest.importorskip("pybullet")

from experiments.pioneer import conditions
from experiments.pioneer.__main__ import GROUPS, Study, main
from experiments.pioneer.report import Report
from experiments.pioneer.report import main as fill_in
from experiments.pioneer.settings import MAIN_TASK, TASKS, PioneerSettings
from sb3_options.options import creation
from sb3_options.runs.config import configure

TINY = PioneerSettings(trials=5, transfer_trials=1, evaluation_trials=1, step_limit=300, min_positive=2, threshold=0.05)


@pytest.fixture(autouse=True)
def _learned_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(creation, "NETWORK_UPDATES", 20)


@pytest.mark.slow
def test_all_figures_with_their_numbers_and_again_from_what_was_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conditions, "DQN_EVALUATION_EPISODES", 5)
    dqn = configure(env=MAIN_TASK, n_timesteps=300, learning_starts=100, env_kwargs={"max_steps": 20})
    study = Study(
        figure="all", out=tmp_path, runs=2, transfer_runs=1, dqn_runs=1, first_seed=0, jobs=1, settings=TINY, dqn=dqn
    )
    main(study)
    results = json.loads((tmp_path / "results.json").read_text())
    assert {path.stem for path in tmp_path.glob("*.png")} == set(GROUPS)
    figures = results["figures"]
    assert set(figures) == {"figure8", "learning", "transfer", "dqn"}
    assert figures["figure8"]["n_runs"] == len(figures["figure8"]["subgoals"]) == 2
    assert set(figures["transfer"]) == {"n_runs", *TASKS}
    for numbers in (figures["learning"], figures["dqn"], *(figures["transfer"][task] for task in TASKS)):
        assert all(ratio["low"] <= ratio["mean"] <= ratio["high"] for ratio in numbers["ratios"].values())
    for condition in ("primitive", "discovery"):
        for figure in ("learning", "dqn"):
            assert set(figures[figure][condition]["evaluation"]) == {"success_rate", "steps", "touches"}

    document = tmp_path / "pioneer.md"
    shutil.copy(Path(__file__).parents[2] / "docs" / "studies" / "pioneer.md", document)
    files = Path(__file__).parents[2] / "docs" / "results"
    fill_in(Report(tmp_path / "results.json", files / "pioneer_benchmark.json", files / "pioneer-twin.json", document))
    filled = document.read_text()
    assert "| `decay` | 0.8 | no |" in filled
    assert "of 2 runs made their option" in filled

    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("groups/*/seeds/*.json")}
    assert len(kept) == 2 + 1 + 1
    main(dataclasses.replace(study, figure="figure8"))
    again = json.loads((tmp_path / "results.json").read_text())
    assert again["figures"]["figure8"] == figures["figure8"]
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
