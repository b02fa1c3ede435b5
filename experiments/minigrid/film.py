"""A film of an agent with options beside PPO, both after the same tasks and frames, in the same episodes.

``python -m experiments.minigrid.film --out docs/images/multiroom.gif``
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import tyro
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import set_random_seed

from experiments.minigrid.settings import GAMMA
from sb3_options import OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.envs.minigrid import DISCOVERY, make
from sb3_options.runs.video import RecordFrames, captioned, write_beside

Picture: TypeAlias = npt.NDArray[np.uint8]
"""(height, width, 3)."""

SETTINGS = {"n_steps": 128, "batch_size": 256, "n_epochs": 4, "learning_rate": 1e-3, "ent_coef": 0.01, "gamma": GAMMA}
"""Of both agents, as in ``examples/minigrid_options.py``."""

N_ENVS = 16
N_SLOTS = 4
PIXELS = 16  # of a cell
FPS = 6.0


@dataclass(frozen=True, kw_only=True)
class Study:
    """What is filmed.

    Attributes:
        out: The .gif or .mp4 file.
        tasks: Learned one after the other; the last one is filmed.
        frames: How long each is learned.
        episodes: How many are filmed.
        seed: Of the agents, of the episodes and of the choices in them, which are sampled.
    """

    out: Path
    tasks: tuple[str, ...] = ("MiniGrid-MultiRoom-N2-S4-v0", "MiniGrid-MultiRoom-N4-S5-v1")
    frames: tuple[int, ...] = (16_000, 16_000)
    episodes: int = 3
    seed: int = 1


def main(film: Study) -> None:
    """Train both agents, let them play, and film them."""
    with TemporaryDirectory() as folder:
        options = Path(folder) / "options.safetensors"
        sides = [_played(film, _with_options(film, options), options), _played(film, _stock(film), None)]
    height, width = np.max([rooms.shape[:2] for side in sides for episode in side for rooms, _ in episode], axis=0)
    shown: list[list[Picture]] = [[], []]
    for episodes in zip(*sides, strict=True):
        longest = max(map(len, episodes))
        for side, episode in zip(shown, episodes, strict=True):
            pictures = [captioned(_padded(rooms, height, width), caption) for rooms, caption in episode]
            side += pictures + pictures[-1:] * (longest - len(pictures))  # the agent that is there first waits
    write_beside(film.out, FPS, shown)


def _stock(film: Study) -> BaseAlgorithm:
    """PPO after all tasks."""
    model: PPO | None = None
    for task, frames in zip(film.tasks, film.frames, strict=True):
        venv = make_vec_env(make, N_ENVS, film.seed, env_kwargs={"env_id": task})
        model = model or PPO("MlpPolicy", venv, seed=film.seed, device="cpu", **SETTINGS)  # type: ignore[arg-type]  # of several types
        model.set_env(venv)
        model.learn(frames)
    assert model is not None  # there are tasks
    return model


def _with_options(film: Study, options: Path) -> BaseAlgorithm:
    """MaskablePPO after all tasks. The options that it discovered in the first are saved."""
    model: MaskablePPO | None = None
    for task, frames in zip(film.tasks, film.frames, strict=True):
        venv = make_vec_env(
            make,
            N_ENVS,
            film.seed,
            wrapper_class=OptionsWrapper,
            env_kwargs={"env_id": task},
            wrapper_kwargs={"max_options": N_SLOTS, "gamma": GAMMA, "options_file": options if model else None},
        )
        model = model or MaskablePPO("MlpPolicy", venv, seed=film.seed, device="cpu", **SETTINGS)  # type: ignore[arg-type]  # as above
        model.set_env(venv)
        discovery = SubgoalDiscoveryCallback(
            **DISCOVERY,
            max_new_options=0 if options.exists() else None,
            use={"primitive_rollouts": True},
        )
        model.learn(frames, callback=discovery)
        discovery.bank.save(options)
    assert model is not None  # there are tasks
    return model


def _played(film: Study, model: Any, options: Path | None) -> list[list[tuple[Picture, str]]]:
    """The pictures of each episode, with a caption each."""
    episodes: list[list[tuple[Picture, str]]] = []
    task = make(film.tasks[-1], render_mode="rgb_array", tile_size=PIXELS, highlight=True)

    def take(picture: Picture) -> None:
        caption = f"with options: {env.running_option()}" if options else "PPO"
        episodes[-1].append((_rooms(task.unwrapped, picture), caption))

    camera = RecordFrames(task, take, film.episodes)
    with closing(OptionsWrapper(camera, N_SLOTS if options else 0, gamma=GAMMA, options_file=options)) as env:
        for episode in range(film.episodes):
            episodes.append([])
            set_random_seed(film.seed + episode)
            observation, _ = env.reset(seed=film.seed + episode)
            done = False
            while not done:
                masks: Any = {"action_masks": env.action_masks()} if options else {}
                action, _ = model.predict(observation, **masks)
                observation, _, terminated, truncated, _ = env.step(int(action))
                done = terminated or truncated
    return episodes


def _rooms(task: Any, picture: Picture) -> Picture:
    """The part of a picture with rooms."""
    grid = task.grid
    filled = np.array([each is not None for each in grid.grid]).reshape(grid.height, grid.width)
    rows, columns = (slice(at.min() * PIXELS, (at.max() + 1) * PIXELS) for at in np.nonzero(filled))
    return picture[rows, columns]


def _padded(picture: Picture, height: int, width: int) -> Picture:
    """A picture in the middle of a larger black one."""
    free = (height - picture.shape[0], width - picture.shape[1])
    return np.pad(picture, [*((each // 2, each - each // 2) for each in free), (0, 0)])


if __name__ == "__main__":
    main(tyro.cli(Study))
