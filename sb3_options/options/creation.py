"""From a proposal to an option, learned from saved trajectories, and learned anew from later ones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch

from sb3_options.density.regions import Region
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options.imagined import imagined_farther
from sb3_options.options.initiation import initiation_set, leading
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import OptionPolicy, TabularPolicy
from sb3_options.options.proposals import IntrinsicReward, Passage, Proposal
from sb3_options.options.reach import reliable_part
from sb3_options.options.replay import replay_into_network, replay_into_table
from sb3_options.options.settings import OptionLearningSettings
from sb3_options.options.tasks import Climbing, OwnTask, Reaching, Transitions, transitions_of

NO_GAIN = 1e-9
"""Values below this share of the range of f are rounding."""


def learn_option(
    proposal: Proposal,
    trajectories: Iterable[LabelledTrajectory],
    n_primitive: int,
    settings: OptionLearningSettings,
    generator: torch.Generator,
    *,
    name: str = "subgoal",
) -> SubgoalOption | None:
    """An option for a proposal, made from saved trajectories, not yet bound to a feature map.

    On a group of features the initiation set has the features that the group sees, and the policy acts on these alone,
    whatever ``policy_input`` says. The option lasts ``initiation_steps`` at most, within which it has to promise to
    reach its subgoal: what it does not see can make it go in a circle.

    None if no saved trajectory leads to the subgoal, if none promises to reach it often enough (``min_reach``), or if
    nothing is to be gained on any.
    """
    trajectories = list(trajectories)
    if isinstance(proposal, Region) and proposal.group is not None:
        longest = min(settings.max_duration, settings.initiation_steps)
        settings = replace(settings, policy_input="features", max_duration=longest)
    task: OwnTask
    if isinstance(proposal, IntrinsicReward):
        task = Climbing(proposal)
    elif isinstance(proposal, Passage):
        task = Reaching(proposal.subgoal, leading(proposal, trajectories, settings), settings)
    else:
        task = Reaching(proposal, initiation_set(proposal, trajectories, settings), settings)
    transitions = transitions_of(task, trajectories, settings)
    if transitions is None:
        return None
    policy = _learn_policy(transitions, n_primitive, settings, generator)
    if isinstance(task, Reaching):
        subgoal, initiation = task.subgoal, task.initiation
    else:
        assert isinstance(proposal, IntrinsicReward)
        subgoal, initiation = where_it_pays(proposal, policy, trajectories, n_primitive, settings)
    if subgoal.group is not None and settings.min_reach and isinstance(policy, TabularPolicy):
        initiation = reliable_part(
            initiation,
            transitions,
            policy,
            least=settings.min_reach,
            steps=settings.max_duration,
        )
    if isinstance(policy, TabularPolicy):
        initiation, policy = imagined_farther(initiation, transitions, policy, settings)
    if not len(initiation.points):
        return None
    return SubgoalOption(
        subgoal,
        initiation,
        policy,
        policy_input=settings.policy_input,
        max_duration=settings.max_duration,
        name=name,
        fixed=not isinstance(proposal, Region),
    )


def where_it_pays(
    reward: IntrinsicReward,
    policy: OptionPolicy,
    trajectories: Iterable[LabelledTrajectory],
    n_primitive: int,
    settings: OptionLearningSettings,
) -> tuple[Region, Region]:
    """Where an option that gains a reward ends, and its initiation set (Machado et al. 2017, §3.2).

    The option ends where no action has a value above 0, that of stopping. I is every other place that was visited. A
    network's values are never exactly 0, and often too large, so that it would go on for ever: then the values are
    those of a table of the places.
    """
    trajectories = list(trajectories)
    sums, counts = np.zeros((2, len(reward.points)))
    of_places = None if isinstance(policy, TabularPolicy) else _of_places(reward, trajectories, n_primitive, settings)
    for labelled in trajectories:
        rows, known = reward.rows(labelled.features)
        seen = labelled.features if settings.policy_input == "features" else labelled.trajectory.states
        values = policy.best_values(seen) if of_places is None else of_places[rows]
        np.add.at(sums, rows[known], values[known])
        np.add.at(counts, rows[known], 1.0)
    visited = counts > 0
    pays = visited & (sums > NO_GAIN * np.maximum(counts, 1.0) * np.ptp(reward.potentials))
    ends = np.flatnonzero(visited & ~pays)
    ends = ends[np.argsort(-reward.potentials[ends], kind="stable")]
    return (
        Region(reward.points[ends], reward.scale, reward.radius),
        Region(reward.points[pays], reward.scale, settings.initiation_radius),
    )


def _of_places(
    reward: IntrinsicReward,
    trajectories: Iterable[LabelledTrajectory],
    n_primitive: int,
    settings: OptionLearningSettings,
) -> FloatArray:
    """What is to be gained from each place on, (n,): Q-learning into a table whose states are the places."""
    task, columns = Climbing(reward), []
    for labelled in trajectories:
        times, rewards, ends = task.steps(labelled)
        rows, _ = reward.rows(labelled.features)
        place = rows[labelled.trajectory.visits]
        columns.append((place[times], labelled.trajectory.actions[times], rewards, place[times + 1], ends))
    began, actions, rewards, led, ends = (np.concatenate(column) for column in zip(*columns, strict=True))
    numbers = np.arange(len(reward.points), dtype=np.float64)[:, None]
    places = Transitions(numbers, began, actions, rewards, led, ends, task.stop)
    table = replay_into_table(places, n_primitive, gamma=settings.gamma, sweeps=settings.sweeps)
    values = np.zeros(len(reward.points))
    values[table.states[:, 0].astype(np.int64)] = table.values.max(axis=1)
    return values


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
        transitions, n_primitive, gamma=settings.gamma, updates=settings.network_updates, generator=generator
    )


def joined(option: SubgoalOption, later: SubgoalOption) -> SubgoalOption:
    """An option from elsewhere together with one for the same subgoal that was learned here.

    The trajectories that the first was made from are not at hand, so nothing can be learned from all of them: I is the
    union of both, and π that of the later one in the states that it knows. The first one itself if a policy is not a
    table or they act on different things.
    """
    known, new = option.option_policy, later.option_policy
    same = isinstance(known, TabularPolicy) and isinstance(new, TabularPolicy)
    if not same or option.policy_input != later.policy_input:
        return option
    assert isinstance(known, TabularPolicy)
    assert isinstance(new, TabularPolicy)
    rows, states, values = known.rows_for(new.states)
    values[rows] = new.values
    union = np.unique(np.concatenate([option.initiation_set.points, later.initiation_set.points]), axis=0)
    other = option.with_policy(TabularPolicy(states, values))
    other.initiation_set = replace(option.initiation_set, points=union)
    return other


FIRST_GROWTH = 5
"""An option from elsewhere counts as made from this many trajectories."""


class OptionGrowth:
    """Says when an option is learned anew: each time twice as many trajectories have reached its subgoal.

    An option is made from the few trajectories saved until then, and its initiation set covers no more than these.
    Learning it anew at every doubling costs at most as much as learning two options from all trajectories.
    """

    STATE = ("_reached", "_learned_from")

    def __init__(self) -> None:
        self._reached: dict[int, int] = {}
        self._learned_from: dict[int, int] = {}

    def made(self, slot: int, subgoal: Region, trajectories: Iterable[LabelledTrajectory]) -> None:
        """Count the ``trajectories`` that the option in ``slot`` was made from."""
        self._reached[slot] = self._learned_from[slot] = sum(_reaches(subgoal, t) for t in trajectories)

    def adopted(self, slot: int) -> None:
        """Count from now on for an option that was made elsewhere."""
        self._reached.setdefault(slot, 0)
        self._learned_from.setdefault(slot, FIRST_GROWTH)

    def forget(self, slot: int) -> None:
        """Count no longer for an option that is closed."""
        self._reached.pop(slot, None)
        self._learned_from.pop(slot, None)

    def is_due(self, slot: int, subgoal: Region, trajectory: LabelledTrajectory) -> bool:
        """Whether the option in ``slot`` is to be learned anew after one more trajectory: at every doubling.

        Never an option that was neither `made` nor `adopted`.
        """
        if slot not in self._reached:
            return False
        self._reached[slot] += _reaches(subgoal, trajectory)
        if self._reached[slot] < 2 * self._learned_from[slot]:
            return False
        self._learned_from[slot] = self._reached[slot]
        return True


def _reaches(subgoal: Region, trajectory: LabelledTrajectory) -> bool:
    return bool(np.any(subgoal.contains(trajectory.features)))
