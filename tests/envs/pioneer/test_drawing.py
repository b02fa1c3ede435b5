"""Pictures of the Pioneer: whether what there is can be seen where it is."""

import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pybullet")

from numpy.typing import NDArray

from sb3_options.envs.pioneer.drawing import BALL, BODY, PICTURE_HEIGHT, PICTURE_WIDTH
from sb3_options.envs.pioneer.env import Pioneer
from sb3_options.envs.pioneer.senses import SONARS

SCALE = (PICTURE_WIDTH - 2 * 14) / 4
"""px per m in an arena of 4 m with walls of 14 px."""


def picture(env: Pioneer, **options: Any) -> NDArray[np.uint8]:
    env.reset(seed=0, options=options)
    image = env.render()
    assert isinstance(image, np.ndarray)
    return image


def where(image: NDArray[np.uint8], colour: tuple[int, int, int]) -> NDArray[np.float64]:
    """Mean position of a colour in the arena, m."""
    rows, columns = np.nonzero((image[:PICTURE_WIDTH] == colour).all(axis=2))
    return np.array([columns.mean() + 0.5 - PICTURE_WIDTH / 2, PICTURE_WIDTH / 2 - rows.mean() - 0.5]) / SCALE


def test_robot_and_ball_are_where_they_are() -> None:
    env = Pioneer(render_mode="rgb_array")
    image = picture(env, robot=(-0.5, 1.0, math.pi / 2), balls=[(1.2, -0.8)])
    assert image.shape == (PICTURE_HEIGHT, PICTURE_WIDTH, 3)
    assert image.dtype == np.uint8
    np.testing.assert_allclose(where(image, BALL), (1.2, -0.8), atol=0.03)
    np.testing.assert_allclose(where(image, BODY), (-0.5, 1.0), atol=0.08)
    env.close()


def test_retina_strip_shows_the_interval() -> None:
    env = Pioneer(render_mode="rgb_array")
    for bearing, share in ((0, 0.5), (35, 0.25), (-35, 0.75)):
        angle = math.radians(bearing)
        image = picture(env, robot=(0, 0, 0), balls=[(0.1 + math.cos(angle), math.sin(angle))])
        lit = np.flatnonzero((image[510] == BALL).all(axis=1))
        assert (lit.mean() + 0.5 - 14) / (PICTURE_WIDTH - 28) == pytest.approx(share, abs=0.01)
    image = picture(env, robot=(0, 0, 0), balls=[(-1, 0)])
    assert not (image[510] == BALL).all(axis=1).any()
    env.close()


def at(image: NDArray[np.uint8], x: float, y: float) -> NDArray[np.int64]:
    """The colour of a place in the arena, m."""
    row, column = PICTURE_WIDTH / 2 - y * SCALE, PICTURE_WIDTH / 2 + x * SCALE
    colour: NDArray[np.int64] = image[int(row), int(column)].astype(np.int64)
    return colour


def test_beams_end_at_the_walls_and_the_cone_is_where_the_robot_looks() -> None:
    env = Pioneer(render_mode="rgb_array")
    image = picture(env, robot=(-1, 0, 0), balls=[(1.5, 1.5)])
    for ahead, left, angle in SONARS:
        # Where a beam from the ring meets the nearest wall.
        x, y = -1 + ahead, left
        reach = min(
            (math.copysign(2, direction) - place) / direction
            for place, direction in ((x, math.cos(angle)), (y, math.sin(angle)))
            if abs(direction) > 1e-9
        )
        end = x + reach * math.cos(angle), y + reach * math.sin(angle)
        colour = at(image, end[0] * 0.995, end[1] * 0.995)
        assert colour[0] > colour[2] + 60, (angle, colour)  # orange
    seen, unseen = at(image, 0.6, -0.7), at(image, -1.5, 0.7)
    assert seen[2] > seen[0] > 180  # bluish
    assert unseen[2] < unseen[0]  # floor
    env.close()


def test_a_list_of_pictures_shows_the_way() -> None:
    env = Pioneer(render_mode="rgb_array_list")
    env.reset(seed=0, options={"robot": (0, 0, 0), "balls": [(1.5, 1.5)]})
    first = env.render()
    assert isinstance(first, list)
    assert len(first) == 1
    observation = env.step(2)[0]
    pictures = env.render()
    assert isinstance(pictures, list)
    places = [where(np.asarray(image), BODY)[0] for image in pictures]
    assert len(places) > 5
    assert places == sorted(places)
    assert env.render() == []
    assert env.metadata["render_fps"] == 10

    twin = Pioneer()
    twin.reset(seed=0, options={"robot": (0, 0, 0), "balls": [(1.5, 1.5)]})
    np.testing.assert_array_equal(twin.step(2)[0], observation)  # looking changes nothing
    env.close()
    twin.close()
