"""Options that travel: discovered in two rooms of MiniGrid, used in four. Needs the extras contrib and minigrid."""

import sys

from sb3_contrib import MaskablePPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_options import OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.envs.minigrid import DISCOVERY, make

PPO = {"n_steps": 128, "batch_size": 256, "n_epochs": 4, "learning_rate": 1e-3, "ent_coef": 0.01, "gamma": 0.99}


def rooms(env_id: str, options_file: str | None = None) -> VecEnv:
    """Sixteen environments with slots for four options."""
    slots = {"max_options": 4, "gamma": 0.99, "options_file": options_file}
    return make_vec_env(make, 16, 0, wrapper_class=OptionsWrapper, env_kwargs={"env_id": env_id}, wrapper_kwargs=slots)


def main(steps_in_two: int = 40_000, steps_in_four: int = 80_000, options_file: str = "options.safetensors") -> None:
    """Train in two rooms, keep the options and the weights, and go on in four."""
    model = MaskablePPO("MlpPolicy", rooms("MiniGrid-MultiRoom-N2-S4-v0"), seed=0, device="cpu", verbose=1, **PPO)
    callback = SubgoalDiscoveryCallback(**DISCOVERY, opening_share=0.5, verbose=1)
    model.learn(steps_in_two, callback=callback)
    callback.bank.save(options_file)
    model.set_env(rooms("MiniGrid-MultiRoom-N4-S5-v1", options_file))
    model.learn(steps_in_four, callback=SubgoalDiscoveryCallback(**DISCOVERY, max_new_options=0))
    model.save("minigrid.zip")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]))  # python examples/minigrid_options.py 40_000 80_000
