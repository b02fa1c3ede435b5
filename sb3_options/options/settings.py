"""How options are learned, and how they are judged."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from sb3_options.checked import Field, settings

PolicyInput: TypeAlias = Literal["observation", "features"]
"""Input of a policy: the observation, or its features φ in concept space."""


@settings
class OptionLearningSettings:
    """How an option is made for a subgoal (McGovern & Barto 2001, §5).

    Attributes:
        policy_input: Input of the option's policy: ``observation``, or ``features`` if φ shows the way to the subgoal.
            With features a few trajectories suffice, because fewer states differ.
        initiation_steps: n: the states of the last n primitive steps before the first visit of the subgoal enter I.
        initiation_radius: An observation lies in I if its features are within this distance, in scaled units, of a
            state that entered I.
        max_duration: Longest run of the option, in primitive steps. On a group of features it is at most n.
        leave_reward: Reward, below 0, for a step that leaves I or ends the episode away from the subgoal. The default
            is worse than any run of ``max_duration`` steps (`tasks` has the rewards of other steps).
        gamma: Discount of the option's own task.
        value_function: ``table`` for observations that repeat, ``network`` for others. ``auto`` takes a table if
            the transitions of I have at most half as many distinct observations as transitions.
        sweeps: Maximum number of sweeps through the saved transitions for a table. It stops when nothing changes.
        grow: Whether to learn an option anew, initiation set and policy, each time twice as many saved trajectories
            have reached its subgoal. An option from a file adds the experience of this training.
    """

    policy_input: PolicyInput = "observation"
    initiation_steps: Annotated[int, Field(ge=1)] = 15
    initiation_radius: Annotated[float, Field(ge=0)] = 0.5
    max_duration: Annotated[int, Field(ge=1)] = 100
    leave_reward: Annotated[float, Field(lt=0, allow_inf_nan=False)] = -100.0
    gamma: Annotated[float, Field(gt=0, le=1)] = 0.99
    value_function: Literal["auto", "table", "network"] = "auto"
    sweeps: Annotated[int, Field(ge=1)] = 500
    grow: bool = True


@settings
class UsefulnessSettings:
    """How options are judged, and useless ones closed.

    Attributes:
        min_reached: Minimum fraction of an option's runs, in [0, 1]. A state of I leaves I if fewer runs from it reach
            the subgoal. An option is closed if fewer of its runs end before `max_duration` and without failure. 0
            disables both.
    """

    min_reached: Annotated[float, Field(ge=0, le=1)] = 0.5
