"""Banks of options with tables and networks drawn at random."""

import dataclasses
from typing import Any

import numpy as np

from sb3_options.density.regions import Region
from sb3_options.experience.observations import FloatArray, Observations, flatten
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option, SubgoalOption
from sb3_options.options.policies import NetworkPolicy, TabularPolicy
from tests.support.helpers import ball

N_PRIMITIVE, SIZE, CAPACITY = 4, 3, 5


def first_two(observations: Observations) -> FloatArray:
    return flatten(observations)[:, :2]


def table(seed: int = 0, *, size: int = SIZE, n_primitive: int = N_PRIMITIVE, features: int = 2) -> SubgoalOption:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(30, n_primitive))
    values[rng.random(values.shape) < 0.3] = -np.inf
    return SubgoalOption(
        Region(0.3 * rng.normal(size=(1, features)), rng.uniform(0.5, 2.0, size=features), 0.6),
        Region(rng.normal(size=(12, features)), rng.uniform(0.5, 2.0, size=features), 0.8),
        TabularPolicy(rng.normal(size=(30, size)), values),
        max_duration=17 + seed,
        name=f"table {seed}",
    )


def network(seed: int = 1) -> SubgoalOption:
    rng = np.random.default_rng(seed)
    policy = NetworkPolicy(
        rng.normal(size=SIZE),
        rng.uniform(0.5, 2.0, size=SIZE),
        [rng.normal(size=(SIZE, 8)), rng.normal(size=(8, N_PRIMITIVE))],
        [rng.normal(size=8), rng.normal(size=N_PRIMITIVE)],
    )
    option = table(seed)
    half_space = dataclasses.replace(option.subgoal, normal=rng.normal(size=2))
    return SubgoalOption(half_space, option.initiation_set, policy, max_duration=3, name="network: π ≠ β")


def along_row_5(goal: float, start: int, end: int, action: int) -> SubgoalOption:
    """In `TwoRooms`, along row 5 from columns ``start`` … ``end`` − 1 to its goal by one action."""
    cells = Region(np.array([[x, 5.0] for x in range(start, end)]), np.ones(2), 0.0)
    return SubgoalOption(ball(goal, 5.0), cells, TabularPolicy(np.zeros((1, 210)), np.eye(4)[[action]]))


def empty_bank(**changes: Any) -> OptionBank:
    about: dict[str, Any] = {"feature_map": first_two, "observation_size": SIZE, "feature_size": 2, **changes}
    return OptionBank(about.pop("n_primitive", N_PRIMITIVE), about.pop("max_options", CAPACITY), **about)


def filled_bank() -> OptionBank:
    bank = empty_bank()
    bank.add(table(), 1)
    bank.add(network(), 3)
    return bank


def behaviour(bank: OptionBank, observations: FloatArray) -> list[Any]:
    """The rest, I, π and β of every option."""

    def of(option: Option) -> Any:
        functions = (option.initiation, option.policy, option.termination)
        return option.name, option.max_duration, *(each(observations).tolist() for each in functions)

    return [None if option is None else of(option) for option in bank.slots]


OBSERVATIONS = np.random.default_rng(7).normal(size=(1000, SIZE))
