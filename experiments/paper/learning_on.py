"""Options that go on learning from every later trajectory, as the paper says (§2: "can be modified over time")."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.experience.observations import BoolArray
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from sb3_options.options.settings import OptionLearningSettings
from sb3_options.options.tasks import transitions_to


class LearningOn(SubgoalDiscoveryCallback):
    """Discovers subgoals; its options learn from every trajectory, also where no new ones are made.

    Attributes:
        step_size: α of that learning; 0 for none.
    """

    step_size = 0.0

    def _learn_from(self, trajectory: Trajectory, success: bool) -> None:
        if self.step_size:
            labelled = LabelledTrajectory(trajectory, self._keeper.options.features_of(trajectory.states), success)
            for slot in self._keeper.options.installed():
                option = self._keeper.options.bank[slot]
                if isinstance(option, SubgoalOption):
                    later = learn_further(option, labelled, self.option_settings, self.step_size)
                    if later is not option:
                        self._keeper.replace(slot, later)
        super()._learn_from(trajectory, success)


def learn_further(
    option: SubgoalOption, trajectory: LabelledTrajectory, settings: OptionLearningSettings, step_size: float
) -> SubgoalOption:
    """The option after Q-learning, with step size α, on the steps of one more trajectory that began in I.

    The steps are replayed backwards, so that the value of a successor is updated before it is used (Lin 1992). A step
    into a state in which no trajectory acted is left out, because the value of that state is unknown.

    Returns:
        A new option; ``option`` itself if no step began in I, or if its policy is not a table.
    """
    policy = option.option_policy
    if not isinstance(policy, TabularPolicy):
        return option
    transitions = transitions_to(option.subgoal, option.initiation_set, [trajectory], settings)
    if transitions is None:
        return option
    rows, states, values = policy.rows_for(transitions.states)
    known: BoolArray = np.any(np.isfinite(values), axis=1)
    for began, action, reward, led, ends in zip(
        rows[transitions.began][::-1],
        transitions.actions[::-1],
        transitions.rewards[::-1],
        rows[transitions.led][::-1],
        transitions.ends[::-1],
        strict=True,
    ):
        if not (ends or known[led]):
            continue
        target = reward if ends else reward + settings.gamma * values[led].max()
        old = values[began, action]
        values[began, action] = old + step_size * (target - old) if np.isfinite(old) else target
        known[began] = True
    return replace(option, option_policy=TabularPolicy(states[known], values[known]))
