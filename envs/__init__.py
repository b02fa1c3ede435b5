"""Environments with bottlenecks; importing this module registers them under ``sb3_options/``.

- ``sb3_options/TwoRooms-v0``: two rooms and one doorway, McGovern & Barto (2001), §6.1.
- ``sb3_options/FourRooms-v0``: four rooms and four hallways, Sutton, Precup & Singh (1999).
- ``sb3_options/KeyDoor-v0``: find the key that opens the door to the goal.
- ``sb3_options/Pioneer-v0``: a simulated robot takes a ball to a wall, McGovern & Barto (2001), §7.
- ``sb3_options/PioneerCorner-v0``: it takes the ball to one marked corner.
- ``sb3_options/PioneerClutter-v0``: obstacles are in its way.
- ``sb3_options/PioneerTwoBalls-v0``: it takes two balls to the walls.
- ``sb3_options/PioneerMuJoCo-v0``: the robot of ``Pioneer-v0`` in MuJoCo; ``deposit="corner"``, ``n_obstacles=4`` and
  ``n_balls=2`` give the other three tasks.

The first three are `GridWorld`. The next four are `sb3_options.envs.pioneer.Pioneer`, which needs PyBullet
(``pip install "sb3-options[pioneer]"``, wheels up to CPython 3.11). The last is
`sb3_options.envs.pioneer.PioneerMuJoCo`, which needs MuJoCo (``pip install "sb3-options[mujoco]"``, wheels for every
Python). `gymnasium.make` passes on all keyword arguments. The step limit is the environment's own ``max_steps``, so
``gymnasium.make(..., max_steps=None)`` lifts it.
"""

from typing import Any

import gymnasium

from sb3_options.envs.gridworld import maps
from sb3_options.envs.gridworld.env import KEY_FEATURE_SCALE, GridWorld
from sb3_options.envs.gridworld.grid_map import Direction
from sb3_options.envs.gridworld.maps import FOUR_ROOMS, KEY_DOOR, TWO_ROOMS
from sb3_options.envs.last_action import LastActionObservation

__all__ = [
    "FOUR_ROOMS",
    "KEY_DOOR",
    "KEY_FEATURE_SCALE",
    "TWO_ROOMS",
    "Direction",
    "GridWorld",
    "LastActionObservation",
]


def _register(name: str, entry_point: str, **kwargs: Any) -> None:
    env_id = f"sb3_options/{name}-v0"
    # Registering twice warns, and a reloaded module would do so.
    if env_id not in gymnasium.registry:
        gymnasium.register(env_id, entry_point=f"sb3_options.envs.{entry_point}", kwargs=kwargs)


_register("TwoRooms", "gridworld:GridWorld", map=TWO_ROOMS, max_steps=maps.TWO_ROOMS_MAX_STEPS)
_register("FourRooms", "gridworld:GridWorld", map=FOUR_ROOMS, max_steps=maps.FOUR_ROOMS_MAX_STEPS)
_register("KeyDoor", "gridworld:GridWorld", map=KEY_DOOR, max_steps=maps.KEY_DOOR_MAX_STEPS)
_register("Pioneer", "pioneer:Pioneer")
_register("PioneerCorner", "pioneer:Pioneer", deposit="corner")
_register("PioneerClutter", "pioneer:Pioneer", n_obstacles=4)
_register("PioneerTwoBalls", "pioneer:Pioneer", n_balls=2)
_register("PioneerMuJoCo", "pioneer:PioneerMuJoCo")
