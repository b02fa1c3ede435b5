"""Greedy episodes in environments with options."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv


def greedy_episodes(
    model: BaseAlgorithm,
    venv: VecEnv,
    episodes: int,
    *,
    masked: bool = False,
    explore: Callable[[Any], Any] | None = None,
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Act greedily, and give the environment and the last info of each episode.

    Every environment plays its share of the episodes, so that short ones are not preferred.
    """
    left = [(episodes + i) // venv.num_envs for i in range(venv.num_envs)]
    observations, memory, starts = venv.reset(), None, np.ones(venv.num_envs, dtype=bool)
    while any(left):
        masks = {"action_masks": np.stack(venv.env_method("action_masks"))} if masked else {}
        # Only recurrent models have a memory, and ask where episodes start.
        actions, memory = model.predict(observations, memory, starts, deterministic=True, **masks)  # type: ignore[arg-type]  # a batch, as reset gives it
        observations, _, starts, infos = venv.step(actions if explore is None else explore(actions))
        for i, info in enumerate(infos):
            if starts[i] and left[i]:
                left[i] -= 1
                yield i, info
