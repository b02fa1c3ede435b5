"""What is run for every seed: the main job."""

from __future__ import annotations

import dataclasses

import numpy as np

from experiments.common.gridworlds import cell_of, distance_to_doorway, world_of
from experiments.common.seeds import Result
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.runs import folder as runs
from sb3_options.runs.algorithms import make_model
from sb3_options.runs.config import TrainConfig

LAST_EPISODES = 20


def run(config: TrainConfig, seed: int) -> Result:
    """Train once.

    Args:
        config: Of the run.
        seed: Replaces the configuration's.

    Returns:
        Of the first option: ``episode``, ``primitive_step``, ``subgoal`` cell and ``distance`` to the doorway in
        cells (all None if there is none); and ``final_steps``, the mean length of the last episodes.
    """
    config = dataclasses.replace(config, seed=seed)
    env = runs.make_env(config, config.n_envs, seed)
    model = make_model(config, env)
    discovery = SubgoalDiscoveryCallback(config.discovery, config.option, max_new_options=config.max_new_options)
    model.learn(config.n_timesteps, callback=discovery)
    lengths = [int(episode["l"]) for episode in (model.ep_info_buffer or [])]
    final = float(np.mean(lengths[-LAST_EPISODES:])) if lengths else None
    result: Result = {"seed": seed, "episodes": discovery.episodes, "final_steps": final}
    if not discovery.discoveries:
        return {**result, "episode": None, "primitive_step": None, "subgoal": None, "distance": None}
    first = discovery.discoveries[0]
    cell = cell_of(first.subgoal)
    return {
        **result,
        "episode": first.episode,
        "primitive_step": first.timestep,
        "subgoal": list(cell),
        "distance": distance_to_doorway(world_of(config.env), cell),
    }
