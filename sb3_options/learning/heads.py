"""Closed and open heads: the outputs of option slots in a stock network.

The outputs of an empty slot are closed: weights 0 and a bias that loses every comparison. So no greedy choice and no
bootstrap target names the slot. Its gradient is zero, because no stored transition names it either. The outputs are
opened when an option is installed. All other outputs stay the same, bit for bit.
"""

import math
from collections.abc import Callable
from typing import Any

import torch

CLOSED_VALUE = -1e6
"""Bias of a closed output: below any return, of probability 0 as a logit, and far from float32's overflow."""

ROUNDING = 1e-4  # tolerance of `check_outputs`, relative to the number added to one output, for it and for the others

VALUES = ("q_net", "quantile_net")
"""Attributes of a policy that hold networks of action values; the target network has the suffix ``_target``."""


def option_outputs(policy: Any) -> list[tuple[torch.nn.Linear, int]]:
    """Return the last layers that give one value (or set of quantiles) per action, each with its outputs per action.

    They are found by their shape: in each network the last linear layer with an output for each action. The networks
    are the online and the target network of DQN and QRDQN, or the logits of an actor-critic policy (PPO, A2C, TRPO,
    MaskablePPO, RecurrentPPO). `TypeError`: there is no such network, or it has no such layer.
    """
    n_actions = int(policy.action_space.n)
    if networks(policy):
        outputs = int(getattr(networks(policy)[0], "n_quantiles", 1))
        where = f"q_net or quantile_net of {type(policy).__name__}"
        return [(last_layer(network, where, n_actions * outputs), outputs) for network in networks(policy)]
    if getattr(policy, "action_net", None) is None:
        raise TypeError(
            f"{type(policy).__name__} has neither action_net, as policies of PPO, A2C, TRPO, MaskablePPO and "
            "RecurrentPPO, nor q_net or quantile_net, as those of DQN, QRDQN and OptionDQN: options need one of these, "
            f"which ends in torch.nn.Linear(n, {n_actions}), an output for each action, slots among them."
        )
    return [(last_layer(policy.action_net, f"action_net of {type(policy).__name__}", n_actions), 1)]


def last_layer(network: torch.nn.Module, name: str, n_outputs: int) -> torch.nn.Linear:
    """Return the last linear layer of a network that has ``n_outputs`` outputs."""
    linear = [each for each in network.modules() if isinstance(each, torch.nn.Linear) and each.bias is not None]
    fitting = [each for each in linear if each.out_features == n_outputs]
    if not fitting:
        raise TypeError(
            f"{name} must end in torch.nn.Linear(n, {n_outputs}) with a bias, an output for each action, slots among "
            "them: an empty slot is closed in its row of the weights."
        )
    return fitting[-1]


def networks(policy: Any) -> tuple[Any, ...]:
    """Return the online and the target network of DQN or QRDQN; none of a policy without values of actions."""
    pairs = ((getattr(policy, name, None), getattr(policy, f"{name}_target", None)) for name in VALUES)
    return next((pair for pair in pairs if pair[1] is not None), ())


def rows_of(layer: torch.nn.Linear, outputs_per_action: int, action: int) -> torch.Tensor:
    """Return the rows of the layer for an action; QRDQN lays out its outputs as (quantile, action)."""
    n_actions = layer.out_features // outputs_per_action
    return torch.arange(outputs_per_action, device=layer.weight.device) * n_actions + action


@torch.no_grad()
def close_head(policy: Any, action: int) -> None:
    """Make ``action`` lose every comparison."""
    for layer, outputs in option_outputs(policy):
        rows = rows_of(layer, outputs, action)
        layer.weight[rows] = 0.0
        layer.bias[rows] = CLOSED_VALUE


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

    The mean never exceeds the best primitive's value. So exploration chooses a new option, not a lucky initial value.

    ``odds``, for logits, are the probability of the action over that of all primitives together, if these are equally
    likely. None makes it as likely as one of them. The more certain the policy, the smaller its probability.
    """
    for layer, outputs in option_outputs(policy):
        primitive = torch.stack([rows_of(layer, outputs, a) for a in range(n_primitive)])
        rows = rows_of(layer, outputs, action)
        layer.weight[rows] = layer.weight[primitive].mean(dim=0)
        layer.bias[rows] = layer.bias[primitive].mean(dim=0)
        if odds is not None:
            layer.bias[rows] += math.log(odds * n_primitive)


def is_closed(policy: Any, action: int) -> bool:
    """Return whether ``action`` is closed, also after weight decay (AdamW's) has raised its bias a little."""
    layer, outputs = option_outputs(policy)[0]
    rows = rows_of(layer, outputs, action)
    return bool((layer.bias[rows] <= CLOSED_VALUE / 1000).all())


@torch.no_grad()
def check_outputs(policy: Any, actions_of: Callable[[], torch.Tensor]) -> None:
    """Refuse a network, such as a user's own, whose last layer does not give each action an output of its own.

    The test adds a number to the bias of the last action: only its output may change, by this number.
    """
    layer, outputs = option_outputs(policy)[0]
    rows = rows_of(layer, outputs, int(policy.action_space.n) - 1)
    before = actions_of()
    bias = layer.bias.clone()
    added = 1.0 + float(before.abs().max())  # as large as the values, or their rounding would hide it
    layer.bias[rows] += added
    moved = (actions_of() - before).flatten(end_dim=-2) / added
    layer.bias.copy_(bias)
    if not networks(policy):
        moved = moved - moved[:, :1]
    if moved[:, :-1].abs().max() > ROUNDING or (moved[:, -1] - 1.0).abs().max() > ROUNDING:
        where = "q_net or quantile_net" if networks(policy) else "action_net"
        raise TypeError(
            f"{type(policy).__name__} changes the outputs of the last torch.nn.Linear of its {where}, as dueling "
            "networks do, so closing an empty slot would change all actions: return that layer's outputs unchanged."
        )


def widen(layer: torch.nn.Linear, n_later: int, outputs_per_action: int, optimizer: torch.optim.Optimizer) -> None:
    """Add outputs of zero weights for ``n_later`` more actions; the optimizer keeps its state for each old row."""
    for name in ("weight", "bias"):
        old: torch.nn.Parameter = getattr(layer, name)
        new = torch.nn.Parameter(_widened(old, n_later, outputs_per_action), requires_grad=old.requires_grad)
        setattr(layer, name, new)
        for group in optimizer.param_groups:
            group["params"][:] = [new if parameter is old else parameter for parameter in group["params"]]
        if old in optimizer.state:
            optimizer.state[new] = {
                key: _widened(value, n_later, outputs_per_action)
                if isinstance(value, torch.Tensor) and value.shape == old.shape
                else value
                for key, value in optimizer.state.pop(old).items()
            }
    layer.out_features += n_later * outputs_per_action


def _widened(rows: torch.Tensor, n_later: int, outputs_per_action: int) -> torch.Tensor:
    """Return rows (outputs per action · actions, …), with zeros for later actions."""
    present = rows.detach().reshape(outputs_per_action, -1, *rows.shape[1:])
    zeros = present.new_zeros((outputs_per_action, n_later, *rows.shape[1:]))
    return torch.cat([present, zeros], dim=1).flatten(0, 1).contiguous()
