"""Whether places lie in regions: one place at a time gives what many give at once."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from sb3_options.density.regions import Region


@pytest.mark.parametrize("n_centres", [0, 1, 3, 40])
@pytest.mark.parametrize("d", [1, 2, 5])
@pytest.mark.parametrize(("decimals", "radius"), [(1, 0.7), (0, 0.7), (0, 0.4)])  # the last: whole numbers lie apart
def test_one_place_is_as_one_of_many(
    n_centres: int, d: int, decimals: int, radius: float, rng: np.random.Generator
) -> None:
    region = Region(rng.normal(size=(n_centres, d)).round(decimals), rng.uniform(0.5, 2, d), radius)
    places = rng.normal(size=(200, d)).round(1)
    places = np.concatenate([places, places.round(), region.points, np.full((1, d), np.nan), np.full((1, d), np.inf)])
    whole = region.contains(places)
    assert [bool(region.contains(place[None])[0]) for place in places] == whole.tolist()
    assert whole[400 : 400 + n_centres].all()
    if n_centres:
        nearest = cdist(places * region.scale, region.points * region.scale).min(axis=1)
        np.testing.assert_array_equal(whole, nearest <= region.radius)


def test_a_place_on_the_edge() -> None:
    """A distance of exactly the radius, to the last bit, for one centre and for several."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        centre, place, scale = rng.normal(size=(3, 4))
        radius = float(cdist([place * scale], [centre * scale])[0, 0])
        for points in (centre[None], np.stack([centre, centre + 1e6])):
            assert Region(points, scale, radius).contains(place[None]).tolist() == [True]
            assert Region(points, scale, np.nextafter(radius, 0)).contains(place[None]).tolist() == [False]
