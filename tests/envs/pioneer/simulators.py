"""The Pioneer in each simulator that is installed, for tests that hold in all of them."""

from importlib.util import find_spec

import pytest

from sb3_options.envs.pioneer import Pioneer, PioneerMuJoCo
from sb3_options.envs.pioneer.env import PioneerTask

CLASSES: dict[str, type[PioneerTask]] = {"pybullet": Pioneer, "mujoco": PioneerMuJoCo}

needs_pybullet = pytest.mark.skipif(find_spec("pybullet") is None, reason="PyBullet is not installed")
needs_mujoco = pytest.mark.skipif(find_spec("mujoco") is None, reason="MuJoCo is not installed")

SIMULATORS = [pytest.param("pybullet", marks=needs_pybullet), pytest.param("mujoco", marks=needs_mujoco)]
"""For ``parametrize``."""
