"""The overhead benchmark, small: its arithmetic, and that it runs."""

import json
import time
from pathlib import Path

import pytest

from benchmarks import checkpoints, overhead, phases
from sb3_options.runs.config import configure


def test_ratios_are_taken_within_turns() -> None:
    rates = {"stock": [100.0, 200.0], "wrapped": [90.0, 198.0], "discovering": [80.0, 180.0]}
    results = overhead.summarise(rates)
    assert results["wrapped_of_stock"]["mean"] == pytest.approx(0.945)
    assert not results["wrapped_of_stock"]["reached"]
    assert results["discovering_of_stock"]["mean"] == pytest.approx(0.85)


@pytest.mark.parametrize("scenarios", ["dqn,ppo", pytest.param("ppo_subprocesses", marks=pytest.mark.slow)])
def test_benchmark_writes_results_and_picture(tmp_path: Path, scenarios: str) -> None:
    overhead.main(overhead.Benchmark(out=tmp_path, rounds=1, chunk=256, scenarios=scenarios))
    content = json.loads((tmp_path / "results.json").read_text())
    for scenario in scenarios.split(","):
        rates = content[scenario]["primitive_steps_per_second"]
        assert set(rates) == set(overhead.KINDS[scenario])
        assert min(rates.values()) > 0
        assert content[scenario]["wrapped_of_stock"]["mean"] > 0
    assert (tmp_path / "overhead.png").stat().st_size > 5_000


@pytest.mark.parametrize("algo", ["ppo", "dqn"])
def test_every_turn_has_a_checkpoint(algo: str, tmp_path: Path) -> None:
    small = configure(algo=algo, seed=0, device="cpu", checkpoint_freq=300)
    found = checkpoints.race(small, tmp_path, 2, small.checkpoint_freq, description="")
    assert found["checkpoints_written"] == 2
    assert 0 < found["share_of_processor_time"]["mean"] < 1


def test_phases_of_a_training_add_up() -> None:
    began = time.process_time()
    spent = phases._phases("TwoRooms", "maskable_ppo", "options", 512, 0)
    whole = time.process_time() - began
    times = [spent[phase] for phase in phases.PHASES]
    assert all(x > 0 for x in times)
    assert sum(times) * 512 / 1e6 <= whole
