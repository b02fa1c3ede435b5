"""A run that discovers nothing is stock's run: with the same weights and the same random numbers, episode by episode.

Slots change how many random numbers are drawn, so that runs of the same seed differ without them being worse. Here both
draw the same: actions by inverse transform sampling, one uniform number each, and exploration among the primitives,
which is what an empty slot does.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import QRDQN, MaskablePPO
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import set_random_seed

from sb3_options import OptionsWrapper, expand_action_space
from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback
from tests.support.sb3_helpers import small_rooms

ROOM = """
SSS..
SSS..
SSS.G
"""
NewCallback = Callable[[], BaseCallback]
Episode = tuple[float, int]
N_STEPS = 1_200
ON_POLICY: dict[str, Any] = {"n_steps": 150, "ent_coef": 0.01}
OFF_POLICY: dict[str, Any] = {"learning_starts": 100, "exploration_fraction": 0.5, "target_update_interval": 250}
ALGORITHMS: dict[Any, dict[str, Any]] = {
    PPO: {**ON_POLICY, "batch_size": 50},
    A2C: ON_POLICY,
    MaskablePPO: {**ON_POLICY, "batch_size": 50},
    DQN: OFF_POLICY,
    QRDQN: OFF_POLICY,
}


class Episodes(BaseCallback):
    """Keeps return and length of every episode."""

    def __init__(self) -> None:
        super().__init__()
        self.episodes: list[Episode] = []

    def _on_step(self) -> bool:
        ended = [info["episode"] for info in self.locals["infos"] if "episode" in info]
        self.episodes += [(episode["r"], episode["l"]) for episode in ended]
        return True


def sample_by_inverse_transform(distribution: Any, sample_shape: Any = None) -> torch.Tensor:
    """A sample of a categorical distribution from one uniform number, however many categories it has."""
    cumulative = distribution.probs.cumsum(-1)
    uniform = torch.rand((*cumulative.shape[:-1], 1)) * cumulative[..., -1:]
    return torch.searchsorted(cumulative, uniform, right=True).squeeze(-1)


@pytest.fixture
def same_random_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wide and narrow distributions over actions draw the same."""
    n_primitive = int(small_rooms().action_space.n)  # type: ignore[attr-defined]
    monkeypatch.setattr(torch.distributions.Categorical, "sample", sample_by_inverse_transform)
    monkeypatch.setattr(spaces.Discrete, "sample", lambda space, *_: np.int64(space.np_random.integers(n_primitive)))


def monitored(algorithm: Any) -> gym.Env[Any, Any]:
    """The task, as the stock algorithm takes it."""
    env: gym.Env[Any, Any] = Monitor(small_rooms(map=ROOM, max_steps=60))
    if algorithm is MaskablePPO:
        env = ActionMasker(env, lambda masked: np.ones(masked.action_space.n, dtype=bool))  # type: ignore[attr-defined]
    return env


def finds_nothing() -> BaseCallback:
    """A discovery that never has enough to search."""
    return SubgoalDiscoveryCallback({"min_positive": 10_000})


@cache
def trained(
    algorithm: Any, callback: Callable[[], BaseCallback] | None
) -> tuple[list[tuple[float, int]], dict[str, torch.Tensor]]:
    """Episodes and final weights; with a callback there are four slots, and the same weights for the primitives."""
    model = algorithm("MlpPolicy", monitored(algorithm), gamma=0.9, seed=0, device="cpu", **ALGORITHMS[algorithm])
    episodes = Episodes()
    callbacks: list[BaseCallback] = [episodes]
    if callback is not None:
        expand_action_space(model, 4, env=OptionsWrapper(Monitor(small_rooms(map=ROOM, max_steps=60)), 4, gamma=0.9))
        callbacks.append(callback())
    set_random_seed(1)
    model.env.seed(1)
    model.action_space.seed(1)
    model.learn(N_STEPS, callback=callbacks)
    return episodes.episodes, model.policy.state_dict()


@pytest.mark.usefixtures("same_random_numbers")
@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("callback", [PrimitiveStepsCallback, finds_nothing])
def test_every_episode_is_that_of_the_stock_run(algorithm: Any, callback: Any) -> None:
    """Float32 sums over more actions round otherwise, hence the tolerance for the weights."""
    stock, weights = trained(algorithm, None)
    ours, wide = trained(algorithm, callback)
    assert len({length for _, length in stock}) > 3  # not only episodes that time ends
    assert ours == stock
    shared = [name for name in weights if name in wide and wide[name].shape == weights[name].shape]
    assert len(shared) >= 4
    for name in shared:
        torch.testing.assert_close(wide[name], weights[name], atol=2e-3, rtol=0)
