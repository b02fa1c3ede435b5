"""From a subgoal to an option: the initiation set from saved trajectories, the policy by experience replay."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from numbers import Integral
from typing import Literal, NamedTuple

import numpy as np
import torch

from sb3_options.density.regions import Region
from sb3_options.experience import observations as obs_batch
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray, Observations, flatten
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import NetworkPolicy, OptionPolicy, PolicyInput, TabularPolicy


@dataclass(frozen=True)
class OptionLearningSettings:
    """How an option is made for a subgoal (McGovern & Barto 2001, §5).

    Attributes:
        policy_input: What the option's policy acts on. ``features`` are enough where the way to the subgoal shows in
            concept space, and then a few trajectories teach it: there is less to tell apart.
        initiation_steps: n: the states of the last n primitive steps before a visit of the subgoal enter I.
        initiation_visits: ``first`` visit of the subgoal in each trajectory only, which leads forward, or ``every``.
        initiation_radius: An observation lies in I if its features are within this distance, in scaled units, of a
            state that entered I.
        max_duration: Longest run of the option, primitive steps.
        step_reward: Reward of the option's own task for every step that goes on.
        subgoal_reward: Reward for the step that reaches the subgoal.
        leave_reward: Reward for the step that leaves I, or ends the episode elsewhere than at the subgoal. The default
            is worse than any run of ``max_duration`` steps.
        gamma: Discount of the option's own task.
        value_function: ``table`` for observations that repeat, ``network`` for those that do not, or ``auto``:
            a table if the transitions of I have at most half as many distinct observations as there are transitions.
        sweeps: Most sweeps through the saved transitions for a table; it stops when nothing changes any more.
        network_updates: Gradient steps for a network.
        keep_learning: Whether an option with a table goes on learning from every later trajectory.
        step_size: α of that learning, in (0, 1].
        grow: Whether an option is learned anew, initiation set and policy, from all saved trajectories each time
            twice as many of them have reached its subgoal.
    """

    policy_input: PolicyInput = "observation"
    initiation_steps: int = 15
    initiation_visits: Literal["first", "every"] = "first"
    initiation_radius: float = 0.5
    max_duration: int = 100
    step_reward: float = -1.0
    subgoal_reward: float = 0.0
    leave_reward: float = -100.0
    gamma: float = 0.99
    value_function: Literal["auto", "table", "network"] = "auto"
    sweeps: int = 500
    network_updates: int = 2000
    keep_learning: bool = False
    step_size: float = 0.1
    grow: bool = False

    @property
    def goes_on(self) -> bool:
        """Whether options change after they were made."""
        return self.keep_learning or self.grow

    def __post_init__(self) -> None:
        """Refuse values out of range, by name."""
        for name in ("initiation_steps", "max_duration", "sweeps", "network_updates"):
            if not isinstance(getattr(self, name), Integral) or getattr(self, name) < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, got {getattr(self, name)}.")
        for name in ("step_reward", "subgoal_reward", "leave_reward"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}.")
        if not self.initiation_radius >= 0:
            raise ValueError(f"initiation_radius must be at least 0, got {self.initiation_radius}.")
        if not 0.0 < self.gamma <= 1.0:
            raise ValueError(f"gamma must be in (0, 1], got {self.gamma}.")
        if not 0.0 < self.step_size <= 1.0:
            raise ValueError(f"step_size must be in (0, 1], got {self.step_size}.")
        if self.initiation_visits not in ("first", "every"):
            raise ValueError(f"initiation_visits must be 'first' or 'every', got {self.initiation_visits!r}.")
        if self.policy_input not in ("observation", "features"):
            raise ValueError(f"policy_input must be 'observation' or 'features', got {self.policy_input!r}.")
        if self.value_function not in ("auto", "table", "network"):
            raise ValueError(f"value_function must be 'auto', 'table' or 'network', got {self.value_function!r}.")


class Transitions(NamedTuple):
    """Primitive steps of the option's own task, each distinct observation stored once.

    Attributes:
        states: The distinct observations, or features where the policy acts on those, batch of m.
        began: Row of ``states`` where each step began, shape (n,).
        actions: Primitive actions, shape (n,).
        rewards: Of the option's own task, shape (n,).
        led: Row of ``states`` where each step led, shape (n,).
        ends: Whether the step reached the subgoal, left I or ended the episode in a terminal state, shape (n,).
    """

    states: Observations
    began: IntArray
    actions: IntArray
    rewards: FloatArray
    led: IntArray
    ends: BoolArray


def initiation_set(
    subgoal: Region, trajectories: Iterable[LabelledTrajectory], settings: OptionLearningSettings
) -> Region:
    """The union of the n states before a visit of the subgoal, over all saved trajectories.

    Args:
        subgoal: In concept space.
        trajectories: All of them, successful or not.
        settings: ``initiation_steps``, ``initiation_visits`` and ``initiation_radius`` are used.

    Returns:
        A region with one centre for every distinct state; empty if no trajectory visits the subgoal.
    """
    points: list[FloatArray] = [np.zeros((0, subgoal.points.shape[1]))]
    for labelled in trajectories:
        visits = labelled.trajectory.visits
        times = np.flatnonzero(subgoal.contains(labelled.features)[visits])
        if settings.initiation_visits == "first":
            times = times[:1]
        before = np.unique(
            [row for t in times for row in visits[max(0, t - settings.initiation_steps) : t]],
        ).astype(np.int64)
        points.append(labelled.features[before])
    union = np.unique(np.concatenate(points), axis=0)
    outside = union[~subgoal.contains(union)]
    return Region(outside, subgoal.scale, settings.initiation_radius)


def option_transitions(
    subgoal: Region,
    initiation: Region,
    trajectories: Iterable[LabelledTrajectory],
    settings: OptionLearningSettings,
) -> Transitions | None:
    """Every saved primitive step that began in I, rewarded for the option's own task.

    Args:
        subgoal: Reaching it ends the task with ``subgoal_reward``.
        initiation: Leaving it ends the task with ``leave_reward``, and so does a terminal state.
        trajectories: The saved ones.
        settings: The rewards and ``policy_input`` are used.

    Returns:
        The steps; None if there are none.
    """
    row_of: dict[bytes, int] = {}
    states: list[Observations] = []
    columns: list[tuple[IntArray, IntArray, FloatArray, IntArray, BoolArray]] = []
    for labelled in trajectories:
        trajectory = labelled.trajectory
        reached = subgoal.contains(labelled.features)
        inside = initiation.contains(labelled.features) & ~reached
        began, led = trajectory.visits[:-1], trajectory.visits[1:]
        keep = np.flatnonzero(inside[began])
        goes_on = inside[led]
        if trajectory.terminated:
            goes_on[-1] = False
        began, led, goes_on = began[keep], led[keep], goes_on[keep]
        seen = labelled.features if settings.policy_input == "features" else trajectory.states
        shared_row = np.zeros(len(inside), dtype=np.int64)
        for local in np.unique(np.concatenate([began, led])):
            state = obs_batch.take(seen, slice(local, local + 1))
            row = shared_row[local] = row_of.setdefault(obs_batch.key_of(state), len(row_of))
            if row == len(states):
                states.append(state)
        rewards = np.where(
            reached[led],
            settings.subgoal_reward,
            np.where(goes_on, settings.step_reward, settings.leave_reward),
        )
        columns.append((shared_row[began], trajectory.actions[keep], rewards, shared_row[led], ~goes_on))
    if not states:
        return None
    began, actions, rewards, led, ends = (np.concatenate(column) for column in zip(*columns, strict=True))
    return Transitions(obs_batch.concatenate(states), began, actions, rewards, led, ends)


def replay_into_table(transitions: Transitions, n_primitive: int, *, gamma: float, sweeps: int) -> TabularPolicy:
    """Q-learning by replaying all transitions again and again (Lin 1992), with step size 1/N(s, a).

    Every sweep sets Q(s, a) to the mean of r + γ max_a' Q(s', a') over the transitions of (s, a), without the second
    term where the task ends: the fixed point of experience replay. Actions never tried in a state keep −∞, because
    nothing is known of them. A step into a state that no saved trajectory acted in counts as never tried: what comes
    after it is not known.

    Args:
        transitions: Of the option's own task.
        n_primitive: Number of primitive actions.
        gamma: Discount.
        sweeps: At most this many; fewer if nothing changes any more.

    Returns:
        The greedy policy.
    """
    states = flatten(transitions.states)
    n_states = len(states)
    known = _known(transitions, n_states)
    began, led = transitions.began[known], transitions.led[known]
    rewards, goes_on = transitions.rewards[known], ~transitions.ends[known]
    pair = began * n_primitive + transitions.actions[known]
    count = np.bincount(pair, minlength=n_states * n_primitive)
    tried = count > 0
    acted_in: BoolArray = np.any(tried.reshape(n_states, n_primitive), axis=1)
    values = np.where(tried, 0.0, -np.inf)
    for _ in range(sweeps):
        best = np.where(acted_in, values.reshape(n_states, n_primitive).max(axis=1), 0.0)
        target = rewards + gamma * goes_on * best[led]
        updated = values.copy()
        updated[tried] = np.bincount(pair, weights=target, minlength=len(count))[tried] / count[tried]
        if np.array_equal(updated, values):
            break
        values = updated
    return TabularPolicy(states[acted_in], values.reshape(n_states, n_primitive)[acted_in])


def _known(transitions: Transitions, n_states: int) -> BoolArray:
    """Which steps end the task, or lead to a state where known steps begin, shape (n,)."""
    known = np.ones(len(transitions.began), dtype=bool)
    while True:
        acted_in = np.zeros(n_states, dtype=bool)
        acted_in[transitions.began[known]] = True
        still = known & (transitions.ends | acted_in[transitions.led])
        if still.sum() == known.sum():
            return known
        known = still


HIDDEN = 64
BATCH = 128
LEARNING_RATE = 1e-3
TARGET_SYNC = 100


def replay_into_network(
    transitions: Transitions, n_primitive: int, *, gamma: float, updates: int, generator: torch.Generator
) -> NetworkPolicy:
    """Q-learning by replay (Lin 1992) into a network with two hidden layers and a target network.

    Args:
        transitions: Of the option's own task.
        n_primitive: Number of primitive actions.
        gamma: Discount.
        updates: Gradient steps.
        generator: Draws the first weights and the batches.

    Returns:
        The greedy policy.
    """
    states = flatten(transitions.states)
    mean, std = states.mean(axis=0), states.std(axis=0)
    std = np.where(std > 1e-8, std, 1.0)
    inputs = torch.as_tensor((states - mean) / std, dtype=torch.float32)
    began, led = torch.as_tensor(transitions.began), torch.as_tensor(transitions.led)
    actions = torch.as_tensor(transitions.actions, dtype=torch.int64)[:, None]
    rewards = torch.as_tensor(transitions.rewards, dtype=torch.float32)
    goes_on = torch.as_tensor(~transitions.ends, dtype=torch.float32)

    sizes = [inputs.shape[1], HIDDEN, HIDDEN, n_primitive]
    online = torch.nn.Sequential()
    for i, (n_in, n_out) in enumerate(pairwise(sizes)):
        # Initialising it would draw from torch's global generator, which the agent's own training uses.
        layer = torch.nn.utils.skip_init(torch.nn.Linear, n_in, n_out)  # type: ignore[no-untyped-call]  # unannotated
        torch.nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
        torch.nn.init.zeros_(layer.bias)
        online.append(layer)
        if i < len(sizes) - 2:
            online.append(torch.nn.ReLU())
    optimizer = torch.optim.Adam(online.parameters(), lr=LEARNING_RATE)
    state_value = torch.zeros(len(inputs))
    for update in range(updates):
        if update > 0 and update % TARGET_SYNC == 0:
            with torch.no_grad():
                state_value = online(inputs).max(dim=1).values
        batch = torch.randint(len(began), (BATCH,), generator=generator)
        target = rewards[batch] + gamma * goes_on[batch] * state_value[led[batch]]
        predicted = online(inputs[began[batch]]).gather(1, actions[batch])[:, 0]
        loss = torch.nn.functional.smooth_l1_loss(predicted, target)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]  # torch ships no annotation for it
        optimizer.step()
    layers = [layer for layer in online if isinstance(layer, torch.nn.Linear)]
    weights = [layer.weight.detach().numpy().T.astype(np.float64) for layer in layers]
    biases = [layer.bias.detach().numpy().astype(np.float64) for layer in layers]
    return NetworkPolicy(mean, std, weights, biases)


def learn_option(
    subgoal: Region,
    trajectories: Iterable[LabelledTrajectory],
    n_primitive: int,
    settings: OptionLearningSettings,
    generator: torch.Generator,
    *,
    name: str = "subgoal",
) -> SubgoalOption | None:
    """An option that reaches ``subgoal``, made from saved trajectories.

    Args:
        subgoal: In concept space.
        trajectories: The saved ones.
        n_primitive: Number of primitive actions.
        settings: How.
        generator: For a network's first weights and batches.
        name: For people.

    Returns:
        The option, not yet bound to a feature map; None if no saved trajectory leads to the subgoal.
    """
    trajectories = list(trajectories)
    initiation = initiation_set(subgoal, trajectories, settings)
    transitions = option_transitions(subgoal, initiation, trajectories, settings)
    if transitions is None:
        return None
    policy = _learn_policy(transitions, n_primitive, settings, generator)
    return SubgoalOption(
        subgoal,
        initiation,
        policy,
        policy_input=settings.policy_input,
        max_duration=settings.max_duration,
        name=name,
    )


def learn_further(
    option: SubgoalOption, trajectory: LabelledTrajectory, settings: OptionLearningSettings
) -> SubgoalOption:
    """The option after Q-learning, with step size α, on the steps of one more trajectory that began in I.

    The last step comes first, so that what follows a step is known when it is learned from (Lin 1992); a step into a
    state that no trajectory acted in teaches nothing.

    Args:
        option: As it is.
        trajectory: The new one.
        settings: ``step_size``, ``gamma`` and the rewards are used.

    Returns:
        A new option; the same one if the trajectory has nothing to teach, or if its policy is no table.
    """
    policy = option.option_policy
    settings = replace(settings, policy_input=option.policy_input)
    transitions = option_transitions(option.subgoal, option.initiation_set, [trajectory], settings)
    if transitions is None or not isinstance(policy, TabularPolicy):
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
        values[began, action] = old + settings.step_size * (target - old) if np.isfinite(old) else target
        known[began] = True
    return option.with_policy(TabularPolicy(states[known], values[known]))


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
