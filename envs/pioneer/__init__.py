"""A Pioneer robot with a gripper, simulated in PyBullet."""

from sb3_options.envs.pioneer.env import Pioneer

__all__ = ["Pioneer"]
