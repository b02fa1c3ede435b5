"""Pictures of the Pioneer: whether what there is can be seen where it is."""

import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pybullet")

from numpy.typing import NDArray

from sb3_options.envs.pioneer.drawing import BALL, BODY, PICTURE_HEIGHT, PICTURE_WIDTH
from sb3_options.envs.pioneer.env import Pioneer

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
