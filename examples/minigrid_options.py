"""Options that travel: discovered in two rooms of MiniGrid, used in four. Needs the extras contrib and minigrid."""

from sb3_contrib import MaskablePPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_options import OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.envs.minigrid import DISCOVERY, make

PPO = {"n_steps": 128, "batch_size": 256, "n_epochs": 4, "learning_rate": 1e-3, "ent_coef": 0.01, "gamma": 0.99}


def rooms(env_id: str, options: str | None = None) -> VecEnv:
    """Sixteen environments with slots for four options."""
    slots = {"max_options": 4, "gamma": 0.99, "options_file": options}
    return make_vec_env(make, 16, 0, wrapper_class=OptionsWrapper, env_kwargs={"env_id": env_id}, wrapper_kwargs=slots)


model = MaskablePPO("MlpPolicy", rooms("MiniGrid-MultiRoom-N2-S4-v0"), seed=0, device="cpu", verbose=1, **PPO)
discovery = SubgoalDiscoveryCallback(**DISCOVERY, use={"primitive_rollouts": True}, verbose=1)
model.learn(40_000, callback=discovery)  # tested with 2_000
discovery.bank.save("options.safetensors")
model.set_env(rooms("MiniGrid-MultiRoom-N4-S5-v1", "options.safetensors"))
later = SubgoalDiscoveryCallback(**DISCOVERY, max_new_options=0, use={"primitive_rollouts": True})
model.learn(80_000, callback=later)  # tested with 2_000
model.save("minigrid.zip")  # with the options as they are now: load_model(MaskablePPO, "minigrid.zip", rooms(...))
