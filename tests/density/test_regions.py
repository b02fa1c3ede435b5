"""Whether places lie in regions: one place at a time gives what many give at once."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from sb3_options.density.groups import FeatureGroup
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


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64])
@pytest.mark.parametrize("kind", ["balls", "half-space", "nothing"])
def test_one_place_of_a_group_is_as_one_of_many(kind: str, dtype: type[Any], rng: np.random.Generator) -> None:
    group = FeatureGroup("g", (3, 1), present=((3,), (1, 3)), scale=(2.0, 0.5))
    centres = rng.integers(-2, 3, size=(0 if kind == "nothing" else 4, 2)).astype(float)
    normal = np.array([1.0, -0.5]) if kind == "half-space" else None
    region = Region(centres, np.array([2.0, 0.5]), 0.4, group=group, normal=normal)
    places = rng.integers(-2, 3, size=(300, 5)).astype(dtype)
    whole = region.contains(places)
    assert [bool(region.contains(place[None])[0]) for place in places] == whole.tolist()
    assert 0 < whole.sum() < 300 or kind == "nothing"
    for n in (1, 2):
        with pytest.raises(ValueError, match="group 'g' names feature 3, the feature map gives 3"):
            dataclasses.replace(region, group=dataclasses.replace(group, present=())).contains(places[:n, :3])


def test_a_place_on_the_edge() -> None:
    """A distance of exactly the radius, to the last bit, for one centre and for several."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        centre, place, scale = rng.normal(size=(3, 4))
        radius = float(cdist([place * scale], [centre * scale])[0, 0])
        for points in (centre[None], np.stack([centre, centre + 1e6])):
            assert Region(points, scale, radius).contains(place[None]).tolist() == [True]
            assert Region(points, scale, np.nextafter(radius, 0)).contains(place[None]).tolist() == [False]
