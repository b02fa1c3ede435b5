"""The study of a new user's first hour, small."""

import json
from pathlib import Path

from experiments.first_hour import __main__ as first_hour
from experiments.first_hour.conditions import COMPETENT_EPISODES, competent_after
from sb3_options.experience.trajectories import EpisodeRecord


def test_writes_what_it_found(tmp_path: Path) -> None:
    conditions = ("maskableppo", "maskableppo, filter by distances")
    study = first_hour.Study(task="lake", out=tmp_path, runs=2, n_timesteps=300, jobs=1, conditions=conditions)
    first_hour.main(study)
    content = json.loads((tmp_path / "results.json").read_text())
    assert set(content["summary"]) == set(conditions)
    assert [run["seed"] for run in content["runs"]["maskableppo"]] == [1000, 1001]
    assert content["command"].endswith("--n-timesteps 300 --conditions maskableppo 'maskableppo, filter by distances'")


def test_competence_takes_success_and_short_ways() -> None:
    good = [EpisodeRecord(30 * i, 1.0, True, 30) for i in range(1, COMPETENT_EPISODES + 1)]
    assert competent_after(good) == 30 * COMPETENT_EPISODES
    assert competent_after(good[1:]) is None
    assert competent_after([e._replace(success=False) for e in good]) is None
    assert competent_after([e._replace(steps=41) for e in good]) is None
