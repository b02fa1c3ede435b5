"""A hand-written policy for the four Pioneer tasks. It sees what an agent sees, and remembers a few steps."""

import math
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from sb3_options.envs.pioneer.body import BALL_RADIUS
from sb3_options.envs.pioneer.senses import CAMERA_AHEAD, SONARS

SHORT, MIDDLE, LONG, LEFT_10, LEFT_45, RIGHT_10, RIGHT_45 = range(7)
FORWARD = ((LONG, 0.6), (MIDDLE, 0.25), (SHORT, 0.1))
AHEAD = -1
"""In a plan: as far ahead as there is room."""


class Expert:
    """Looks around for the ball, drives at it, and takes it to the next wall, or along the walls to the corner."""

    def __init__(self, *, corner: bool = False, seed: int = 0) -> None:
        self._corner = corner
        self._rng = np.random.default_rng(seed)
        self.reset()

    def reset(self) -> None:
        self._plan: list[int] = []
        self._last: NDArray[np.float32] | None = None
        self._looked = 0
        self._turned_to_wall = False

    def act(self, observation: NDArray[np.float32]) -> int:
        gripping = bool(observation[10])
        free = _room(observation, 0.40 if gripping else 0.345)
        away = LEFT_45 if observation[1] > observation[5] else RIGHT_45
        if self._last is not None and np.abs(observation[:10] - self._last[:10]).max() < 0.03:  # nothing moved
            side = LEFT_45 if self._rng.random() < 0.5 else RIGHT_45
            self._plan = [side] * int(self._rng.integers(1, 3)) + [AHEAD]
        self._last = observation
        while self._plan:
            action: int | None = self._plan.pop(0)
            if action == AHEAD:
                action = _forward(free)
            if action is not None:
                return action
        if gripping:
            return self._follow_wall(observation, free) if self._corner else self._deliver(free, away)
        if observation[7]:
            return self._approach(observation, free, away)
        return self._search(free, away)

    def _deliver(self, free: float, away: int) -> int:
        action = _forward(free)
        if action is None:  # what is ahead is an obstacle
            self._plan = [AHEAD, AHEAD]
            return away
        return action

    def _approach(self, observation: NDArray[np.float32], free: float, away: int) -> int:
        displacement, width = math.degrees(observation[8]), float(observation[9])
        if abs(displacement) > 28:
            return LEFT_45 if displacement > 0 else RIGHT_45
        if abs(displacement) > (5.5 if width < 0.3 else 8):
            return LEFT_10 if displacement > 0 else RIGHT_10
        distance = BALL_RADIUS / math.sin(max(width, 0.05) / 2) + CAMERA_AHEAD
        if distance > 0.6 and free < 0.22:
            self._plan = [AHEAD]
            return away
        action = _forward(free, at_most=max(distance - 0.23, 0.1), margin=-0.02)
        return SHORT if action is None else action

    def _search(self, free: float, away: int) -> int:
        self._looked += 1
        if self._looked <= 8:
            return LEFT_45
        self._looked = int(self._rng.integers(0, 5))
        action = _forward(free)
        if action is None:
            return away
        self._plan = [AHEAD] if self._rng.random() < 0.6 else []
        return action

    def _follow_wall(self, observation: NDArray[np.float32], free: float) -> int:
        """Keeps the wall to the right, about 60 cm off."""
        if free < 0.13:
            return LEFT_45
        if observation[5] < 0.55:
            return LEFT_10
        if observation[6] > 0.62 and observation[5] > 0.9 and not self._turned_to_wall:
            self._turned_to_wall = True
            return RIGHT_10
        self._turned_to_wall = False
        return MIDDLE if free > 0.28 else SHORT


def succeeds(env: gymnasium.Env[Any, Any], expert: Expert, seed: int) -> bool:
    """Whether an episode ends with success."""
    observation, _ = env.reset(seed=seed)
    expert.reset()
    while True:
        observation, _, terminated, truncated, info = env.step(expert.act(observation))
        if terminated or truncated:
            return bool(info["is_success"])


def _room(observation: NDArray[np.float32], tip: float) -> float:
    """How far the robot can drive before what is ``tip`` ahead of its axle meets something that the sonars see, m."""
    room = 5.0
    for (ahead, left, angle), distance in zip(SONARS, observation[:7], strict=True):
        x, y = ahead + distance * math.cos(angle), left + distance * math.sin(angle)
        if x > 0.1 and abs(y) < 0.27:
            room = min(room, x - tip)
    return room


def _forward(free: float, at_most: float = 0.6, margin: float = 0.03) -> int | None:
    for action, distance in FORWARD:
        if distance <= at_most + 0.001 and free > distance + margin:
            return action
    return None
