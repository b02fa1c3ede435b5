"""From trajectories to subgoals. Pure.

`DiscoverySettings` and ``Discovery`` are what users name.
"""

from typing import TYPE_CHECKING, Any

from sb3_options.discovery.settings import DiscoverySettings

if TYPE_CHECKING:
    from sb3_options.discovery.discovery import Discovery

__all__ = ["Discovery", "DiscoverySettings"]


def __getattr__(name: str) -> Any:
    """Import `Discovery` when it is asked for: torch is slow to import, and settings need none."""
    if name != "Discovery":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sb3_options.discovery.discovery import Discovery

    return Discovery


def __dir__() -> list[str]:
    """The public names, for completion and the reference."""
    return sorted(__all__)
