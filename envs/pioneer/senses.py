"""The Pioneer's senses: seven sonars, and a one-dimensional retina on which a ball is an interval.

Angles are in rad in the robot's frame, positive to the left. Sonars and the retina's pixels go from left to right.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_options.envs.pioneer.arena import Pose
from sb3_options.envs.pioneer.body import BALL_RADIUS, BODY_RADIUS
from sb3_options.envs.pioneer.simulator import Simulator
from sb3_options.state import storable

SONARS = tuple(
    (x / 1000, y / 1000, math.radians(heading))
    for x, y, heading in (
        (100, 100, 90),
        (120, 80, 30),
        (130, 40, 15),
        (130, 0, 0),
        (130, -40, -15),
        (120, -80, -30),
        (100, -100, -90),
    )
)
"""Places of the sonars, m, and their directions, rad.

The paper's robot has seven sonars, like the front ring of the Pioneer 1. The front ring of the 2-DX has eight, at 10,
30, 50 and 90 degrees to each side. These are the Pioneer 1's, from its parameter file (``pioneer1.p`` of ActivMedia's
ARIA, section "Sonar parameters").
"""

SONAR_HEIGHT = 0.19  # m above the floor, just below the deck. Balls (16 cm) are lower: sonars do not see them.
SONAR_MIN, SONAR_MAX = 0.1, 5.0  # m, of the Pioneer's sonars. Nearer or farther objects read as the bound.

FIELD_OF_VIEW = math.radians(140)  # McGovern & Barto (2001), §7
CAMERA_AHEAD = 0.10  # m ahead of the axle, on the robot's middle line, at the height of the balls' centres
# Angular width of a ball that touches the body's front, rad. No ball can be nearer.
MAX_WIDTH = 2 * math.asin(BALL_RADIUS / (BODY_RADIUS + BALL_RADIUS - CAMERA_AHEAD))

N_PIXELS = 70  # of the raw retina, 2 degrees each
N_RAYS = 16  # to each ball, one per equal part of its interval. A part is hidden if its ray does not arrive.


@storable
class Sighting(NamedTuple):
    """The visible part of a ball: its left and right edge, rad."""

    left: float
    right: float

    @property
    def displacement(self) -> float:
        """Bearing of the middle of the visible part, rad."""
        return (self.left + self.right) / 2

    @property
    def width(self) -> float:
        """Angular width of the visible part, rad."""
        return self.left - self.right


@storable
class Sensed(NamedTuple):
    """The robot's sensations at one time: the sonars' ranges, m, and the balls in view, widest first."""

    ranges: list[float]
    sightings: list[Sighting]


class Senses:
    """Looks into a scene, with one batch of rays."""

    def __init__(self, simulator: Simulator, *, can_hide: bool) -> None:
        self._simulator = simulator
        self._can_hide = can_hide  # in an arena without obstacles, which is convex, nothing hides a ball

    def look(self, pose: Pose, balls: Iterable[tuple[float, float]]) -> Sensed:
        """Sense from a pose (m, m, rad) among balls with these centres, m."""
        x, y, heading = pose
        cos, sin = math.cos(heading), math.sin(heading)
        starts, ends = [], []
        for ahead, left, angle in SONARS:
            start_x, start_y = x + ahead * cos - left * sin, y + ahead * sin + left * cos
            way_x, way_y = SONAR_MAX * math.cos(heading + angle), SONAR_MAX * math.sin(heading + angle)
            starts.append((start_x, start_y, SONAR_HEIGHT))
            ends.append((start_x + way_x, start_y + way_y, SONAR_HEIGHT))
        eye_x, eye_y = x + CAMERA_AHEAD * cos, y + CAMERA_AHEAD * sin
        sightings = []
        for ball_x, ball_y in balls:
            dx, dy = ball_x - eye_x, ball_y - eye_y
            sighting = _in_view(dx * cos + dy * sin, dy * cos - dx * sin)
            if sighting is not None:
                sightings.append(sighting)
                if self._can_hide:
                    distance = math.hypot(dx, dy)
                    step = sighting.width / N_RAYS
                    for i in range(N_RAYS):
                        angle = heading + sighting.left - (i + 0.5) * step
                        way_x, way_y = distance * math.cos(angle), distance * math.sin(angle)
                        starts.append((eye_x, eye_y, BALL_RADIUS))
                        ends.append((eye_x + way_x, eye_y + way_y, BALL_RADIUS))
        fractions = self._simulator.ray_fractions(starts, ends)
        n = len(SONARS)
        ranges = [min(max(fraction * SONAR_MAX, SONAR_MIN), SONAR_MAX) for fraction in fractions[:n]]
        if self._can_hide:
            parts = [
                _visible_part(sighting, fractions[n + i * N_RAYS : n + (i + 1) * N_RAYS])
                for i, sighting in enumerate(sightings)
            ]
            sightings = [part for part in parts if part is not None]
        sightings.sort(key=lambda sighting: -sighting.width)
        return Sensed(ranges, sightings)


def retina(sightings: Sequence[Sighting]) -> NDArray[np.float32]:
    """Return the raw retina (N_PIXELS,), from left to right: 1 where a pixel's middle is on a ball, else 0."""
    pixels = np.zeros(N_PIXELS, dtype=np.float32)
    per_rad = N_PIXELS / FIELD_OF_VIEW
    for left, right in sightings:
        first = math.ceil((FIELD_OF_VIEW / 2 - left) * per_rad - 0.5)
        last = math.floor((FIELD_OF_VIEW / 2 - right) * per_rad - 0.5)
        pixels[max(first, 0) : last + 1] = 1
    return pixels


def _in_view(ahead: float, left: float) -> Sighting | None:
    """Return the interval of an unhidden ball on the retina; its centre is relative to the camera, m.

    A sphere of radius r at distance d is 2 asin(r / d) wide.
    """
    distance = math.hypot(ahead, left)
    half_width = math.asin(min(BALL_RADIUS / distance, 1.0)) if distance > 0 else math.pi / 2
    bearing = math.atan2(left, ahead)
    left_edge = min(bearing + half_width, FIELD_OF_VIEW / 2)
    right_edge = max(bearing - half_width, -FIELD_OF_VIEW / 2)
    return Sighting(left_edge, right_edge) if left_edge > right_edge else None


def _visible_part(whole: Sighting, fractions: Sequence[float]) -> Sighting | None:
    """Return the longest visible stretch of a ball, by the rays from left to right that reach it."""
    best_start = best_length = start = 0
    for i, fraction in enumerate(fractions):
        if fraction < 1:
            start = i + 1
        elif i + 1 - start > best_length:
            best_start, best_length = start, i + 1 - start
    if best_length == len(fractions):
        return whole
    if best_length == 0:
        return None
    step = whole.width / len(fractions)
    return Sighting(whole.left - best_start * step, whole.left - (best_start + best_length) * step)
