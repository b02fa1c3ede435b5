"""How options are discovered in MiniGrid."""

from __future__ import annotations

from typing import Any

DISCOVERY: dict[str, Any] = {
    "settings": {
        "capacity": 500,
        "start_radius": 0.5,
        "goal_radius": 0.5,
        "salient_share": 0.6,
        "min_positive": 8,
        "decay": 0.8,
    },
    "option_settings": {"grow": True},
}
"""Arguments of `SubgoalDiscoveryCallback` that suit MiniGrid; ``train.py`` has them, too.

Successes are rare at first, so discovery keeps many trajectories, and what is rarely come upon stands for them. On the
few features of a group, near the start is nearly everywhere, and what stands out there need not persist for long.
Options are learned anew as more is seen.
"""
