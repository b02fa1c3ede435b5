"""From trajectories to subgoals. Pure.

`DiscoverySettings` and `SubgoalDiscovery` are what users name.
"""

from sb3_options.discovery.subgoals import DiscoverySettings, SubgoalDiscovery

__all__ = ["DiscoverySettings", "SubgoalDiscovery"]
