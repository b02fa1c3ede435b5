"""The records that a checkpoint may hold. All consist of values; making one runs no code of a file."""

from __future__ import annotations

from typing import Any

import torch

from sb3_options.checkpoints.tree import Record, record
from sb3_options.density.bags import Bags
from sb3_options.density.diverse_density import Peak
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.layout import BagArrays
from sb3_options.density.regions import HalfSpace, Region
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import NetworkPolicy, TabularPolicy
from sb3_options.options.proposals import IntrinsicReward, Passage

OPTION = ("subgoal", "initiation_set", "option_policy", "policy_input", "max_duration", "name", "fixed")
"""What an option is made of: the arguments of `SubgoalOption`."""


def _bags(bags: Bags) -> dict[str, Any]:
    return {
        "instances": bags.instances,
        "lengths": bags.lengths,
        "n_positive": bags.n_positive,
        "weights": bags.weights,
        "double": bags.dtype == torch.float64,
    }


def _made_bags(*, double: bool, **fields: Any) -> Bags:
    return Bags(**fields, dtype=torch.float64 if double else torch.float32)


def _of(*names: str) -> Any:
    return lambda each: {name: getattr(each, name) for name in names}


RECORDS: dict[str, Record] = {
    cls.__name__: record(cls)
    for cls in (
        Trajectory,
        LabelledTrajectory,
        Region,
        HalfSpace,
        FeatureGroup,
        Peak,
        BagArrays,
        Passage,
        IntrinsicReward,
    )
} | {
    "Bags": Record(Bags, _made_bags, _bags),
    "SubgoalOption": Record(SubgoalOption, SubgoalOption, _of(*OPTION)),
    "TabularPolicy": Record(TabularPolicy, TabularPolicy, _of("states", "values")),
    "NetworkPolicy": Record(NetworkPolicy, NetworkPolicy, _of("mean", "std", "weights", "biases")),
}
"""By the name under which a checkpoint holds them."""
