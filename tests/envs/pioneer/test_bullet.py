"""The layer over PyBullet."""

import pytest

pytest.importorskip("pybullet")

from sb3_options.envs.pioneer.arena import Box, Cylinder
from sb3_options.envs.pioneer.bullet import Bullet


def test_connects_late_and_closes_twice() -> None:
    bullet = Bullet(1 / 30, 2, 10)
    assert bullet.client == -1
    bullet.close()
    bullet.clear()
    client = bullet.client
    assert bullet.p.isConnected(client)
    bullet.close()
    bullet.close()
    assert not bullet.p.isConnected(client)


def test_rays_hit_what_their_group_may() -> None:
    bullet = Bullet(1 / 30, 2, 10)
    bullet.clear()
    solid = bullet.add_static([Box((2, 0, 0.5), (0.5, 1, 0.5))], [Cylinder((-2, 0, 0.5), 0.25, 1)])
    starts, ends = [(0, 0, 0.5)] * 3, [(4, 0, 0.5), (-4, 0, 0.5), (0, 4, 0.5)]
    bullet.set_filter(solid, -1, 4, 1)
    assert bullet.ray_fractions(starts, ends, 4) == pytest.approx([1.5 / 4, 1.75 / 4, 1], abs=1e-3)
    assert bullet.ray_fractions(starts, ends, 8) == [1, 1, 1]
    bullet.close()
