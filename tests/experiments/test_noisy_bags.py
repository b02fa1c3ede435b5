from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.noisy_bags import __main__ as noisy_bags


def test_contamination_adds_an_instance_to_some_negative_bags() -> None:
    clean, dirty = (noisy_bags.make(0, share, 10, 5) for share in (0.0, 0.3))
    assert [len(bag) for bag in clean.negative] == [5] * 10
    assert [len(bag) for bag in dirty.negative] == [6] * 3 + [5] * 7
    np.testing.assert_array_equal(dirty.negative[0][:5], clean.negative[0])
    assert np.linalg.norm(dirty.negative[0][5] - noisy_bags.PLACE) < 1


@pytest.mark.parametrize("way", noisy_bags.WAYS)
def test_every_way_finds_the_place_among_clean_bags(way: str) -> None:
    assert noisy_bags.found(way, noisy_bags.make(1, 0.0, 10, 10)) < 0.5


def test_writes_results(tmp_path: Path) -> None:
    noisy_bags.main(noisy_bags.Study(out=tmp_path, runs=1, shares=(0.0,), bags=4, instances=4))
    results = json.loads((tmp_path / "results.json").read_text())
    assert set(results["found"]) == set(noisy_bags.WAYS)
    assert (tmp_path / "noisy_bags.png").stat().st_size > 0
