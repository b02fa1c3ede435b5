"""The study leaves every picture and number it promises; what its pieces say is checked against hand-made cases."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper import agents, measures
from experiments.paper.__main__ import GROUPS, Study, main
from experiments.paper.report import Report
from experiments.paper.report import main as fill_in
from experiments.paper.settings import PaperSettings
from sb3_options.experience.trajectories import LabelledTrajectory
from tests.support.helpers import trajectory_of

TINY = PaperSettings(
    min_positive=2, threshold=0.05, max_places=50, max_extent=50.0, replay_sweeps=2,
    step_limit=2500, random_step_limit=1000, negative_step_limit=300, trials=6, histogram_trials=(2, 5),
    density_trials=4, control_trials=6, transfer_trials=2, reuse_trials=1, negative_trials=6,
)  # fmt: skip
RATIO = {"mean", "low", "high"}


def test_all_figures_with_their_numbers_and_again_from_what_was_kept(tmp_path: Path) -> None:
    study = Study(figure="all", out=tmp_path, runs=2, first_seed=0, jobs=1, settings=TINY)
    main(study)
    results = json.loads((tmp_path / "results.json").read_text())
    assert {path.stem for path in tmp_path.glob("*.png")} == set(GROUPS) == set(results["figures"])
    assert set(results) == {"command", "n_runs", "seconds", "settings", "claims", "figures"}
    assert results["n_runs"] == 2
    assert len(results["claims"]) == 21
    assert all(set(c) == {"name", "value", "low", "high", "bar", "reached"} for c in results["claims"].values())
    assert results["settings"]["decay"] == {"value": 0.8, "in_paper": None}
    assert set(results["figures"]["figure2"]) >= {"diverse_density", "first_visit_baseline", "option_trial"}
    for figure in ("figure3", "figure4", "figure5", "figure6", "controls"):
        assert all(set(ratio) == RATIO for ratio in results["figures"][figure]["ratios"].values())

    document = tmp_path / "paper.md"
    shutil.copy(Path(__file__).parents[2] / "docs" / "studies" / "paper.md", document)
    fill_in(Report(tmp_path / "results.json", document))
    filled = document.read_text()
    assert "| `decay` | 0.8 | no |" in filled
    assert all(f"`{claim}`" in filled for claim in results["claims"])
    fill_in(Report(tmp_path / "results.json", document))
    assert document.read_text() == filled

    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("groups/*/seeds/*.json")}
    assert len(kept) == 2 * 5
    main(dataclasses.replace(study, figure="figure3"))
    again = json.loads((tmp_path / "results.json").read_text())
    assert again["figures"]["figure3"] == results["figures"]["figure3"]
    assert kept == {path: path.stat().st_mtime_ns for path in kept}


def walk(*cells: tuple[int, int], goal: bool = True) -> LabelledTrajectory:
    trajectory = trajectory_of([np.array(c, dtype=np.float64) for c in cells], terminated=goal, is_success=goal)
    return LabelledTrajectory(trajectory, np.asarray(trajectory.states), goal)


def world() -> Any:
    return agents.world_of(agents.make_agent(PaperSettings(), 0))


def test_visits_are_counted_by_hand() -> None:
    trajectories = [walk((0, 0), (1, 0), (0, 0), (1, 0)), walk((1, 0), (2, 0))]
    every = measures.visit_counts(world(), trajectories, first_only=False)
    first = measures.visit_counts(world(), trajectories, first_only=True)
    assert every[0, :4].tolist() == [2, 3, 1, 0]
    assert first[0, :4].tolist() == [1, 2, 1, 0]
