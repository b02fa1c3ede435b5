"""MiniGrid ready for Stable-Baselines3, with a concept space of relations: what lies where, seen from the agent.

Needs the package ``minigrid`` (``pip install "sb3-options[minigrid]"``).
"""

from sb3_options.envs.minigrid.retina import FEATURES, KINDS, concept_groups, retina
from sb3_options.envs.minigrid.wrapper import MiniGridWrapper, make, require

__all__ = ["FEATURES", "KINDS", "MiniGridWrapper", "concept_groups", "make", "require", "retina"]
