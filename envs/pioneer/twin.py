"""The Pioneer's twin in MuJoCo: the same task, body, actions and senses."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_options.envs.pioneer.arena import Placement
from sb3_options.envs.pioneer.env import PioneerTask
from sb3_options.envs.pioneer.mujoco_simulator import MuJoCoSimulator
from sb3_options.envs.pioneer.senses import Sensed, Sighting


class PioneerMuJoCo(PioneerTask):
    """The robot in MuJoCo, which has wheels for every Python. It takes the arguments of `PioneerTask`.

    Options learned in `Pioneer` work in it, and vice versa. It has no window, so no render mode ``"human"``. It can
    save and restore its state, so training resumes in mid-episode without repeating the episode.
    """

    metadata = {**PioneerTask.metadata, "render_modes": ["rgb_array", "rgb_array_list"]}  # noqa: RUF012

    simulator: MuJoCoSimulator

    def get_state(self) -> dict[str, Any]:
        """Return the state of the episode as numbers and arrays, for `set_state`, without ``np_random``."""
        placement = self._placement
        robot = self._robot
        if placement is None or self._closed:
            return {"placement": None}
        return {
            "placement": {name: np.array(value) for name, value in placement._asdict().items()},
            "physics": self.simulator.get_state(),
            "pose": np.array(robot.pose),
            "held": robot.held,
            "balls": np.array([(i, *place) for i, place in robot.balls.items()]).reshape(-1, 3),
            "deposited": np.array(self._deposited).reshape(-1, 2),
            "ranges": np.array(self._sensed.ranges),
            "sightings": np.array(self._sensed.sightings).reshape(-1, 2),
            "elapsed": self._elapsed,
            "over": self._over,
            "ticks": self._ticks,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from `get_state`, in an environment made with the same arguments."""
        self._refuse_if_closed("set_state")
        if state["placement"] is None:
            self._placement = None
            return
        placement = Placement(
            tuple(state["placement"]["robot"].tolist()),
            *(tuple(map(tuple, state["placement"][name].tolist())) for name in ("balls", "obstacles")),
        )
        self._placement = placement
        robot = self._robot
        robot.build(placement, self._arena.walls, self._arena.obstacles(placement))
        self.simulator.set_state(state["physics"])
        robot.pose = tuple(state["pose"].tolist())
        robot.held = state["held"]
        robot.balls = {int(i): (x, y) for i, x, y in state["balls"].tolist()}
        self._deposited = [(x, y) for x, y in state["deposited"].tolist()]
        sightings = [Sighting(left, right) for left, right in state["sightings"].tolist()]
        self._sensed = Sensed(state["ranges"].tolist(), sightings)
        self._elapsed = state["elapsed"]
        self._over = state["over"]
        self._ticks = state["ticks"]
        self._pictures = []

    def _make_simulator(self, *, window: bool) -> MuJoCoSimulator:
        return MuJoCoSimulator()
