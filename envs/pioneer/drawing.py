"""Pictures of the Pioneer from above: sonar beams, vision cone and retina as in McGovern & Barto (2001), Figure 7."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from sb3_options.envs.pioneer import body
from sb3_options.envs.pioneer.arena import CORNER_SIZE, OBSTACLE_RADIUS, Placement, Pose, Position
from sb3_options.envs.pioneer.senses import CAMERA_AHEAD, FIELD_OF_VIEW, SONARS, Sensed

PICTURE_WIDTH, PICTURE_HEIGHT = 480, 544
"""px, multiples of 16, because video encoders pad other sizes."""

_SMOOTH = 2  # The picture is drawn this many times as large, and then reduced.
_WALL_PX = 14 * _SMOOTH
_SIDE_PX = PICTURE_WIDTH * _SMOOTH
_STRIP_TOP = (PICTURE_WIDTH + 12) * _SMOOTH
_STRIP_BOTTOM = (PICTURE_HEIGHT - 14) * _SMOOTH

Colour = tuple[int, int, int]
Translucent = tuple[int, int, int, int]
Point = tuple[float, float]

_PAPER: Colour = (252, 251, 248)
_WALL: Colour = (52, 58, 70)
_FLOOR: Colour = (246, 244, 238)
_GRID: Colour = (232, 229, 220)
_GOAL: Translucent = (46, 160, 67, 34)
_MARK: Colour = (46, 160, 67)
_CONE: Translucent = (38, 92, 204, 22)
_CONE_EDGE: Colour = (110, 126, 160)
_BEAM: Colour = (224, 122, 60)
_TYRE: Colour = (36, 38, 44)
BODY: Colour = (196, 52, 48)
_BODY_EDGE: Colour = (120, 28, 28)
_DECK: Colour = (44, 46, 54)
_PADDLE: Colour = (84, 90, 104)
BALL: Colour = (240, 190, 32)
_BALL_EDGE: Colour = (150, 110, 8)
_SHINE: Colour = (255, 244, 200)
_RETINA: Colour = (24, 26, 32)
_TICK: Colour = (150, 156, 168)


class Scene(NamedTuple):
    """A scene to draw; positions are x, y in m."""

    pose: Pose
    balls: Iterable[Position]
    deposited: Iterable[Position]
    holds: bool
    sensed: Sensed


class Renderer:
    """Draws an arena.

    Args:
        half: Half of the arena's inner side, m.
        deposit_gap: Balls whose centre is this close to a wall count as deposited, m.
        corner_only: Whether balls count only in the marked corner.
    """

    def __init__(self, half: float, deposit_gap: float, *, corner_only: bool) -> None:
        self._half = half
        self._deposit_gap = deposit_gap
        self._corner_only = corner_only
        self._scale = (_SIDE_PX - 2 * _WALL_PX) / (2 * half)
        self._backgrounds: dict[tuple[Position, ...], Image.Image] = {}

    def draw(self, placement: Placement, scene: Scene) -> NDArray[np.uint8]:
        """Draw a scene, (PICTURE_HEIGHT, PICTURE_WIDTH, 3)."""
        if placement.obstacles not in self._backgrounds:
            self._backgrounds = {placement.obstacles: self._background(placement.obstacles)}
        image = self._backgrounds[placement.obstacles].copy()
        pen = ImageDraw.Draw(image, "RGBA")
        self._draw_cone(pen, scene.pose)
        self._draw_beams(pen, scene.pose, scene.sensed.ranges)
        for place in scene.deposited:
            pen.circle(
                self._px(place), body.BALL_RADIUS * self._scale, fill=None, outline=_BALL_EDGE, width=2 * _SMOOTH
            )
        self._draw_robot(pen, scene.pose, holds=scene.holds)
        for place in scene.balls:
            self._draw_ball(pen, place)
        _draw_retina(pen, scene.sensed)
        return np.array(image.reduce(_SMOOTH))

    def _px(self, point: Point) -> Point:
        return _SIDE_PX / 2 + point[0] * self._scale, _SIDE_PX / 2 - point[1] * self._scale

    def _background(self, obstacles: Sequence[Position]) -> Image.Image:
        image = Image.new("RGB", (_SIDE_PX, PICTURE_HEIGHT * _SMOOTH), _PAPER)
        pen = ImageDraw.Draw(image, "RGBA")
        pen.rectangle((0, 0, _SIDE_PX - 1, _SIDE_PX - 1), fill=_WALL)
        pen.rectangle((_WALL_PX, _WALL_PX, _SIDE_PX - _WALL_PX, _SIDE_PX - _WALL_PX), fill=_FLOOR)
        half, edge = self._half, self._half - self._deposit_gap
        for i in range(math.ceil(-half), math.floor(half) + 1):
            pen.line((self._px((i, -half)), self._px((i, half))), fill=_GRID, width=_SMOOTH)
            pen.line((self._px((-half, i)), self._px((half, i))), fill=_GRID, width=_SMOOTH)
        if self._corner_only:
            inner = half - CORNER_SIZE
            zone = [(inner, half), (half, half), (half, inner), (edge, inner), (edge, edge), (inner, edge)]
            pen.polygon([self._px(point) for point in zone], fill=_GOAL)
            far = half + _WALL_PX / self._scale
            pen.rectangle((self._px((inner, far)), self._px((far, half))), fill=_MARK)
            pen.rectangle((self._px((half, half)), self._px((far, inner))), fill=_MARK)
        else:
            for band in (
                ((-half, half), (half, edge)),
                ((-half, -edge), (half, -half)),
                ((-half, edge), (-edge, -edge)),
                ((edge, edge), (half, -edge)),
            ):
                pen.rectangle((self._px(band[0]), self._px(band[1])), fill=_GOAL)
        for place in obstacles:
            pen.circle(self._px(place), OBSTACLE_RADIUS * self._scale, fill=_WALL)
        return image

    def _draw_cone(self, pen: ImageDraw.ImageDraw, pose: Pose) -> None:
        """Draw the field of view up to the walls, as a tinted area with dashed edges."""
        eye, heading = _ahead(pose, CAMERA_AHEAD), pose[2]
        angles = [heading + FIELD_OF_VIEW * (i / 48 - 0.5) for i in range(49)]
        corners = (
            math.atan2(y - eye[1], x - eye[0]) for x in (-self._half, self._half) for y in (-self._half, self._half)
        )
        offsets = (math.remainder(corner - heading, math.tau) for corner in corners)
        angles += [heading + offset for offset in offsets if abs(offset) < FIELD_OF_VIEW / 2]
        angles.sort()
        rim = [self._wall_point(eye, angle) for angle in angles]
        pen.polygon([self._px(point) for point in (eye, *rim)], fill=_CONE)
        for end in (rim[0], rim[-1]):
            _dashed(pen, self._px(eye), self._px(end))

    def _wall_point(self, start: Point, angle: float) -> Point:
        """Return the point where a ray from inside the arena meets a wall."""
        dx, dy = math.cos(angle), math.sin(angle)
        reach = min(
            (math.copysign(self._half, direction) - place) / direction
            for place, direction in zip(start, (dx, dy), strict=True)
            if abs(direction) > 1e-9
        )
        return start[0] + reach * dx, start[1] + reach * dy

    def _draw_beams(self, pen: ImageDraw.ImageDraw, pose: Pose, ranges: Sequence[float]) -> None:
        for (ahead, left, angle), distance in zip(SONARS, ranges, strict=True):
            start = _ahead(pose, ahead, left)
            end = (start[0] + distance * math.cos(pose[2] + angle), start[1] + distance * math.sin(pose[2] + angle))
            pen.line((self._px(start), self._px(end)), fill=_BEAM, width=_SMOOTH)
            pen.circle(self._px(end), 2.5 * _SMOOTH, fill=_BEAM)

    def _draw_robot(self, pen: ImageDraw.ImageDraw, pose: Pose, *, holds: bool) -> None:
        half_opening = body.BALL_RADIUS if holds else body.PADDLE_OPENING / 2
        rear = body.BODY_RADIUS - 0.06
        for side in (-1, 1):
            along, across, _ = body.PADDLE_HALF_SIDES
            self._box(pen, pose, body.PADDLE_TIP - along, side * (half_opening + across), along, across, _PADDLE)
            self._box(pen, pose, 0, side * body.AXLE_TRACK / 2, body.WHEEL_RADIUS, 0.03, _TYRE)
        self._box(pen, pose, body.BODY_RADIUS - 0.03, 0, 0.03, half_opening + 0.02, _PADDLE)
        # Rounded front, straight sides, rounded rear.
        outline = []
        for i in range(40):
            angle = math.tau * i / 40
            ahead, left = body.BODY_RADIUS * math.cos(angle), body.BODY_RADIUS * math.sin(angle)
            outline.append(_ahead(pose, ahead, min(max(left, -0.15), 0.15)))
        pen.polygon([self._px(point) for point in outline], fill=BODY, outline=_BODY_EDGE, width=2 * _SMOOTH)
        deck = [(0.14, 0.09), (0.18, 0.0), (0.14, -0.09), (-rear + 0.02, -0.1), (-rear + 0.02, 0.1)]
        pen.polygon([self._px(_ahead(pose, *point)) for point in deck], fill=_DECK)
        pen.circle(self._px(_ahead(pose, CAMERA_AHEAD)), 0.035 * self._scale, fill=_TICK)

    def _box(
        self,
        pen: ImageDraw.ImageDraw,
        pose: Pose,
        ahead: float,
        left: float,
        half_length: float,
        half_width: float,
        colour: Colour,
    ) -> None:
        corners = ((1, 1), (1, -1), (-1, -1), (-1, 1))
        points = [_ahead(pose, ahead + i * half_length, left + j * half_width) for i, j in corners]
        pen.polygon([self._px(point) for point in points], fill=colour)

    def _draw_ball(self, pen: ImageDraw.ImageDraw, place: Position) -> None:
        radius = body.BALL_RADIUS * self._scale
        x, y = self._px(place)
        pen.circle((x, y), radius, fill=BALL, outline=_BALL_EDGE, width=_SMOOTH)
        pen.circle((x - 0.3 * radius, y - 0.3 * radius), 0.25 * radius, fill=_SHINE)


def _ahead(pose: Pose, ahead: float, left: float = 0.0) -> Point:
    """Convert a point of the robot's frame to the arena, m."""
    x, y, heading = pose
    cos, sin = math.cos(heading), math.sin(heading)
    return x + ahead * cos - left * sin, y + ahead * sin + left * cos


