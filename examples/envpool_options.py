"""Options in MiniGrid as EnvPool steps it, in C++. Needs the extra envpool."""

from collections.abc import Sequence
from typing import Any

import envpool
import numpy as np
from sb3_contrib import MaskablePPO
from stable_baselines3.common.vec_env import VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from sb3_options import OptionsVecEnv
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.envs.minigrid import DISCOVERY, make


class MiniGridPool(VecEnv):
    """Environments of one task in EnvPool. Observations and φ are those of ``MiniGridWrapper`` without the mission."""

    def __init__(self, task: str, n_envs: int, seed: int = 0) -> None:
        self.one = make(task, mission=False)  # makes vectors of EnvPool's images, and has φ and its groups
        self.concept_features = self.one.concept_features
        self.task, self.n_envs = task, n_envs
        super().__init__(n_envs, self.one.observation_space, self.one.action_space)
        self.seed(seed)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """EnvPool seeds environments when it makes them."""
        if seed is not None:
            self.pool = envpool.make(self.task, env_type="gymnasium", num_envs=self.n_envs, seed=seed, num_threads=1)
        return [seed] * self.n_envs

    def reset(self) -> Any:
        """Begin an episode in every environment."""
        return self.one.vectors(self.pool.reset()[0]["image"])

    def step_async(self, actions: Any) -> None:
        """Note the actions."""
        self.actions = actions.astype(np.int32)

    def step_wait(self) -> Any:
        """Step all environments; where an episode has ended, begin the next one."""
        observed, rewards, terminated, truncated, _ = self.pool.step(self.actions)
        vectors = self.one.vectors(observed["image"])
        infos: list[dict[str, Any]] = [{} for _ in range(self.n_envs)]
        ended = np.flatnonzero(terminated | truncated)
        for env in ended:
            infos[env]["terminal_observation"] = vectors[env].copy()
            infos[env]["is_success"] = bool(rewards[env] > 0)  # maybe in the last step that is allowed
            infos[env]["TimeLimit.truncated"] = bool(truncated[env] and not terminated[env] and rewards[env] <= 0)
        if len(ended):
            vectors[ended] = self.one.vectors(self.pool.reset(ended.astype(np.int32))[0]["image"])
        return vectors, rewards, terminated | truncated, infos

    def close(self) -> None:
        """End EnvPool's threads."""
        self.pool.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """All environments are alike."""
        return [getattr(self.one, attr_name) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """There are no Python environments to wrap, set or call."""
        return [False for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:  # noqa: D102
        raise AttributeError(attr_name)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:  # noqa: D102
        raise AttributeError(method_name)


PPO = {"n_steps": 128, "batch_size": 256, "n_epochs": 4, "learning_rate": 1e-3, "ent_coef": 0.01, "gamma": 0.99}

if __name__ == "__main__":
    venv = OptionsVecEnv(VecMonitor(MiniGridPool("MiniGrid-MultiRoom-N2-S4-v0", 16)), max_options=4, gamma=0.99)
    model = MaskablePPO("MlpPolicy", venv, seed=0, device="cpu", verbose=1, **PPO)
    discovery = SubgoalDiscoveryCallback(**DISCOVERY, verbose=1)
    model.learn(60_000, callback=discovery)  # tested with 2_000
    model.save("envpool.zip")
