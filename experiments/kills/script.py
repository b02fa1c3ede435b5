"""A training script as in docs/concepts/checkpoints.md: ``python -m experiments.kills.script FOLDER STEPS FREQ``."""

import sys
from pathlib import Path

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

import sb3_options.envs  # noqa: F401  # registers the environments
from sb3_options import OptionsWrapper
from sb3_options.callbacks import CheckpointCallback, SubgoalDiscoveryCallback, load_checkpoint
from sb3_options.runs.folder import CHECKPOINTS


def main(folder: Path, steps: int, freq: int) -> None:
    """Train, from the newest checkpoint on if there is one."""
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"), max_options=4, gamma=0.99)
    model = PPO("MlpPolicy", env, gamma=0.99, seed=0, n_steps=256, device="cpu")
    checkpoints = CheckpointCallback(folder / CHECKPOINTS, freq, verbose=1)
    callbacks: list[BaseCallback] = [SubgoalDiscoveryCallback(), checkpoints]
    resume = any(checkpoints.folder)
    if resume:
        load_checkpoint(folder / CHECKPOINTS, model, callbacks)
    print("Training PPO")
    model.learn(steps, callbacks, reset_num_timesteps=not resume)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
