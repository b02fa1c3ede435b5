from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.diverse_density import __main__ as diverse_density
from benchmarks.diverse_density.data import uneven
from benchmarks.diverse_density.parts import area_under_curve
from benchmarks.diverse_density.references import BagByBag, Vectorised
from tests.density.test_diverse_density import oracle


def test_references_agree_with_the_definition() -> None:
    rng = np.random.default_rng(0)
    data = uneven(rng, 3, n_bags=6, shortest=1, longest=4)
    for reference in (Vectorised(data.positive, data.negative), BagByBag(data.positive, data.negative)):
        for _ in range(5):
            theta = np.concatenate([rng.normal(size=3), rng.uniform(0.3, 1.5, 3)])
            value, gradient = reference(theta)
            assert value == pytest.approx(float(-oracle(theta[:3], theta[3:], data.positive, data.negative)), rel=1e-9)
            for k in range(6):
                step = 1e-6 * np.eye(6)[k]
                slope = (reference(theta + step)[0] - reference(theta - step)[0]) / 2e-6
                assert gradient[k] == pytest.approx(slope, rel=1e-5, abs=1e-7)


def test_area_under_curve() -> None:
    assert area_under_curve(np.array([0.1, 0.4, 0.4, 0.9]), np.array([0, 0, 1, 1])) == pytest.approx(0.875)


def test_runs_without_the_musk_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    diverse_density.main(
        diverse_density.Benchmark(out=out, musk1=tmp_path / "none.npz", kernel_rounds=1, bags=20, instances=20, added=2)
    )
    assert "There are no Musk1 data" in capsys.readouterr().out
    results = json.loads((out / "results.json").read_text())
    assert set(results) == {"command", "kernel", "one_more_bag"}
    assert set(results["kernel"]["8"]) == {"nanoseconds", "limit_nanoseconds", "share_of_limit"}
    assert (out / "diverse_density.png").stat().st_size > 0


def test_one_part_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    diverse_density.main(
        diverse_density.Benchmark(out=tmp_path / "out", parts=("one_more_bag",), bags=20, instances=20, added=2)
    )
    assert "one more bag, ms" in capsys.readouterr().out
    part = json.loads((tmp_path / "out" / "results.json").read_text())["one_more_bag"]
    assert part["distance_of_best_peak"] < 0.5
    assert part["nats_below_search_anew"] < 0.01
    assert not (tmp_path / "out" / "diverse_density.png").exists()