def _dashed(pen: ImageDraw.ImageDraw, start: Point, end: Point) -> None:
    length = math.dist(start, end)
    dash = 6 * _SMOOTH
    for i in range(0, int(length / dash), 2):
        a, b = i * dash / length, min((i + 1) * dash / length, 1)
        points = [tuple(s + share * (e - s) for s, e in zip(start, end, strict=True)) for share in (a, b)]
        pen.line([(p[0], p[1]) for p in points], fill=_CONE_EDGE, width=round(1.5 * _SMOOTH))


def _draw_retina(pen: ImageDraw.ImageDraw, sensed: Sensed) -> None:
    """Draw the strip below: the balls' intervals on a dark ground, and a mark for straight ahead."""
    left, right = _WALL_PX, _SIDE_PX - _WALL_PX
    pen.rectangle((left, _STRIP_TOP, right, _STRIP_BOTTOM), fill=_RETINA)
    for sighting in sensed.sightings:
        edges = [left + (right - left) * (0.5 - angle / FIELD_OF_VIEW) for angle in (sighting.left, sighting.right)]
        pen.rectangle((edges[0], _STRIP_TOP, edges[1], _STRIP_BOTTOM), fill=BALL)
    middle = (left + right) / 2
    for y in (_STRIP_TOP, _STRIP_BOTTOM):
        pen.line((middle, y - 4 * _SMOOTH, middle, y + 4 * _SMOOTH), fill=_TICK, width=2 * _SMOOTH)
