"""Learns an option for a subgoal from saved trajectories, and relearns it from later ones."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch

from sb3_options.density.regions import Region
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options.imagined import imagined_farther
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import OptionPolicy, TabularPolicy
from sb3_options.options.reach import reliable_part
from sb3_options.options.replay import replay_into_network, replay_into_table
from sb3_options.options.settings import OptionLearningSettings
from sb3_options.options.tasks import Transitions, initiation_set, transitions_to

MIN_REACH = 0.5  # least probability, by the saved steps, of reaching the subgoal from a state of I on few features
NETWORK_UPDATES = 2000  # gradient steps for a network, each of a few milliseconds at most
FIRST_GROWTH = 5  # an adopted option counts as made from this many trajectories


def learn_option(
    subgoal: Region,
    trajectories: Iterable[LabelledTrajectory],
    n_primitive: int,
    settings: OptionLearningSettings,
    generator: torch.Generator,
    *,
    name: str = "subgoal",
) -> SubgoalOption | None:
    """Return an option that reaches a region, learned from saved trajectories, not yet bound to a feature map.

    On a group of features the initiation set has the features that the group sees, and the policy acts on these alone,
    whatever ``policy_input`` says. The option then lasts at most ``initiation_steps``, and has to promise to reach its
    subgoal within these: features that it does not see can make it go in a circle.

    Return None if no saved trajectory leads to the subgoal, or if no state promises to reach it in half of the runs.
    """
    trajectories = list(trajectories)
    if subgoal.group is not None:
        longest = min(settings.max_duration, settings.initiation_steps)
        settings = replace(settings, policy_input="features", max_duration=longest)
    initiation = initiation_set(subgoal, trajectories, settings)
    transitions = transitions_to(subgoal, initiation, trajectories, settings)
    if transitions is None:
        return None
    policy = _learn_policy(transitions, n_primitive, settings, generator)
    if subgoal.group is not None and isinstance(policy, TabularPolicy):
        initiation = reliable_part(initiation, transitions, policy, least=MIN_REACH, steps=settings.max_duration)
    if isinstance(policy, TabularPolicy):
        initiation, policy = imagined_farther(initiation, transitions, policy, settings)
    if not len(initiation.points):
        return None
    return SubgoalOption(
        subgoal, initiation, policy, policy_input=settings.policy_input, max_duration=settings.max_duration, name=name
    )


def _learn_policy(
    transitions: Transitions, n_primitive: int, settings: OptionLearningSettings, generator: torch.Generator
) -> OptionPolicy:
    kind = settings.value_function
    if kind == "auto":
        distinct = len(np.unique(transitions.began))
        kind = "table" if 2 * distinct <= len(transitions.began) else "network"
    if kind == "table":
        return replay_into_table(transitions, n_primitive, gamma=settings.gamma, sweeps=settings.sweeps)
    return replay_into_network(
        transitions, n_primitive, gamma=settings.gamma, updates=NETWORK_UPDATES, generator=generator
    )


def joined(option: SubgoalOption, later: SubgoalOption) -> SubgoalOption:
    """Join an option from elsewhere with one that was learned here for the same subgoal.

    The trajectories of the first option are not at hand, so nothing can be learned from all of them. I is the union of
    both. π is that of the later option in the states that it knows. Return the first option if a policy is not a table
    or if they act on different inputs.
    """
    known, new = option.option_policy, later.option_policy
    if not (isinstance(known, TabularPolicy) and isinstance(new, TabularPolicy)):
        return option
    if option.policy_input != later.policy_input:
        return option
    rows, states, values = known.rows_for(new.states)
    values[rows] = new.values
    union = np.unique(np.concatenate([option.initiation_set.points, later.initiation_set.points]), axis=0)
    there = replace(option.initiation_set, points=union)
    return replace(option, initiation_set=there, option_policy=TabularPolicy(states, values))


class OptionGrowth:
    """Says when an option is relearned: each time twice as many trajectories have reached its subgoal.

    An option is made from the few trajectories saved until then, and its initiation set covers no more than these.
    Relearning it at every doubling costs at most as much as learning two options from all trajectories.
    """

    STATE = ("_reached", "_learned_from")

    def __init__(self) -> None:
        self._reached: dict[int, int] = {}
        self._learned_from: dict[int, int] = {}

    def made(self, slot: int, subgoal: Region, trajectories: Iterable[LabelledTrajectory]) -> None:
        """Count the ``trajectories`` that the option in ``slot`` was made from."""
        reached = sum(bool(subgoal.contains(each.features).any()) for each in trajectories)
        self._reached[slot] = self._learned_from[slot] = reached

    def adopted(self, slot: int) -> None:
        """Start counting for an option that was made elsewhere."""
        self._reached.setdefault(slot, 0)
        self._learned_from.setdefault(slot, FIRST_GROWTH)

    def forget(self, slot: int) -> None:
        """Stop counting for a closed option."""
        self._reached.pop(slot, None)
        self._learned_from.pop(slot, None)

    def is_due(self, slot: int, subgoal: Region, trajectory: LabelledTrajectory) -> bool:
        """Count a trajectory, and return whether the option in ``slot`` is to be relearned: at every doubling.

        Never relearn an option that was neither `made` nor `adopted`.
        """
        if slot not in self._reached:
            return False
        self._reached[slot] += bool(np.any(subgoal.contains(trajectory.features)))
        if self._reached[slot] < 2 * self._learned_from[slot]:
            return False
        self._learned_from[slot] = self._reached[slot]
        return True
