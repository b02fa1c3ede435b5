import json
from pathlib import Path

import numpy as np
import pytest

from experiments.cluster import calculation
from experiments.cluster.__main__ import Study, main
from experiments.cluster.calculation import Assumptions


def test_the_calculation() -> None:
    told = Assumptions(cores=2, round_trip=0.5, step=1.0, call=0.25, learn=0.125, task=3.6)
    steps, random = np.array([1.0]), np.random.default_rng(0)
    row = calculation.environments(3, 4, told, steps, random)
    # 6 actors of 4 environments: 4 s of steps, 0.5 s of network, 6 calls; the learner takes 24 × 0.125 s.
    assert (row["actors"], row["environments"], row["slowest_actor_s"]) == (6, 24, 4.0)
    assert row["steps_per_second"] == pytest.approx(24 / (4 + 0.5 + 1.5))
    assert row["times_one_machine"] == pytest.approx(24 / 6 / 2)
    assert row["steps_per_second_with_learning"] == pytest.approx(24 / 9)
    uneven = calculation.environments(3, 4, told, np.array([0.0, 2.0]), random)
    assert uneven["slowest_actor_s"] > 5  # the mean of one is 4, but the slowest of six counts
    assert calculation.study(3, 13, 0.5, told)["hours"] == pytest.approx(3 * 0.5 + 13 * 0.001)
    assert calculation.slope({1: [2.0, 2.0, 9.0], 3: [3.0]}) == pytest.approx(0.5)


@pytest.mark.slow
@pytest.mark.cluster
@pytest.mark.xdist_group("cluster")
def test_the_study(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="needs Ray: pip install .[cluster]")
    pytest.importorskip("pybullet")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    main(Study(out=tmp_path, rounds=2, steps=5, envs=2, actors=(1, 2)))
    results = json.loads((tmp_path / "results.json").read_text())
    assert set(results["of_subproc"]) == {"1", "2"}
    assert [row["machines"] for row in results["study"]] == [1, 10, 100]
    assert "RayVecEnv, actors: 2" in capsys.readouterr().out
