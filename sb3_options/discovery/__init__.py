"""From trajectories to subgoals. Pure.

`DiscoverySettings` and `Discovery` are what users name.
"""

from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.settings import DiscoverySettings

__all__ = ["Discovery", "DiscoverySettings"]
