"""The discovery study, small."""

import json
from pathlib import Path

from experiments.discovery import __main__ as discovery
from experiments.discovery.summary import summarise


def result(episode: int | None, distance: int | None) -> dict[str, object]:
    subgoal = None if distance is None else [10 + distance, 5]
    step = None if episode is None else 100 * episode
    found = {"episode": episode, "primitive_step": step, "subgoal": subgoal, "distance": distance}
    return {"seed": 0, "episodes": 99, "final_steps": 30.0, **found}


def test_summary_counts_near_and_early_runs_only() -> None:
    summary = summarise([result(20, 0), result(59, 1), result(60, 0), result(20, 2), result(None, None)])
    assert summary["n_near_and_early"] == 2
    assert summary["n_with_option"] == 4
    assert summary["median_episode"] == 39.5
    low, high = summary["share_near_and_early"]["low"], summary["share_near_and_early"]["high"]
    assert low < 0.4 < high


def test_study_writes_results_and_picture(tmp_path: Path) -> None:
    discovery.main(discovery.Study(out=tmp_path, runs=2, n_timesteps=200, jobs=1))
    content = json.loads((tmp_path / "results.json").read_text())
    assert content["n_runs"] == len(content["runs"]) == 2
    assert content["n_with_option"] == 0
    assert (tmp_path / "discovery.png").stat().st_size > 5_000
