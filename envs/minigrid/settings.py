"""Settings of discovery in MiniGrid."""

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
"""Arguments of `SubgoalDiscoveryCallback` for MiniGrid, also used by ``train.py``.

Successes are rare at first, so discovery keeps many trajectories, and rare events stand for successes. On the few
features of a group, nearly every state is near the start, so radii are small. A state that stands out need not persist
for long. Options are learned again as experience grows.
"""
