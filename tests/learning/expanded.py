"""Small models of every algorithm that were trained without options."""

from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import pytest
import torch
from sb3_contrib import QRDQN, TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env

from sb3_options.learning import heads
from tests.support.sb3_helpers import small_rooms

N_PRIMITIVE, MAX_OPTIONS = 4, 3
N_ACTIONS = N_PRIMITIVE + MAX_OPTIONS
N_QUANTILES = 7
GAMMA = 0.9

OFF_POLICY: dict[str, Any] = {"learning_starts": 50, "buffer_size": 1000, "target_update_interval": 50}
ON_POLICY: dict[str, Any] = {"n_steps": 64, "device": "cpu"}


class Kind(NamedTuple):
    """An algorithm, small enough for tests."""

    algorithm: Any
    policy: str
    kwargs: dict[str, Any]


KINDS = {
    "dqn": Kind(DQN, "MlpPolicy", OFF_POLICY),
    "qrdqn": Kind(QRDQN, "MlpPolicy", {**OFF_POLICY, "policy_kwargs": {"n_quantiles": N_QUANTILES}}),
    "ppo": Kind(PPO, "MlpPolicy", {**ON_POLICY, "batch_size": 32, "n_epochs": 2}),
    "a2c": Kind(A2C, "MlpPolicy", ON_POLICY),
    "trpo": Kind(TRPO, "MlpPolicy", {**ON_POLICY, "batch_size": 32}),
    "maskableppo": Kind(MaskablePPO, "MlpPolicy", {**ON_POLICY, "batch_size": 32, "n_epochs": 2}),
    "recurrentppo": Kind(
        RecurrentPPO,
        "MlpLstmPolicy",
        {**ON_POLICY, "batch_size": 64, "n_epochs": 2, "policy_kwargs": {"lstm_hidden_size": 16}},
    ),
}
every = pytest.mark.parametrize("name", list(KINDS))
every_and_a_size_that_matters = pytest.mark.parametrize(
    # 7 quantiles of 4 + 1 actions: here a plain wider layer says something else in the last bit.
    ("name", "max_options"),
    [*((name, MAX_OPTIONS) for name in KINDS), ("qrdqn", 1)],
)


def trained(name: str, env: Any = None, steps: int = 128, **kwargs: Any) -> Any:
    """A model of its own that has learned a little; the same every time."""
    kind = KINDS[name]
    env = make_vec_env(small_rooms, 1, seed=0) if env is None else env
    model = kind.algorithm(kind.policy, env, gamma=GAMMA, seed=0, **{**kind.kwargs, **kwargs})
    masking = {"use_masking": False} if name == "maskableppo" else {}
    return model.learn(steps, **masking)


def outputs(model: Any, observations: Any) -> list[torch.Tensor]:
    """What the last layers say, online and target, as they stand in the policy: (batch, outputs an action, actions)."""
    said: list[torch.Tensor] = []
    hooks = [
        layer.register_forward_hook(
            lambda _, __, y, n=per_action: said.append(y.detach().clone().unflatten(-1, (n, -1)))
        )
        for layer, per_action in heads.option_outputs(model.policy)
    ]
    model.predict(observations, deterministic=True)
    for network in ("q_net_target", "quantile_net_target"):
        if hasattr(model.policy, network):
            with torch.no_grad():
                getattr(model.policy, network)(model.policy.obs_to_tensor(observations)[0])
    for hook in hooks:
        hook.remove()
    return said


def random_observations(model: BaseAlgorithm, n: int) -> npt.NDArray[Any]:
    return np.random.default_rng(n).random((n, *cast("Any", model.observation_space.shape))).astype(np.float32)


def small_model(**kwargs: Any) -> Any:
    return DQN("MlpPolicy", small_rooms(), **{"gamma": GAMMA, "buffer_size": 10, **kwargs})
