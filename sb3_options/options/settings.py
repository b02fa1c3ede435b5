"""How options are learned, and judged by their use."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from sb3_options.checked import Field, settings

PolicyInput: TypeAlias = Literal["observation", "features"]
"""What a policy acts on: the observation, or its features φ in concept space."""


@settings
class OptionLearningSettings:
    """How an option is made for a subgoal (McGovern & Barto 2001, §5).

    Attributes:
        policy_input: What the option's policy acts on. ``features`` are enough where the way to the subgoal shows in
            concept space; then a few trajectories suffice, because there is less to tell apart.
        initiation_steps: n: the states of the last n primitive steps before the first visit of the subgoal enter I.
        initiation_radius: An observation lies in I if its features are within this distance, in scaled units, of a
            state that entered I.
        max_duration: Longest run of the option, primitive steps; on a group of features at most n, too.
        leave_reward: Reward for the step that leaves I, or ends the episode elsewhere than at the subgoal, below 0. The
            default is worse than any run of ``max_duration`` steps (`tasks` has the rewards of other steps).
        gamma: Discount of the option's own task.
        value_function: ``table`` for observations that repeat, ``network`` for those that do not, or ``auto``:
            a table if the transitions of I have at most half as many distinct observations as there are transitions.
        sweeps: Most sweeps through the saved transitions for a table; it stops when nothing changes any more.
        grow: Whether an option is learned anew, initiation set and policy, from all saved trajectories each time
            twice as many of them have reached its subgoal. An option from a file gains what is learned here.
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
    """How options are judged by their use.

    Attributes:
        min_reached: Share of an option's runs that must reach its subgoal from a state of I, which leaves I otherwise,
            and that must end before `max_duration` and without failure, in [0, 1]; 0 judges none.
    """

    min_reached: Annotated[float, Field(ge=0, le=1)] = 0.5
