"""The robot's agents: Q-learning over a CMAC, with or without options, and what their trials were like."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from experiments.common.agents import wrapper_of
from experiments.common.few_peaks import FewPeaks
from experiments.common.playing import greedy_episodes
from experiments.common.seeds import Result
from experiments.pioneer.settings import PioneerSettings
from experiments.pioneer.tiles import Concatenated, TileCoding
from sb3_options import MacroQ, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.envs.pioneer.env import DISPLACEMENT, GRIPPING, VISIBLE, WIDTH
from sb3_options.envs.pioneer.senses import FIELD_OF_VIEW, MAX_WIDTH, SONAR_MIN
from sb3_options.experience.observations import BoolArray, FloatArray


class CountTouches(gym.Wrapper[Any, Any, Any, Any]):
    """Says in ``info["n_touches"]`` how often a wall was touched in this episode."""

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Start counting."""
        self._n_touches = 0
        return super().reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and count."""
        observation, reward, terminated, truncated, info = super().step(action)
        self._n_touches += info["touched_wall"]
        return observation, reward, terminated, truncated, {**info, "n_touches": self._n_touches}


def features(settings: PioneerSettings) -> Concatenated:
    """A CMAC of what is seen of the ball, and one of the sonars, each together with whether the gripper is closed.

    A binary number gets one tile: its two values fall into different ones.
    """
    half_view, n_sonars = FIELD_OF_VIEW / 2, len(settings.sonars)
    ball = TileCoding(
        [0, 0, -half_view, 0],
        [1, 1, half_view, MAX_WIDTH],
        (1, 1, *settings.ball_tiles),
        n_tilings=settings.n_tilings,
    )
    walls = TileCoding(
        [0] + [SONAR_MIN] * n_sonars,
        [1] + [settings.sonar_horizon] * n_sonars,
        (1, *[settings.sonar_tiles] * n_sonars),
        n_tilings=settings.n_tilings,
    )
    return Concatenated([([GRIPPING, VISIBLE, DISPLACEMENT, WIDTH], ball), ([GRIPPING, *settings.sonars], walls)])


def make_agent(settings: PioneerSettings, env_id: str, seed: int) -> MacroQ:
    """An agent that knows nothing yet, with empty option slots.

    Without an option in them it is the same agent as one without slots, bit for bit.
    """

    def make_env() -> gym.Env[Any, Any]:
        env = CountTouches(gym.make(env_id, max_steps=settings.step_limit))
        return OptionsWrapper(
            Monitor(env, info_keywords=("is_success", "n_touches")), settings.options_per_run, gamma=settings.gamma
        )

    return MacroQ(
        DummyVecEnv([make_env]),
        features=features(settings),
        learning_rate=settings.step_size,
        gamma=settings.gamma,
        epsilon=settings.epsilon,
        seed=seed,
    )


def ball_in_sight(scaled: FloatArray, start: FloatArray, end: FloatArray) -> BoolArray:
    """The static filter: without a ball on the retina there is no width or displacement to speak of."""
    seen: BoolArray = scaled[:, 1] > 0
    return seen


def discoverer(settings: PioneerSettings, seed: int, *, max_new_options: int) -> SubgoalDiscoveryCallback:
    """The library's callback; with no new options it lets those there are be used."""
    return SubgoalDiscoveryCallback(
        settings.discovery(),
        settings.option(),
        method=FewPeaks(max_places=2),
        concepts={"static_filter": ball_in_sight},
        max_new_options=max_new_options,
    )


def evaluate(agent: MacroQ, n_trials: int, epsilon: float, seed: int) -> Result:
    """Trials without learning, almost greedy: a robot that never errs may circle for ever where two views look alike.

    Returns:
        As `described`.
    """
    env = agent.get_env()
    assert env is not None  # made with one
    env.seed(seed)
    rng = np.random.default_rng(seed)

    def explore(actions: Any) -> Any:
        return np.array([rng.integers(wrapper_of(agent).n_primitive)]) if rng.random() < epsilon else actions

    return described([info["episode"] for _, info in greedy_episodes(agent, env, n_trials, explore=explore)])


def described(episodes: Sequence[dict[str, Any]]) -> Result:
    """Primitive ``steps``, ``returns``, ``successes`` and wall ``touches`` of every trial, for JSON."""
    return {
        "steps": [int(e["l"]) for e in episodes],
        "returns": [float(e["r"]) for e in episodes],
        "successes": [bool(e["is_success"]) for e in episodes],
        "touches": [int(e["n_touches"]) for e in episodes],
    }
