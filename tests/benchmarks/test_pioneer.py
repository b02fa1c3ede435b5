"""The Pioneer's benchmark: its arithmetic, and that it runs."""

import json
from pathlib import Path

import pytest

pytest.importorskip("panda_gym")

from benchmarks import pioneer
from benchmarks.pioneer import Turn


def test_shares_and_ratios_are_taken_within_turns() -> None:
    turns = {
        "pioneer": [Turn(0.2, 0, 0, 100), Turn(0.4, 0, 0, 100)],
        "pioneer_timed": [Turn(0.25, 0.2, 4000, 100), Turn(0.5, 0.4, 4000, 100)],
        "panda_gym": [Turn(0.2, 0, 0, 100), Turn(0.4, 0, 0, 100)],
        "panda_gym_timed": [Turn(0.4, 0.2, 2000, 100), Turn(0.4, 0.2, 2000, 100)],
    }
    results = pioneer.summarise(turns)
    assert results["primitive_actions_per_second"]["mean"] == pytest.approx((500 + 250) / 2)
    assert results["physics_steps_per_action"]["mean"] == 40
    assert results["pybullet_share_of_step"] == pytest.approx(
        {"mean": 0.8, "low": 0.8, "high": 0.8, "bar": 0.75, "reached": True}
    )
    assert results["panda_gym_pybullet_share_of_step"]["mean"] == 0.5
    assert results["pioneer_microseconds_per_physics_step"]["mean"] == pytest.approx(75)
    assert results["pioneer_of_panda_gym_per_physics_step"]["mean"] == pytest.approx(0.5)


def test_benchmark_runs_and_writes_results(tmp_path: Path) -> None:
    pioneer.main(pioneer.Benchmark(out=tmp_path, rounds=2, actions=10))
    content = json.loads((tmp_path / "results.json").read_text())
    assert content["command"].startswith("python -m benchmarks.pioneer")
    assert 0 < content["pybullet_share_of_step"]["mean"] < 1
    assert 0 < content["panda_gym_pybullet_share_of_step"]["mean"] < 1
    assert content["primitive_actions_per_second"]["mean"] > 0
    assert content["physics_steps_per_action"]["mean"] > 2
