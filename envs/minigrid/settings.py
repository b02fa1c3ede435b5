"""How options are discovered in MiniGrid."""

from __future__ import annotations

from typing import Any

DISCOVERY: dict[str, Any] = {
    "settings": {
        "capacity": 500,
        "start_radius": 0.5,
        "goal_radius": 0.5,
        "max_share": 0.06,
        "salient_share": 0.6,
        "min_positive": 8,
        "decay": 0.8,
    },
    "option_settings": {"grow": True},
}
"""Arguments of `SubgoalDiscoveryCallback` that suit MiniGrid; ``train.py`` has them, too.

Successes are rare at first, so discovery keeps many trajectories, and what is rarely come upon stands for them. On the
few features of a group, near the start is nearly everywhere, and what stands out there need not persist for long.
A step takes longer than the budget assumes: with ``max_share`` 0.06 searches take 0.05 of 40,000 steps at most. Options
are learned anew as more is seen.
"""
