"""A film of the agent of ``examples/minigrid_options.py``, with the name of the running option below each picture.

``python -m experiments.minigrid.film --model minigrid.zip --out docs/images/multiroom.gif``
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import tyro
from sb3_contrib import MaskablePPO
from stable_baselines3.common.utils import set_random_seed

from experiments.minigrid.settings import GAMMA
from sb3_options import OptionsWrapper, load_model
from sb3_options.envs.minigrid import make
from sb3_options.runs.video import RecordFrames, video_file

PIXELS = 12
"""Of a cell."""

FPS = 6.0


@dataclass(frozen=True, kw_only=True)
class Study:
    """What is filmed.

    Attributes:
        model: A model.zip with options inside.
        out: The .gif or .mp4 file.
        env_id: The task.
        episodes: How many.
        seed: Of the task and of the agent's choices, which are sampled.
        most_actions: It ends after so many choices of the agent, at the latest.
    """

    model: Path
    out: Path
    env_id: str = "MiniGrid-MultiRoom-N4-S5-v1"
    episodes: int = 3
    seed: int = 0
    most_actions: int = 1_000


def main(film: Study) -> None:
    """Play, and film it."""
    with video_file(film.out, FPS) as video:
        task = make(film.env_id, render_mode="rgb_array", tile_size=PIXELS, highlight=True)
        camera = RecordFrames(task, video, film.episodes)
        with closing(OptionsWrapper(camera, 4, gamma=GAMMA)) as env:
            camera.caption = env.running_option
            model = load_model(MaskablePPO, film.model, env=env, device="cpu")
            set_random_seed(film.seed)
            observation, _ = env.reset(seed=film.seed)
            left = film.episodes
            for _ in range(film.most_actions):
                action, _ = model.predict(observation, action_masks=env.action_masks())
                observation, _, terminated, truncated, _ = env.step(int(action))
                if terminated or truncated:
                    left -= 1
                    if not left:
                        break
                    observation, _ = env.reset()


if __name__ == "__main__":
    main(tyro.cli(Study))
