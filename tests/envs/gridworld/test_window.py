import matplotlib.pyplot as plt
import numpy as np
import pytest

from sb3_options.envs.gridworld.window import Window

pytestmark = pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")


def test_shows_the_last_picture_in_one_figure() -> None:
    window = Window("title")
    black, white = np.zeros((8, 16, 3), np.uint8), np.full((8, 16, 3), 255, np.uint8)
    window.show(black, seconds=0.001)
    window.show(white, seconds=0.001)
    assert len(plt.get_fignums()) == 1
    (image,) = plt.gcf().axes[0].images
    np.testing.assert_array_equal(np.asarray(image.get_array()), white)
