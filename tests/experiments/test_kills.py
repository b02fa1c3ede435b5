import json
from dataclasses import asdict
from pathlib import Path

import pytest

from experiments.kills import __main__ as kills
from experiments.kills.__main__ import Study, Victim


def test_counts_on_from_earlier_results(tmp_path: Path) -> None:
    before = [Victim("ppo", [(1.5, 1000), (None, None)], [1000, 0], {"options": []})]
    kills._report(Study(out=tmp_path, kills=2), before)
    (found,) = kills._done(Study(out=tmp_path, kills=100))
    assert json.loads(json.dumps(asdict(found))) == json.loads(json.dumps(asdict(before[0])))


@pytest.mark.parametrize(("went_on_from", "counts"), [([], False), ([0], False), ([0, 1000], True)])
def test_a_run_counts_where_training_went_on_beyond_step_0(went_on_from: list[int], counts: bool) -> None:
    assert Victim("ppo", went_on_from=went_on_from).counts == counts


@pytest.mark.slow
@pytest.mark.parametrize("case", ["a script of a user's", "ppo in worker processes"])
def test_a_killed_run_ends_like_one_that_is_not(case: str, tmp_path: Path) -> None:
    flags = ("--eval-freq", "0", "--n-steps", "64", "--batch-size", "64", "--n-epochs", "1")
    study = Study(out=tmp_path, kills=1, cases=(case,), n_timesteps=3_000, checkpoint_freq=300, early=0.0, flags=flags)
    kills.main(study)
    (victim,) = kills._done(study)
    assert victim.counts
    assert not any(victim.differences.values())
