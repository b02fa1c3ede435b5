"""Evaluating a run: returns, success and primitive steps of episodes, with confidence intervals, and a video."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
from rich.progress import track
from scipy.stats import binomtest, bootstrap

from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.atomic import whole_file
from sb3_options.experience.success import reported_success
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import LONGEST_EPISODE
from sb3_options.learning.value_snapshot import interrupt_options

CONFIDENCE = 0.95
N_RESAMPLES = 9999
DEFAULT_FPS = 15
VIDEO_EPISODES = 10
"""A video shows this many episodes at most."""

GIF_PICTURES = 600
"""A GIF is made in memory, and a browser holds it there."""


class Interval(NamedTuple):
    """An estimate with its confidence interval.

    Attributes:
        mean: The estimate.
        low: Lower end of the 95 % interval.
        high: Upper end.
    """

    mean: float
    low: float
    high: float


class Evaluation(NamedTuple):
    """What an evaluation found, over ``episodes`` episodes.

    Attributes:
        episodes: How many.
        mean_return: Undiscounted return.
        success_rate: Share of successful episodes.
        steps: Primitive steps an episode.
    """

    episodes: int
    mean_return: Interval
    success_rate: Interval
    steps: Interval


class Film(gym.Wrapper[Any, Any, Any, Any]):
    """Hands over the pictures of every primitive step, also of those inside options.

    Args:
        env: With ``render_mode="rgb_array"``, or ``"rgb_array_list"`` if it draws several for a step.
        take: Is given each picture.
        episodes: After this many, nothing more is filmed.
    """

    def __init__(self, env: gym.Env[Any, Any], take: Callable[[Any], None], episodes: int) -> None:
        super().__init__(env)
        self._take, self._left = take, episodes

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset, and film how the episode begins."""
        result = super().reset(**kwargs)
        self._shoot()
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and film."""
        result = super().step(action)
        self._shoot()
        self._left -= bool(result[2] or result[3])
        return result

    def _shoot(self) -> None:
        if self._left == 0:
            return
        drawn = self.env.render()
        for picture in drawn if isinstance(drawn, list) else [drawn]:
            self._take(picture)


class Video:
    """An MP4 file that grows picture by picture, so that a long film needs no memory; or a GIF, which is short.

    Args:
        path: Of the file.
        fps: Pictures per second.
        gif: GIF, which repeats for ever and takes the first `GIF_PICTURES`, rather than MP4.

    Raises:
        OSError: It cannot be written.
    """

    def __init__(self, path: Path, fps: float, *, gif: bool = False) -> None:
        self._left = GIF_PICTURES if gif else math.inf
        self._writer = (
            imageio.get_writer(path, format="GIF", duration=1000 / fps, loop=0)
            if gif
            # The sides are padded below: macro_block_size would scale the picture instead.
            else imageio.get_writer(
                path, format="FFMPEG", fps=fps, codec="libx264", pixelformat="yuv420p", macro_block_size=1
            )
        )

    def take(self, picture: Any) -> None:
        """Append a picture, shape (height, width, 3).

        Raises:
            ValueError: There is no picture.
        """
        if picture is None:
            raise ValueError("The environment draws no pictures: it has no render_mode 'rgb_array'.")
        self._left -= 1
        if self._left < 0:
            return
        height, width = picture.shape[:2]
        # The codec of MP4 wants even sides.
        self._writer.append_data(np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge"))

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()


def mean_interval(values: FloatArray) -> Interval:
    """Mean with a 95 % bootstrap interval (bias-corrected and accelerated); a point where all values are equal."""
    mean = float(np.mean(values))
    if len(values) < 2 or np.ptp(values) == 0:
        return Interval(mean, mean, mean)
    result = bootstrap(
        (values,), np.mean, confidence_level=CONFIDENCE, n_resamples=N_RESAMPLES, rng=np.random.default_rng(0)
    )
    return Interval(mean, float(result.confidence_interval.low), float(result.confidence_interval.high))


def share_interval(successes: int, n: int) -> Interval:
    """Share with a 95 % Wilson interval."""
    ci = binomtest(successes, n).proportion_ci(CONFIDENCE, method="wilson")
    return Interval(successes / n, float(ci.low), float(ci.high))


def evaluate_run(run: Path, *, episodes: int = 100, seed: int = 10_000, video: Path | None = None) -> Evaluation:
    """Load a run folder and act greedily in its environment, with options interrupted as in training.

    Weights and options are read as arrays only; nothing in the folder can run code.

    Args:
        run: The run folder.
        episodes: How many to play, at least 1.
        seed: Of the environment.
        video: Where to write the first `VIDEO_EPISODES` episodes, which are played for it beforehand: an .mp4 or .gif
            file. None writes nothing.

    Returns:
        The evaluation.

    Raises:
        FileNotFoundError: The folder lacks a file of a run.
        ValueError: ``episodes`` < 1, a file does not fit, the environment draws no pictures, or an episode does not
            end.
    """
    if episodes < 1:
        raise ValueError(f"--episodes must be at least 1, got {episodes}.")
    for name in (runs.CONFIG, runs.MODEL, runs.OPTIONS):
        if not (run / name).is_file():
            raise FileNotFoundError(f"{run} is no run folder: it lacks {name}.")
    env_id = configs.load(run / runs.CONFIG).env
    if ":" in env_id:
        raise ValueError(
            f"{run / runs.CONFIG} names the environment {env_id!r}, which would import a module. If you trust it, "
            "write the id without the module into the configuration, and import the module before evaluating."
        )
    runs.check_env_id(env_id)
    if video is not None:
        _film(run, min(episodes, VIDEO_EPISODES), seed, video)
    return _play(run, episodes, seed)


def _film(run: Path, episodes: int, seed: int, video: Path) -> None:
    kind = video.suffix.lower()
    if kind not in (".mp4", ".gif"):
        raise ValueError(f"--video must end in .mp4 or .gif, got {video}.")
    mode, fps = _pictures_of(run)
    with whole_file(video) as temporary:
        film = Video(temporary, fps, gif=kind == ".gif")
        try:
            _play(run, episodes, seed, film, mode)
        finally:
            film.close()


def _play(run: Path, episodes: int, seed: int, film: Video | None = None, mode: str | None = None) -> Evaluation:
    # What the run started with is in its own options file, too.
    config = replace(configs.load(run / runs.CONFIG), options=None)
    venv = runs.make_env(
        config,
        1,
        seed,
        beneath=None if film is None else partial(Film, take=film.take, episodes=episodes),
        render_mode=mode,
    )
    model = runs.make_model(config, venv, playing=True)
    venv.seed(seed)  # the model has seeded it with the training seed
    # set_parameters reads tensors only, where load would unpickle.
    try:
        model.set_parameters(str(run / runs.MODEL), device=model.device)
    except (RuntimeError, ValueError, UnpicklingError) as error:
        raise ValueError(f"{run / runs.MODEL} is damaged, or does not fit {run / runs.CONFIG}: {error}") from error
    venv.get_attr("bank")[0].load(run / runs.OPTIONS)
    if config.interruption:
        interrupt_options(model, venv)
    venv.env_method("record_trajectories", True)

    returns, steps, successes = [], [], 0
    masks = config.algo == "maskableppo"
    observation, memory = venv.reset(), None
    for _ in track(range(episodes), description="Evaluating", transient=True):
        done, played = False, 0
        while not done:
            masked = {"action_masks": np.stack(venv.env_method("action_masks"))} if masks else {}
            # Others than RecurrentPPO have no memory, and do not ask where episodes start.
            starts = np.array([played == 0])
            action, memory = model.predict(observation, memory, starts, deterministic=True, **masked)  # type: ignore[arg-type]  # a batch, as reset gives it
            observation, _, dones, infos = venv.step(action)
            done = bool(dones[0])
            played += infos[0]["option"]["duration"]
            if played >= LONGEST_EPISODE:
                raise ValueError(
                    f"An episode has not ended after {played:,} primitive steps: only episodes that end can be "
                    f"evaluated. Give the environment a time limit in {run / runs.CONFIG}."
                )
        trajectory = infos[0]["trajectory"]
        returns.append(float(trajectory.rewards.sum()))
        steps.append(float(len(trajectory)))
        successes += reported_success(trajectory)
    venv.close()
    return Evaluation(
        episodes,
        mean_interval(np.array(returns)),
        share_interval(successes, episodes),
        mean_interval(np.array(steps)),
    )


def _pictures_of(run: Path) -> tuple[str, float]:
    """The render mode that shows most of an environment, and its pictures per second."""
    config = configs.load(run / runs.CONFIG)
    env = gym.make(config.env, **config.env_keywords())
    fps = env.metadata.get("render_fps", DEFAULT_FPS)
    draws_on_its_way = "rgb_array_list" in (env.metadata.get("render_modes") or ())
    env.close()
    if not draws_on_its_way:
        return "rgb_array", float(fps)
    env = gym.make(config.env, **config.env_keywords(), render_mode="rgb_array_list")
    fps = env.metadata.get("render_fps", DEFAULT_FPS)
    env.close()
    return "rgb_array_list", float(fps)
