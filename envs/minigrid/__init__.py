"""MiniGrid for Stable-Baselines3, with a concept space of things and their places relative to the agent.

Needs the package ``minigrid`` (``pip install "sb3-options[minigrid]"``).
"""

from sb3_options.envs.minigrid.ids import MODULE, is_minigrid, make, qualified, require
from sb3_options.envs.minigrid.retina import FEATURES, KINDS, concept_groups, feature_names, retina
from sb3_options.envs.minigrid.settings import DISCOVERY
from sb3_options.envs.minigrid.wrapper import MiniGridWrapper

__all__ = [
    "DISCOVERY",
    "FEATURES",
    "KINDS",
    "MODULE",
    "MiniGridWrapper",
    "concept_groups",
    "feature_names",
    "is_minigrid",
    "make",
    "qualified",
    "require",
    "retina",
]
