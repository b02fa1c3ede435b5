"""From trajectories to subgoals. Pure.

`DiscoverySettings` and `SubgoalDiscovery` are what users name.
"""

from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.discovery.subgoals import SubgoalDiscovery

__all__ = ["DiscoverySettings", "SubgoalDiscovery"]
