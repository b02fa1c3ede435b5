"""Walks along a line to a door at place 5."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch

from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options.policies import TabularPolicy
from tests.support.helpers import ball, line

DOOR = ball(5.0)
LEFT, RIGHT = 0, 1


def walk(places: Sequence[float], **kwargs: Any) -> LabelledTrajectory:
    """Along a line, where the actions are what the places say; a step that stays was to the left."""
    actions = [RIGHT if b > a else LEFT for a, b in pairwise(places)]
    return line(places, actions, **kwargs)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def known_values(policy: TabularPolicy) -> dict[float, list[float]]:
    return {float(s[0]): v.tolist() for s, v in zip(policy.states, policy.values, strict=True)}
