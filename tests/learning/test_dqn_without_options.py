"""Without slots DQN and QRDQN learn what they learn in stock SB3, and without a callback DQN says what is missing."""

from typing import Any, cast

import gymnasium as gym
import pytest
import torch
from sb3_contrib import QRDQN
from stable_baselines3 import DQN
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_options import OptionReplayBuffer
from sb3_options.callbacks import SubgoalDiscoveryCallback
from tests.learning.tables import GAMMA
from tests.support.sb3_helpers import TINY, optioned_rooms, small_rooms


def weights(algorithm: type[OffPolicyAlgorithm], env: gym.Env[Any, Any], callback: Any = None, **own: Any) -> Any:
    kwargs: dict[str, Any] = TINY | {"train_freq": 4, "target_update_interval": 50, "gamma": GAMMA} | own
    if algorithm is QRDQN:
        kwargs["policy_kwargs"] = {"net_arch": [16], "n_quantiles": 8}
    model = algorithm("MlpPolicy", env, **kwargs)
    model.learn(500, callback=callback)
    assert cast("Any", model)._n_updates > 90
    return model.policy.state_dict()


@pytest.mark.parametrize(("algorithm", "callback", "size"), [(DQN, False, 130), (QRDQN, True, 5000)])
def test_learns_the_same(algorithm: type[OffPolicyAlgorithm], callback: bool, size: int) -> None:
    """The same weights, bit for bit, as stock SB3 on the bare environment; also where the buffer wraps around."""
    bare = weights(algorithm, small_rooms(), buffer_size=size)
    own = SubgoalDiscoveryCallback() if callback else None
    wrapped = weights(algorithm, optioned_rooms(0), own, replay_buffer_class=OptionReplayBuffer, buffer_size=size)
    assert bare.keys() == wrapped.keys()
    for name, value in bare.items():
        assert torch.equal(value, wrapped[name]), name
