"""Environments, agents, what is noted while they train, and how they are judged."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from experiments.minigrid import settings
from experiments.minigrid.hand_made import MadeBy
from experiments.minigrid.settings import WITH_OPTIONS, Arm
from sb3_options import OptionsWrapper
from sb3_options.embedding.settings import MapName
from sb3_options.envs.minigrid import make
from sb3_options.experience.observations import BoolArray

Chooser = Callable[[Any, BoolArray], npt.NDArray[Any]]
"""Observations and masks (n_envs, n_actions) → actions (n_envs,)."""


def venv_of(
    env_id: str,
    seed: int,
    *,
    rehearsed: tuple[str, int] = ("", 0),
    n_envs: int = settings.N_ENVS,
    slots: int = 0,
    options: Path | None = None,
    by_hand: MadeBy | None = None,
    with_features: bool = False,
    with_map: bool = False,
) -> VecEnv:
    """Parallel environments of one task.

    Args:
        env_id: Of the task.
        seed: Of the first.
        rehearsed: Another task, and how many of the environments, the last ones, are of that.
        n_envs: How many.
        slots: For options.
        options: File of the options they begin with.
        by_hand: Makes options, as many as there are slots, from φ.
        with_features: Whether the agent sees φ, too.
        with_map: Whether φ is learned.
    """

    def wrapped(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        env = FeaturesBeside(env) if with_features else env
        if not slots:
            return env
        feature_map: MapName | None = "temporal-distance" if with_map else None
        optioned = OptionsWrapper(env, slots, gamma=settings.GAMMA, feature_map=feature_map, options_file=options)
        for option in by_hand(optioned.concept_features)[:slots] if by_hand else ():
            optioned.bank.add(option)
        return optioned

    other, n_others = rehearsed
    tasks = iter([env_id] * (n_envs - n_others) + [other] * n_others)

    def made() -> gym.Env[Any, Any]:
        task = next(tasks)
        return make(task, mission=task not in settings.WITHOUT_MISSION, asked=False)

    return make_vec_env(made, n_envs, seed=seed, wrapper_class=wrapped)


class FeaturesBeside(gym.ObservationWrapper[Any, Any, Any]):
    """Puts φ beside the observation."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        assert env.observation_space.shape is not None  # a vector
        self._n = env.observation_space.shape[0]
        n = self._n + len(env.get_wrapper_attr("feature_names"))
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (n,), np.float32)

    def observation(self, observation: Any) -> npt.NDArray[np.float32]:
        """The observation, and φ."""
        features = self.env.get_wrapper_attr("concept_features")(observation[None])[0]
        return np.concatenate([observation, features]).astype(np.float32)

    def concept_features(self, observations: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """φ of a batch of such observations."""
        return observations[:, self._n :].astype(np.float64)

    def concept_groups(self) -> Any:
        """Those of φ."""
        return self.env.get_wrapper_attr("concept_groups")()


def normalised(venv: VecEnv, before: VecEnv | None, *, training: bool = True) -> VecNormalize:
    """Observations and rewards as rl-zoo3 normalises them.

    Args:
        venv: What to normalise.
        before: Where the statistics come from, if they are from an earlier task.
        training: Whether they go on, and rewards are normalised.
    """
    made = VecNormalize(venv, training=training, norm_reward=training, gamma=settings.GAMMA)
    if isinstance(before, VecNormalize):
        made.obs_rms, made.ret_rms = before.obs_rms, before.ret_rms
    return made


def model_of(arm: Arm, venv: VecEnv, seed: int, ppo: Mapping[str, Any] = settings.PPO) -> BaseAlgorithm:
    """PPO with these settings; or MaskablePPO, which chooses options only where they may begin."""
    algorithm = MaskablePPO if arm in WITH_OPTIONS else PPO
    return algorithm("MlpPolicy", venv, seed=seed, device="cpu", **ppo)


class Notes(BaseCallback):
    """Notes how training goes in the first environments.

    Args:
        n_envs: How many these are; the others rehearse.
        learned: Training ends when this share of the last `EPISODES` episodes succeeded; None: it does not.
        least: And not before so many primitive steps.

    Attributes:
        curve: After each rollout, and in the end, primitive steps so far, and the success rate of the last episodes.
        runs: Of each option, by its name, how its runs ended.
    """

    def __init__(self, n_envs: int, learned: float | None = None, least: int = 0) -> None:
        super().__init__()
        self.n_envs = n_envs
        self.learned, self.least = learned, least
        self.curve: list[tuple[int, float]] = []
        self.runs: dict[str, Counter[str]] = {}
        self._successes: deque[bool] = deque(maxlen=settings.EPISODES)

    def _on_step(self) -> bool:
        for info in self.locals["infos"][: self.n_envs]:
            if "is_success" in info:
                self._successes.append(info["is_success"])
            run = info.get("option", {})
            if run.get("index", -1) >= 0 and run.get("inside", True):
                option = self.training_env.get_attr("bank", indices=[0])[0].slots[run["index"]]
                if option is not None:  # it was not closed just now
                    self.runs.setdefault(option.name, Counter())[run["termination"]] += 1
        enough = len(self._successes) == self._successes.maxlen and self.num_timesteps >= self.least
        return self.learned is None or not enough or float(np.mean(self._successes)) < self.learned

    def _on_rollout_end(self) -> None:
        self.curve.append((self.num_timesteps, float(np.mean(self._successes or [0.0]))))

    def _on_training_end(self) -> None:
        if not self.curve or self.curve[-1][0] < self.num_timesteps:  # it ended within a rollout
            self._on_rollout_end()


def success_rate(choose: Chooser, venv: VecEnv, seed: int) -> float:
    """The share of fresh episodes that succeed; every environment plays as many."""
    venv.seed(seed)
    left = np.full(venv.num_envs, -(-settings.EPISODES // venv.num_envs))
    observations, successes = venv.reset(), []
    n_actions = int(venv.action_space.n)  # type: ignore[attr-defined]  # it is Discrete
    masks: BoolArray = np.ones((venv.num_envs, n_actions), dtype=np.bool_)
    while left.any():
        if venv.has_attr("action_masks"):
            masks = np.stack(venv.env_method("action_masks"))
        observations, _, dones, infos = venv.step(choose(observations, masks))
        for i in np.flatnonzero(dones & (left > 0)):
            left[i] -= 1
            successes.append(infos[i]["is_success"])
    return float(np.mean(successes))


def learned(model: BaseAlgorithm, *, deterministic: bool) -> Chooser:
    """The choices of a model."""

    def choose(observations: Any, masks: BoolArray) -> npt.NDArray[Any]:
        known = {"action_masks": masks} if isinstance(model, MaskablePPO) else {}
        actions, _ = model.predict(observations, deterministic=deterministic, **known)  # type: ignore[arg-type]  # only MaskablePPO has masks
        return actions

    return choose


def uniform(seed: int) -> Chooser:
    """Uniformly random choices among what may begin: primitive actions and options."""
    rng = np.random.default_rng(seed)

    def choose(observations: Any, masks: BoolArray) -> npt.NDArray[Any]:
        return np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])

    return choose
