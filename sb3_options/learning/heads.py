"""Closed and open heads: the outputs of option slots in a stock network.

The outputs of an empty slot are closed: weights 0 and a bias that loses every comparison. So no greedy choice and no
bootstrap target names the slot, and its gradient is zero, because no stored transition names it either. The outputs are
opened when an option is installed. All other outputs stay bit for bit what they were.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm

CLOSED_VALUE = -1e6
"""Bias of a closed output: below any return, of probability 0 as a logit, and far from where float32 overflows."""

RAISED_VALUE = 0.9 * CLOSED_VALUE
"""A bias that weight decay has raised above this is closed again."""


ROUNDING = 1e-4
"""By so much of what is added to one output others may move."""

OWN_NETWORK = "let a network of your own end in torch.nn.Linear(n, n_actions), and return what that gives."


def option_outputs(policy: Any) -> list[tuple[torch.nn.Linear, int]]:
    """The last layers that give one value (or one set of quantiles) per action.

    Args:
        policy: Of an SB3 model.

    Returns:
        A layer and its outputs per action, for each of the heads. They are the online and the target network of DQN and
        QRDQN, the logits of an actor-critic policy (PPO, A2C, TRPO, MaskablePPO, RecurrentPPO).

    Raises:
        TypeError: The policy is none whose heads are known.
    """
    if has_networks(policy):
        return [(last_layer_of(network), getattr(network, "n_quantiles", 1)) for network in networks(policy)]
    if isinstance(getattr(policy, "action_net", None), torch.nn.Linear):
        return [(policy.action_net, 1)]
    raise TypeError(
        f"The heads of {type(policy).__name__} are not known: options can be discovered for DQN, QRDQN, OptionDQN, "
        "PPO, A2C, TRPO, MaskablePPO and RecurrentPPO."
    )


def has_heads(policy: Any) -> bool:
    """Whether the policy is one of those whose heads are known."""
    try:
        option_outputs(policy)
    except TypeError:
        return False
    return True


def networks(policy: Any) -> tuple[Any, Any]:
    """The online and the target network of DQN or QRDQN.

    Raises:
        TypeError: The policy has none that values actions.
    """
    for name in ("q_net", "quantile_net"):
        online, target = getattr(policy, name, None), getattr(policy, f"{name}_target", None)
        if online is not None and target is not None:
            return online, target
    raise TypeError(f"{type(policy).__name__} gives no values of actions; DQN, QRDQN and OptionDQN do.")


def has_networks(policy: Any) -> bool:
    """Whether the policy gives values of actions, as DQN's and QRDQN's do."""
    return any(getattr(policy, f"{name}_target", None) is not None for name in ("q_net", "quantile_net"))


def body_of(network: Any) -> torch.nn.Sequential:
    """A network of `networks` between its features and its last layer."""
    return torch.nn.Sequential(*_layers_of(network)[:-1])


def last_layer_of(network: Any) -> torch.nn.Linear:
    """The last layer of a network of `networks`.

    Raises:
        TypeError: It is not linear.
    """
    layer = _layers_of(network)[-1]
    if not isinstance(layer, torch.nn.Linear):
        raise TypeError(
            f"The last layer of {type(network).__name__} is {type(layer).__name__}, and options need a linear one with "
            f"an output for each action, whose row is closed while a slot is empty: {OWN_NETWORK}"
        )
    return layer


def _layers_of(network: Any) -> list[torch.nn.Module]:
    return list(network.q_net if hasattr(network, "q_net") else network.quantile_net)


def rows_of(layer: torch.nn.Linear, outputs_per_action: int, action: int) -> torch.Tensor:
    """Rows of the layer that belong to an action; QRDQN lays its outputs out as (quantile, action)."""
    n_actions = layer.out_features // outputs_per_action
    return torch.arange(outputs_per_action, device=layer.weight.device) * n_actions + action


@torch.no_grad()
def close_head(policy: Any, action: int) -> None:
    """Make ``action`` lose every comparison."""
    for layer, outputs in option_outputs(policy):
        rows = rows_of(layer, outputs, action)
        layer.weight[rows] = 0.0
        layer.bias[rows] = CLOSED_VALUE


def decays(policy: Any) -> bool:
    """Whether the optimizer has weight decay, which by and by opens what is closed: AdamW, for one."""
    return any(group.get("weight_decay", 0.0) for group in policy.optimizer.param_groups)


def is_raised(policy: Any, action: int) -> bool:
    """Whether the bias of an action is above `RAISED_VALUE`."""
    layer, outputs = option_outputs(policy)[0]
    return bool((layer.bias[rows_of(layer, outputs, action)] > RAISED_VALUE).any())


@torch.no_grad()
def forget_moments(policy: Any, action: int) -> None:
    """Zero the optimizer's moments of an action's head, which would move it after it was closed."""
    for layer, outputs in option_outputs(policy):
        rows = rows_of(layer, outputs, action)
        for parameter in (layer.weight, layer.bias):
            for moment in policy.optimizer.state.get(parameter, {}).values():
                if isinstance(moment, torch.Tensor) and moment.shape == parameter.shape:
                    moment[rows] = 0.0


@torch.no_grad()
def open_head(policy: Any, action: int, n_primitive: int, *, odds: float | None = None) -> None:
    """Set the outputs of ``action`` to the mean of the primitive actions' values, or of their logits.

    The mean never exceeds the best primitive's value, so that a new option is chosen by exploration and not by a lucky
    initialisation.

    Args:
        policy: Of an SB3 model.
        action: Whose head is closed.
        n_primitive: Number of primitive actions.
        odds: For logits: probability of the action over that of all primitives together, where these are equally
            likely; None makes it as likely as one of them. The more certain the policy, the smaller its probability.
    """
    for layer, outputs in option_outputs(policy):
        primitive = torch.stack([rows_of(layer, outputs, a) for a in range(n_primitive)])
        rows = rows_of(layer, outputs, action)
        layer.weight[rows] = layer.weight[primitive].mean(dim=0)
        layer.bias[rows] = layer.bias[primitive].mean(dim=0)
        if odds is not None:
            layer.bias[rows] += math.log(odds * n_primitive)


def is_closed(policy: Any, action: int) -> bool:
    """Whether ``action`` is closed."""
    layer, outputs = option_outputs(policy)[0]
    rows = rows_of(layer, outputs, action)
    return bool((layer.bias[rows] <= CLOSED_VALUE / 2).all())


def is_untrained(model: BaseAlgorithm, n_primitive: int) -> bool:
    """Whether the heads of option slots still have their random initial weights.

    No update was made, no optimizer moments were loaded (as ``set_parameters`` does), and no head was closed.
    """
    if getattr(model, "_n_updates", 0) > 0 or model.policy.optimizer.state:
        return False
    n_actions = int(model.action_space.n)  # type: ignore[attr-defined]  # checked to be Discrete
    return not any(is_closed(model.policy, action) for action in range(n_primitive, n_actions))


@torch.no_grad()
def check_values(policy: Any, observation: Any, n_actions: int) -> None:
    """Refuse a network of values whose last layer does not give each action its own, as one that is the user's may be.

    Args:
        policy: Of DQN or QRDQN; others are left alone.
        observation: A batch of one, as the environment gives it.
        n_actions: Primitive ones, and slots.

    Raises:
        TypeError: The last layer has no output for each action, or the network makes something else of its outputs.
    """
    if not has_networks(policy):
        return
    network, _ = networks(policy)
    layer, outputs = option_outputs(policy)[0]
    name = type(network).__name__
    if layer.out_features != n_actions * outputs:
        raise TypeError(
            f"The last layer of {name} has {layer.out_features} outputs, and options need {n_actions * outputs}, for "
            f"each of the {n_actions} actions, slots among them: {OWN_NETWORK}"
        )
    training = policy.training
    policy.set_training_mode(False)
    batch, _ = policy.obs_to_tensor(observation)
    last, rows = n_actions - 1, rows_of(layer, outputs, n_actions - 1)
    before, bias = network(batch), layer.bias.clone()
    added = 1.0 + float(before.abs().max())  # as large as the values, or it would be lost in their rounding
    layer.bias[rows] += added
    moved = (network(batch) - before).abs().reshape(-1, n_actions) / added
    layer.bias.copy_(bias)
    policy.set_training_mode(training)
    if moved[:, :last].max() > ROUNDING or moved[:, last].min() < 0.5:
        raise TypeError(
            f"{name} gives other values than the outputs of its last layer, as dueling networks do, so that the output "
            f"of an empty slot would change those of all actions: {OWN_NETWORK}"
        )
