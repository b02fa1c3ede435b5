"""A window that shows pictures while an environment runs."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

_PX_PER_INCH = 100


class Window:
    """A matplotlib window, which opens with the first picture.

    A matplotlib backend without windows shows nothing. If there is a display, matplotlib warns.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._figure: Figure | None = None
        self._image: AxesImage | None = None

    def show(self, picture: NDArray[np.uint8], seconds: float) -> None:
        """Show a picture, and run the window's event loop for some seconds."""
        # Imported late: pyplot chooses a GUI toolkit, which training without a window should never load.
        from matplotlib import pyplot as plt

        if self._figure is None or self._image is None or not plt.fignum_exists(self._figure.number):
            height, width = picture.shape[:2]
            self._figure = plt.figure(figsize=(width / _PX_PER_INCH, height / _PX_PER_INCH), dpi=_PX_PER_INCH)
            if self._figure.canvas.manager is not None:
                self._figure.canvas.manager.set_window_title(self._title)
            axes = self._figure.add_axes((0, 0, 1, 1))
            axes.set_axis_off()
            self._image = axes.imshow(picture)
            self._figure.show()
        self._image.set_data(picture)
        self._figure.canvas.draw_idle()
        self._figure.canvas.start_event_loop(seconds)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._figure is not None:
            from matplotlib import pyplot as plt

            plt.close(self._figure)
            self._figure = self._image = None
