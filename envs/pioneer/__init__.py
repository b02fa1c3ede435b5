"""A Pioneer robot with a gripper, simulated in PyBullet or in MuJoCo."""

from sb3_options.envs.pioneer.env import Pioneer
from sb3_options.envs.pioneer.twin import PioneerMuJoCo

__all__ = ["Pioneer", "PioneerMuJoCo"]
