"""Stable-Baselines3 callbacks of sb3-options."""

from sb3_options.callbacks.checkpoints import CheckpointCallback, EndedAtCheckpointError, load_checkpoint
from sb3_options.callbacks.discovery import SubgoalDiscoveryCallback
from sb3_options.callbacks.intrinsic import IntrinsicRewardCallback
from sb3_options.callbacks.keeper import ClosedOption, DiscoveredOption
from sb3_options.callbacks.offline import discover
from sb3_options.callbacks.primitive_steps import PrimitiveStepsCallback
from sb3_options.callbacks.zoo import ZooDiscoveryCallback
from sb3_options.options.settings import UsefulnessSettings

__all__ = [
    "CheckpointCallback",
    "ClosedOption",
    "DiscoveredOption",
    "EndedAtCheckpointError",
    "IntrinsicRewardCallback",
    "PrimitiveStepsCallback",
    "SubgoalDiscoveryCallback",
    "UsefulnessSettings",
    "ZooDiscoveryCallback",
    "discover",
    "load_checkpoint",
]
