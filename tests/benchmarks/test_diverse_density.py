from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.diverse_density import __main__ as diverse_density
from benchmarks.diverse_density.data import uneven
from benchmarks.diverse_density.references import BagByBag, Vectorised
from tests.density.definition import oracle


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


def test_runs_without_the_musk_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    diverse_density.main(diverse_density.Benchmark(out=out, musk1=tmp_path / "none.npz", kernel_rounds=1))
    assert "There are no Musk1 data" in capsys.readouterr().out
    results = json.loads((out / "results.json").read_text())
    assert set(results) == {"command", "kernel"}
    assert set(results["kernel"]["8"]) == {"nanoseconds", "two_kernels_nanoseconds", "two_kernels_share"}
    assert (out / "diverse_density.png").stat().st_size > 0
