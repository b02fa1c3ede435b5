import json
from dataclasses import asdict
from pathlib import Path

import pytest

from experiments.kills import __main__ as kills
from experiments.kills.__main__ import Study, Victim


def results(study: Study, victims: list[Victim]) -> None:
    kills._report(study, victims)


def test_counts_on_from_earlier_results(tmp_path: Path) -> None:
    before = [Victim("ppo", [(1.5, 1000), (None, None)], {"options": []})]
    results(Study(out=tmp_path, kills=2), before)
    (found,) = kills._done(Study(out=tmp_path, kills=100))
    assert json.loads(json.dumps(asdict(found))) == json.loads(json.dumps(asdict(before[0])))


@pytest.mark.parametrize("other", [{"seed": 1}, {"n_timesteps": 9_000}, {"algorithms": ("ppo",)}])
def test_results_of_another_study_do_not_count(tmp_path: Path, other: dict[str, int]) -> None:
    results(Study(out=tmp_path), [Victim("ppo")])
    assert kills._done(Study(out=tmp_path, **other)) == []  # type: ignore[arg-type]  # of several types
