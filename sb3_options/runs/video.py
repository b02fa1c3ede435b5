"""Videos of episodes, primitive step by primitive step."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from sb3_options.atomic import atomic_write
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.folder import make_env

CAPTION_HEIGHT = 24  # pixels of the strip that names the running option
CAPTION_MARGIN = (4, 2)  # pixels left and right of the text, and above it
DEFAULT_FPS = 15  # pictures per second if the environment does not say
GAP = 12  # white pixels between two films
MODES = ("rgb_array_list", "rgb_array")  # render modes that return pictures. The first returns every picture of a step.
GIF_PICTURES = 600  # maximum pictures of a GIF, which is made in memory, and held there by a browser


class RecordFrames(gym.Wrapper[Any, Any, Any, Any]):
    """Passes on pictures of every primitive step, also inside options, of the first ``episodes`` episodes.

    ``caption`` returns the text below each picture; None means no text.
    """

    def __init__(self, env: gym.Env[Any, Any], take: Callable[[Any], None], episodes: int) -> None:
        super().__init__(env)
        self._take = take
        self._left = episodes
        self.caption: Callable[[], str] | None = None

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset, and record the start of the episode."""
        result = super().reset(**kwargs)
        self._record()
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and record."""
        result = super().step(action)
        self._record()
        self._left -= bool(result[2] or result[3])
        return result

    def _record(self) -> None:
        if self._left == 0:
            return
        drawn = self.env.render()
        for picture in drawn if isinstance(drawn, list) else [drawn]:
            self._take(picture if self.caption is None else captioned(picture, self.caption()))


def captioned(picture: Any, text: str) -> npt.NDArray[np.uint8]:
    """Add a strip of `CAPTION_HEIGHT` rows with a text, cut to fit, below a picture (height, width, 3)."""
    strip = Image.new("RGB", (picture.shape[1], CAPTION_HEIGHT), "white")
    draw = ImageDraw.Draw(strip)
    while len(text) > 1 and draw.textlength(text) > picture.shape[1] - 2 * CAPTION_MARGIN[0]:
        text = f"{text[:-2]}…"
    draw.text(CAPTION_MARGIN, text, fill="black")
    return np.concatenate([picture, np.asarray(strip, dtype=picture.dtype)])


@contextmanager
def video_file(path: Path, fps: float) -> Iterator[Callable[[Any], None]]:
    """Write pictures (height, width, 3) to an MP4 or GIF file. The file appears once it is complete."""
    gif = path.suffix.lower() == ".gif"
    if gif:
        settings: dict[str, Any] = {"format": "GIF", "duration": 1000 / fps, "loop": 0}
    else:  # sides are padded below: macro_block_size would scale the picture instead
        settings = {"format": "FFMPEG", "fps": fps, "codec": "libx264", "pixelformat": "yuv420p", "macro_block_size": 1}
    taken = count()
    with atomic_write(path) as temporary, closing(imageio.get_writer(temporary, **settings)) as writer:

        def take(picture: Any) -> None:
            if next(taken) < GIF_PICTURES or not gif:
                height, width = picture.shape[:2]
                odd = ((0, height % 2), (0, width % 2), (0, 0))
                writer.append_data(np.pad(picture, odd, mode="edge"))  # the codec needs even sides

        yield take


def write_beside(path: Path, fps: float, sides: Sequence[Sequence[Any]]) -> None:
    """Write films of equal height side by side; the shorter one repeats its last picture."""
    gap = np.full((sides[0][0].shape[0], GAP, 3), 255, dtype=np.uint8)
    with video_file(path, fps) as film:
        for i in range(max(map(len, sides))):
            left, right = (side[min(i, len(side) - 1)] for side in sides)
            film(np.concatenate([left, gap, right], axis=1))


def mode_among(metadata: Mapping[str, Any]) -> str | None:
    """Return the render mode that shows most; None if an environment with this ``metadata`` draws no pictures."""
    modes = metadata.get("render_modes") or ()
    return next((mode for mode in MODES if mode in modes), None)


def render_mode_of(config: TrainConfig) -> tuple[str, float]:
    """Return the render mode that shows most of an environment, and its pictures per second."""
    with closing(make_env(config, 1, 0)) as env:
        mode = mode_among(env.get_attr("metadata")[0])
    if mode is None:
        raise ValueError(f"{config.env} draws no pictures, for it has no render_mode 'rgb_array': leave --video out.")
    with closing(make_env(config, 1, 0, render_mode=mode)) as env:  # a list of pictures may have a higher rate
        return mode, float(env.get_attr("metadata")[0].get("render_fps", DEFAULT_FPS))
