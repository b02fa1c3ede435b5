"""Evaluating a run: returns, success and primitive steps of episodes, with confidence intervals, and a video."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
from rich.progress import track
from scipy.stats import binomtest, bootstrap

from sb3_options import config as configs
from sb3_options import runs
from sb3_options.bags import reported_success
from sb3_options.observations import FloatArray

CONFIDENCE = 0.95
N_RESAMPLES = 9999
DEFAULT_FPS = 15


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


class FrameRecorder(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps a picture after every primitive step, also of those inside options."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.frames: list[Any] = []

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset, and keep the first picture."""
        result = super().reset(**kwargs)
        self.frames.append(self.env.render())
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and keep the picture."""
        result = super().step(action)
        self.frames.append(self.env.render())
        return result


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
    """Load a run folder and act greedily in its environment.

    Weights and options are read as arrays only; nothing in the folder can run code.

    Args:
        run: The run folder.
        episodes: How many to play, at least 1.
        seed: Of the environment.
        video: Where to write all primitive steps as MP4; None writes nothing.

    Returns:
        The evaluation.

    Raises:
        FileNotFoundError: The folder lacks a file of a run.
        ValueError: ``episodes`` < 1, a file does not fit, or the environment draws no pictures.
    """
    if episodes < 1:
        raise ValueError(f"--episodes must be at least 1, got {episodes}.")
    for name in (runs.CONFIG, runs.MODEL, runs.OPTIONS):
        if not (run / name).is_file():
            raise FileNotFoundError(f"{run} is no run folder: it lacks {name}.")
    config = configs.load(run / runs.CONFIG)
    runs.check_env_id(config.env)
    filming = {"beneath": FrameRecorder, "render_mode": "rgb_array"} if video is not None else {}
    venv = runs.make_env(config, 1, seed, **filming)  # type: ignore[arg-type]  # mypy joins the two values
    model = runs.make_model(config, venv, buffer_size=1)
    venv.seed(seed)  # the model has seeded it with the training seed
    # set_parameters reads tensors only, where load would unpickle.
    try:
        model.set_parameters(str(run / runs.MODEL), device=model.device)
    except RuntimeError as error:
        raise ValueError(f"{run / runs.MODEL} does not fit {run / runs.CONFIG}: {error}") from error
    venv.get_attr("bank")[0].load(run / runs.OPTIONS)
    venv.env_method("record_trajectories", True)

    returns, steps, successes = [], [], 0
    observation = venv.reset()
    for _ in track(range(episodes), description="Evaluating", transient=True):
        done = False
        while not done:
            action, _ = model.predict(observation, deterministic=True)  # type: ignore[arg-type]  # a batch, as reset gives it
            observation, _, dones, infos = venv.step(action)
            done = bool(dones[0])
        trajectory = infos[0]["trajectory"]
        returns.append(float(trajectory.rewards.sum()))
        steps.append(float(len(trajectory)))
        successes += reported_success(trajectory)
    if video is not None:
        fps = venv.metadata.get("render_fps", DEFAULT_FPS)
        _write_video(venv.get_attr("frames")[0], video, float(fps))  # type: ignore[arg-type]  # typed as any metadata
    venv.close()
    return Evaluation(
        episodes,
        mean_interval(np.array(returns)),
        share_interval(successes, episodes),
        mean_interval(np.array(steps)),
    )


def _write_video(frames: list[Any], path: Path, fps: float) -> None:
    if not frames or frames[0] is None:
        raise ValueError("The environment draws no pictures: it has no render_mode 'rgb_array'.")
    path.parent.mkdir(parents=True, exist_ok=True)
    pictures = np.stack(frames)
    # The codec wants even sides.
    pictures = np.pad(pictures, ((0, 0), (0, pictures.shape[1] % 2), (0, pictures.shape[2] % 2), (0, 0)), mode="edge")
    iio.imwrite(path, pictures, fps=fps, macro_block_size=1, codec="libx264", pixelformat="yuv420p")
