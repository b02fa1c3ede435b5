"""The settings that ship for an environment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sb3_options.envs.minigrid import is_minigrid
from sb3_options.runs import yaml_file

TUNED_FOLDER = Path(__file__).parent / "tuned"

TUNED = {
    f"sb3_options/{name}-v0": "pioneer.yml"
    for name in ("Pioneer", "PioneerCorner", "PioneerClutter", "PioneerTwoBalls", "PioneerMuJoCo")
}
"""File of the settings that ship for an environment, by its id."""


def shipped(env_id: str) -> dict[str, Any]:
    """Those of an environment; none where the defaults hold."""
    file = TUNED.get(env_id, "minigrid.yml" if is_minigrid(env_id) else None)
    return {} if file is None else yaml_file.read_mapping(TUNED_FOLDER / file)
