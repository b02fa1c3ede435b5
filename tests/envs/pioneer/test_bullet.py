"""The simulator in PyBullet."""

import pytest

pytest.importorskip("pybullet")

from sb3_options.envs.pioneer.arena import Box, Cylinder, Placement
from sb3_options.envs.pioneer.bullet_simulator import BulletSimulator

NOWHERE = Placement((0, 0, 0), balls=((0.6, 0),), obstacles=())


def test_connects_late_and_closes_twice() -> None:
    simulator = BulletSimulator()
    assert simulator.client == -1
    simulator.close()
    simulator.build(NOWHERE, [], [Cylinder((-2, 0, 0.5), 0.25, 1)])
    client = simulator.client
    assert simulator.p.isConnected(client)
    simulator.close()
    simulator.close()
    assert not simulator.p.isConnected(client)


def test_rays_hit_walls_and_obstacles_only() -> None:
    simulator = BulletSimulator()
    simulator.build(NOWHERE, [Box((2, 0, 0.5), (0.5, 1, 0.5))], [Cylinder((-2, 0, 0.5), 0.25, 1)])
    starts, ends = [(0, 0, 0.08)] * 3, [(4, 0, 0.08), (-4, 0, 0.08), (0, 4, 0.08)]  # through robot and ball
    assert simulator.ray_fractions(starts, ends) == pytest.approx([1.5 / 4, 1.75 / 4, 1], abs=1e-3)
    simulator.close()
