"""Models that discover the doorway of two small rooms, and the banks of their environments."""

from typing import Any, cast

import numpy as np
from stable_baselines3 import DQN
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_options import OptionBank, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.density.regions import Region
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from tests.support.helpers import steady_option
from tests.support.sb3_helpers import DOORWAY, RANDOM, TINY, optioned_rooms

N_PRIMITIVE = 4
STEPS = 1800
"""Random primitive steps in which the doorway of the small rooms is found."""


def model_of(env: Any = None, algorithm: type[OffPolicyAlgorithm] = DQN, **kwargs: Any) -> Any:
    buffer = {"replay_buffer_class": OptionReplayBuffer}
    env = optioned_rooms() if env is None else env
    return algorithm("MlpPolicy", env, gamma=0.9, **buffer | TINY | RANDOM | kwargs)


def with_option() -> OptionsWrapper:
    env = optioned_rooms(2)
    env.bank.add(steady_option(1, max_duration=3))
    return env


def finds_nothing() -> SubgoalDiscoveryCallback:
    return SubgoalDiscoveryCallback(max_new_options=0)


def to_the_doorway(action: int, *nearby: tuple[float, float]) -> SubgoalOption:
    """An option for the doorway that always takes one action, in force near some places."""
    scale = np.ones(2)
    return SubgoalOption(
        Region(np.array([DOORWAY]), scale, 0.5),
        Region(np.array(nearby), scale, 0.5),
        TabularPolicy(np.array([DOORWAY]), np.eye(N_PRIMITIVE)[[action]]),
        policy_input="features",
        max_duration=3,
    )


def discovered(bank: OptionBank, slot: int = 0) -> SubgoalOption:
    option = bank[slot]
    assert isinstance(option, SubgoalOption)
    return option


def banks(venv: VecEnv) -> list[OptionBank]:
    return cast("list[OptionBank]", venv.get_attr("bank"))


def content(bank: OptionBank) -> list[Any]:
    """What the discovered options of a bank are made of."""
    options = [(i, bank[i]) for i in bank.filled]
    return [
        (i, o.name, o.max_duration, o.subgoal.points.tolist(), sorted(map(tuple, o.initiation_set.points.tolist())),
         [a.tobytes() for a in o.option_policy.arrays().values()])
        for i, o in options if isinstance(o, SubgoalOption)
    ]  # fmt: skip


def same_options(banks: list[OptionBank]) -> bool:
    """Whether all banks hold equal discovered options in the same slots, and at least one."""
    first = content(banks[0])
    return bool(first) and all(content(bank) == first for bank in banks)
