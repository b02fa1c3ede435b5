"""Discovery by EM-DD."""

import numpy as np
import pytest

from sb3_options.discovery.bag_maker import FilteredBags
from sb3_options.discovery.most_likely import MostLikelyDiscovery
from sb3_options.discovery.settings import DiscoverySettings


@pytest.mark.parametrize("kind", ["environment", "categorical"])
def test_what_is_certain_is_what_a_search_finds(kind: str) -> None:
    discovery = MostLikelyDiscovery(DiscoverySettings(scale=3.0), kind=kind)
    codes = np.eye(9)
    evidence = FilteredBags([codes[[1, 4, 2]], codes[[5, 4, 1]], codes[[4, 6, 1]]], [])
    discovery._maker.scale = np.full(9, 3.0)
    certain = discovery._certain(evidence, discovery.engine())
    assert [peak.point.argmax() for peak in certain] == [1, 4]
    best = [peak for peak in discovery._peaks(evidence, discovery.engine()) if peak.log_density > -1e-9]
    assert sorted(int(peak.point.argmax()) for peak in best) == [1, 4]
    assert all(peak.log_density == pytest.approx(0.0, abs=1e-9) for peak in certain + best)
