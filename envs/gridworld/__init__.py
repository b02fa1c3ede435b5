"""Gridworlds with bottlenecks."""

from sb3_options.envs.gridworld.env import GridWorld

__all__ = ["GridWorld"]
