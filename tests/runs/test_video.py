from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from sb3_options import OptionsWrapper
from sb3_options.runs.video import CAPTION_HEIGHT, RecordFrames, captioned, video_file
from tests.support.helpers import CountingEnv, steady_option
from tests.support.sb3_helpers import read_video


class Drawing(gym.Wrapper[Any, Any, Any, Any]):
    """Draws its time as a shade of grey, 33 × 47 pixels."""

    def render(self) -> Any:
        return np.full((33, 47, 3), 40 * self.unwrapped.time, dtype=np.uint8)  # type: ignore[attr-defined]  # a CountingEnv


class DrawingOften(gym.Wrapper[Any, Any, Any, Any]):
    """Draws two things a step."""

    def render(self) -> Any:
        time = 10 * self.unwrapped.time  # type: ignore[attr-defined]  # a CountingEnv
        return [time, time + 1]


class TestVideo:
    def test_of_odd_sides_is_padded(self, tmp_path: Path) -> None:
        with video_file(tmp_path / "f.mp4", 10.0) as take:
            for shade in (0, 100, 200):
                take(np.full((33, 47, 3), shade, dtype=np.uint8))
        frames = read_video(tmp_path / "f.mp4", 34, 48)
        assert frames.shape == (3, 34, 48, 3)
        np.testing.assert_allclose(frames.mean(axis=(1, 2, 3)), [0, 100, 200], atol=4)

    def test_gif_repeats_for_ever(self, tmp_path: Path) -> None:
        with video_file(tmp_path / "f.gif", 10.0) as take:
            for shade in (0, 100, 200):
                take(np.full((33, 47, 3), shade, dtype=np.uint8))
        with Image.open(tmp_path / "f.gif") as image:
            assert (image.n_frames, image.info["duration"], image.info["loop"]) == (3, 100, 0)  # type: ignore[attr-defined]  # a GIF has it

    def test_takes_every_picture_that_a_step_drew(self) -> None:
        taken: list[int] = []
        env = RecordFrames(DrawingOften(CountingEnv(terminate_at=3)), taken.append, 1)
        env.reset()
        env.step(0)
        assert taken == [0, 1, 10, 11]

    def test_films_the_steps_inside_options_until_it_has_enough_episodes(self) -> None:
        taken: list[int] = []
        env = OptionsWrapper(
            RecordFrames(Drawing(CountingEnv(terminate_at=5)), lambda p: taken.append(int(p[0, 0, 0])), 2)
        )
        env.bank.add(steady_option(max_duration=4))
        for _ in range(3):
            env.reset()
            env.step(2)
            env.step(0)
        assert taken == [0, 40, 80, 120, 160, 200] * 2

    def test_names_the_option_that_runs(self) -> None:
        taken: list[Any] = []
        recorder = RecordFrames(Drawing(CountingEnv(terminate_at=5)), taken.append, 1)
        env = OptionsWrapper(recorder)
        said: list[str] = []
        recorder.caption = lambda: said.append(env.running_option()) or said[-1]  # type: ignore[func-returns-value]  # None
        env.bank.add(steady_option(max_duration=2, name="forwards"), 1)
        env.reset()
        env.step(0)
        env.step(3)
        env.step(1)
        assert said == ["primitive action"] * 2 + ["option 1: forwards"] * 2 + ["primitive action"]
        assert {picture.shape for picture in taken} == {(33 + CAPTION_HEIGHT, 47, 3)}
        np.testing.assert_array_equal(taken[0][:33], 0)
        assert np.array_equal(taken[0][33:], taken[1][33:])
        assert not np.array_equal(taken[1][33:], taken[2][33:])

    @pytest.mark.parametrize("n", [1, 30, 300])
    def test_a_caption_keeps_to_the_picture(self, n: int) -> None:
        """It is cut: nothing of it is at the right margin."""
        strip = captioned(np.zeros((5, 120, 3), np.uint8), "m" * n)[5:]
        assert (strip[:, -4:] == 255).all()
        assert (strip < 255).any()
