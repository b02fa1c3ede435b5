from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from sb3_options import OptionsWrapper, cli
from sb3_options.runs import evaluation
from sb3_options.runs import folder as runs
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.evaluation import Film, Interval, Video, evaluate_run, mean_interval, share_interval
from tests.support.helpers import CountingEnv, steady_option
from tests.support.sb3_helpers import read_video


class TestIntervals:
    def test_of_a_mean_cover_it_about_as_often_as_they_say(self) -> None:
        rng = np.random.default_rng(0)
        intervals = [mean_interval(rng.normal(3.0, 2.0, size=40)) for _ in range(60)]
        assert all(i.low < i.mean < i.high for i in intervals)
        covered = np.mean([i.low <= 3.0 <= i.high for i in intervals])
        assert covered >= 0.85
        width = np.mean([i.high - i.low for i in intervals])
        assert width == pytest.approx(2 * 1.96 * 2.0 / np.sqrt(40), rel=0.1)

    def test_of_equal_values_are_points(self) -> None:
        assert mean_interval(np.array([2.0, 2.0, 2.0])) == mean_interval(np.array([2.0])) == Interval(2.0, 2.0, 2.0)

    def test_of_a_share_are_wilsons(self) -> None:
        # Wilson (1927): (p + z²/2n ± z √(p(1−p)/n + z²/4n²)) / (1 + z²/n)
        z, n, p = 1.959964, 20, 0.9
        centre, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        expected = np.array([p, *((centre + s * half) / (1 + z * z / n) for s in (-1, 1))])
        np.testing.assert_allclose(share_interval(18, 20), expected, atol=1e-6)
        assert share_interval(20, 20).high == pytest.approx(1.0)
        assert share_interval(20, 20).low < 0.9

    def test_are_the_same_every_time(self) -> None:
        values = np.random.default_rng(1).random(30)
        assert mean_interval(values) == mean_interval(values)


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
        video = Video(tmp_path / "f.mp4", 10.0)
        for shade in (0, 100, 200):
            video.take(np.full((33, 47, 3), shade, dtype=np.uint8))
        video.close()
        frames = read_video(tmp_path / "f.mp4", 34, 48)
        assert frames.shape == (3, 34, 48, 3)
        np.testing.assert_allclose(frames.mean(axis=(1, 2, 3)), [0, 100, 200], atol=4)

    def test_gif_repeats_for_ever(self, tmp_path: Path) -> None:
        video = Video(tmp_path / "f.gif", 10.0, gif=True)
        for shade in (0, 100, 200):
            video.take(np.full((33, 47, 3), shade, dtype=np.uint8))
        video.close()
        with Image.open(tmp_path / "f.gif") as image:
            assert (image.n_frames, image.info["duration"], image.info["loop"]) == (3, 100, 0)  # type: ignore[attr-defined]  # a GIF has it

    def test_takes_every_picture_that_a_step_drew(self) -> None:
        taken: list[int] = []
        env = Film(DrawingOften(CountingEnv(terminate_at=3)), taken.append, 1)
        env.reset()
        env.step(0)
        assert taken == [0, 1, 10, 11]

    def test_films_the_steps_inside_options_until_it_has_enough_episodes(self) -> None:
        taken: list[int] = []
        env = OptionsWrapper(Film(Drawing(CountingEnv(terminate_at=5)), lambda p: taken.append(int(p[0, 0, 0])), 2))
        env.bank.add(steady_option(max_duration=4))
        for _ in range(3):
            env.reset()
            env.step(2)
            env.step(0)
        assert taken == [0, 40, 80, 120, 160, 200] * 2

    def test_of_an_environment_that_draws_nothing(self, tmp_path: Path) -> None:
        video = Video(tmp_path / "f.mp4", 10.0)
        with pytest.raises(ValueError, match="The environment draws no pictures: it has no render_mode 'rgb_array'"):
            video.take(None)
        video.close()


def test_a_configuration_that_would_import_a_module_is_refused(tmp_path: Path) -> None:
    for name in (runs.MODEL, runs.OPTIONS):
        (tmp_path / name).touch()
    (tmp_path / runs.CONFIG).write_text("env: evil_module:Foo-v0\n")
    with pytest.raises(ValueError, match=r"names the environment 'evil_module:Foo-v0', which would import a module"):
        evaluate_run(tmp_path)


def test_an_episode_that_never_ends_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = TrainConfig(
        env_kwargs=("continuing:true", "max_steps:null"), n_timesteps=50, discover=False, progress=False,
        tensorboard_log=tmp_path, device="cpu",
    )  # fmt: skip
    run = cli.train(config)
    monkeypatch.setattr(evaluation, "LONGEST_EPISODE", 300)
    with pytest.raises(
        ValueError,
        match=r"^An episode has not ended after 300 primitive steps: only episodes .+ limit in .+config\.yml",
    ):
        evaluate_run(run, episodes=1)
