"""A last layer with outputs added later, whose first outputs stay bit for bit what they were."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import nn
from torch.nn import functional


class JoinedLinear(nn.Linear):
    """A linear layer that computes its first outputs apart from those that were added later.

    One product with more rows need not repeat the old outputs: the kernel that a BLAS selects, and so the order of its
    sums, depends on the number of rows. Here the old rows are multiplied in the shape that they had. ``weight`` and
    ``bias`` hold all rows, as in any other ``nn.Linear``, so that files, optimizers and target networks need no change.

    The rows are laid out as (outputs per action, actions), which is how QRDQN has its quantiles.

    Args:
        layer: Its parameters become this layer's own.
        n_first: Number of actions that it was trained with at first.
        outputs_per_action: Rows for each action.

    Raises:
        ValueError: The rows do not divide into actions, or there are none besides the first ones.
    """

    def __init__(self, layer: nn.Linear, n_first: int, outputs_per_action: int = 1) -> None:
        n_actions, remainder = divmod(layer.out_features, outputs_per_action)
        if remainder or not 0 < n_first < n_actions:
            raise ValueError(
                f"A layer of {layer.out_features} outputs, {outputs_per_action} per action, cannot be joined of "
                f"{n_first} actions and others."
            )
        nn.Module.__init__(self)
        self.in_features, self.out_features = layer.in_features, layer.out_features
        self.weight, self.bias = layer.weight, layer.bias
        self.n_first, self.outputs_per_action = n_first, outputs_per_action
        self.train(layer.training)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """All outputs, (batch, out_features)."""
        n, per_action = self.n_first, self.outputs_per_action
        if per_action == 1:  # the same without reshaping, which takes longer than so small a product
            first = functional.linear(features, self.weight[:n], self.bias[:n])
            return torch.cat([first, functional.linear(features, self.weight[n:], self.bias[n:])], dim=-1)
        weight, bias = by_action(self.weight, per_action), by_action(self.bias, per_action)
        outputs = [
            functional.linear(features, weight[:, some].flatten(0, 1), bias[:, some].flatten())
            for some in (slice(None, n), slice(n, None))
        ]
        shape = (*features.shape[:-1], per_action, -1)
        return torch.cat([each.reshape(shape) for each in outputs], dim=-1).flatten(-2)

    def extra_repr(self) -> str:
        """What ``print`` shows."""
        return f"{super().extra_repr()}, n_first={self.n_first}"


def by_action(rows: torch.Tensor, outputs_per_action: int) -> torch.Tensor:
    """Rows (outputs per action · actions, …) as (outputs per action, actions, …)."""
    return rows.reshape(outputs_per_action, -1, *rows.shape[1:])


def widened(rows: torch.Tensor, n_later: int, outputs_per_action: int = 1) -> torch.Tensor:
    """Zeros for ``n_later`` more actions behind the rows of the present ones.

    Args:
        rows: (outputs per action · actions, …).
        n_later: How many actions to add.
        outputs_per_action: Rows for each action.

    Returns:
        (outputs per action · (actions + n_later), …).
    """
    present = by_action(rows.detach(), outputs_per_action)
    zeros = present.new_zeros((outputs_per_action, n_later, *rows.shape[1:]))
    return torch.cat([present, zeros], dim=1).flatten(0, 1).contiguous()


def widened_linear(
    layer: nn.Linear, n_later: int, outputs_per_action: int, optimizers: Iterable[torch.optim.Optimizer]
) -> JoinedLinear:
    """A layer with ``n_later`` more actions of zero weights, which takes the place of ``layer`` in its optimizers.

    What an optimizer keeps for each weight, such as Adam's moments, is kept for the old rows and 0 for the new.

    Args:
        layer: Stays as it is.
        n_later: How many actions to add.
        outputs_per_action: Rows for each action.
        optimizers: Changed in place: parameter groups keep their order and options.

    Returns:
        The wider layer.
    """
    wider = nn.Linear(layer.in_features, layer.out_features + n_later * outputs_per_action, device="meta")
    wider.train(layer.training)
    for name in ("weight", "bias"):
        old: nn.Parameter = getattr(layer, name)
        new = nn.Parameter(widened(old, n_later, outputs_per_action), requires_grad=old.requires_grad)
        setattr(wider, name, new)
        for optimizer in optimizers:
            _replace(optimizer, old, new, n_later, outputs_per_action)
    return JoinedLinear(wider, layer.out_features // outputs_per_action, outputs_per_action)


def check_optimizer(optimizer: torch.optim.Optimizer, layer: nn.Linear) -> None:
    """Refuse an optimizer that keeps for a layer what cannot be divided by rows.

    Raises:
        TypeError: It keeps a tensor that has neither the parameter's shape nor a single element.
    """
    for parameter in (layer.weight, layer.bias):
        for key, value in optimizer.state.get(parameter, {}).items():
            if isinstance(value, torch.Tensor) and value.numel() > 1 and value.shape != parameter.shape:
                raise TypeError(
                    f"{type(optimizer).__name__} keeps {key!r} of shape {tuple(value.shape)} for a parameter of shape "
                    f"{tuple(parameter.shape)}, which cannot be kept for some of its rows: use an optimizer like Adam "
                    "or RMSprop, or clear model.policy.optimizer.state first."
                )


def _replace(
    optimizer: torch.optim.Optimizer, old: nn.Parameter, new: nn.Parameter, n_later: int, outputs_per_action: int
) -> None:
    for group in optimizer.param_groups:
        group["params"][:] = [new if parameter is old else parameter for parameter in group["params"]]
    if old not in optimizer.state:
        return
    kept: dict[str, Any] = optimizer.state.pop(old)
    optimizer.state[new] = {
        key: widened(value, n_later, outputs_per_action)
        if isinstance(value, torch.Tensor) and value.shape == old.shape
        else value
        for key, value in kept.items()
    }
