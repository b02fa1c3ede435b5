"""Stable-Baselines3 callbacks of sb3-options."""

from sb3_options.callbacks.discovery import DiscoveredOption, SubgoalDiscoveryCallback
from sb3_options.callbacks.primitive_steps import PrimitiveStepsCallback
from sb3_options.callbacks.zoo import ZooDiscoveryCallback

__all__ = ["DiscoveredOption", "PrimitiveStepsCallback", "SubgoalDiscoveryCallback", "ZooDiscoveryCallback"]
