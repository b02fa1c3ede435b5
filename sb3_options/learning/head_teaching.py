"""Teaching the head of an option that moves in, at once, from what the replay buffer holds."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch

from sb3_options.experience.observations import batch_size, take
from sb3_options.learning import heads

SWEEPS = 100
"""Most sweeps of fitted Q-iteration; value travels one primitive step a sweep, and options are shorter."""

TOLERANCE = 1e-3
"""Sweeps stop when no target moves by more than this share of the targets' standard deviation."""

CHUNK = 1000
"""Observations go through the network in batches of this many."""

RIDGE = 0.1
"""Weight of the prior, the mean of the primitive heads, relative to the mean square of a feature.

As large as that, because the network beneath goes on changing: a closer fit needs a head several times as large as the
others (4.7 times their norm at 1e-4, 1.0 times at 0.1, in two small rooms), which magnifies every change, and the
maximum over actions then feeds on it. With 1e-4 one such run never recovered.
"""


class HeadLessons(NamedTuple):
    """Primitive steps that an option would have taken, as tensors on the network's device.

    Attributes:
        observations: s, as the network takes them, batch of n.
        next_observations: s'.
        rewards: r, (n, 1).
        discounts: γ, 0 where the episode ended, (n, 1).
        goes_on: 1 − β(s'), (n, 1).
        weights: Of each step in the fit, (n, 1).
        next_allowed: Which actions may be chosen in s', (n, n_actions).
    """

    observations: Any
    next_observations: Any
    rewards: torch.Tensor
    discounts: torch.Tensor
    goes_on: torch.Tensor
    weights: torch.Tensor
    next_allowed: torch.Tensor


@torch.no_grad()
def teach_head(policy: Any, action: int, n_primitive: int, lessons: HeadLessons) -> None:
    """Fit the head of an option to intra-option targets, with everything else in the network as it is.

    Fitted Q-iteration (Ernst, Geurts & Wehenkel 2005) with r + γ U(s', o) for targets (`intra_option`), max Q of the
    target network for what follows the option, and ridge regression on the last layer's inputs, whose prior is the
    head that `heads.open_head` makes. Quantiles are fitted one by one. The outputs of all other actions stay what
    they were, bit for bit.

    Args:
        policy: Of DQN, QRDQN or OptionDQN.
        action: The option, open.
        n_primitive: Number of primitive actions.
        lessons: At least one.
    """
    online, target = heads.networks(policy)
    layers = heads.option_outputs(policy)
    prior = heads.mean_of_heads(policy, n_primitive)
    design = [_inputs(network, lessons.observations) for network in (online, target)]
    following = _inputs(target, lessons.next_observations)
    layer, outputs = layers[1]
    values = layer(following[:, :-1].to(layer.weight.dtype)).reshape(len(following), outputs, -1).double()
    values = values.masked_fill(~lessons.next_allowed[:, None, :], -torch.inf)
    values[:, :, action] = -torch.inf  # not known yet; where the option ends, something else follows
    best = values.mean(dim=1).argmax(dim=1)
    ends = values[torch.arange(len(values)), :, best]  # (n, outputs)
    rewards, discounts = lessons.rewards.double(), lessons.discounts.double()
    goes_on, weights = lessons.goes_on.double(), lessons.weights.double()
    fit = [_Ridge(x, weights, p) for x, p in zip(design, prior, strict=True)]

    low, high = _bounds(rewards, discounts, ends)
    targets = rewards + discounts * ends
    for _ in range(SWEEPS):
        going_on = (following @ fit[1].solve(targets)).clamp(low, high)
        before, targets = targets, rewards + discounts * ((1 - goes_on) * ends + goes_on * going_on)
        if (targets - before).abs().max() <= TOLERANCE * (targets.std(correction=0) + 1e-8):
            break
    for (layer, outputs), solved in zip(layers, (fit[0].solve(targets), fit[1].solve(targets)), strict=True):
        rows = heads.rows_of(layer, outputs, action)
        layer.weight[rows] = solved[:-1].T.to(layer.weight.dtype)
        layer.bias[rows] = solved[-1].to(layer.bias.dtype)


def _bounds(rewards: torch.Tensor, discounts: torch.Tensor, ends: torch.Tensor) -> tuple[float, float]:
    """What no run of `SWEEPS` steps can be worth less or more than: with a bootstrap, a linear fit could diverge."""
    goes_on = discounts[:, 0] > 0
    last = torch.cat([ends[goes_on].flatten(), rewards[~goes_on].flatten(), rewards.new_zeros(1)])
    way = torch.cat([rewards[goes_on].flatten(), rewards.new_zeros(1)])
    gamma = float(discounts.max())
    steps = sum(gamma**i for i in range(SWEEPS))
    return float(last.min() + steps * way.min()), float(last.max() + steps * way.max())


class _Ridge:
    """Weighted ridge regression around a prior, factored once for many right-hand sides."""

    def __init__(self, inputs: torch.Tensor, weights: torch.Tensor, prior: torch.Tensor) -> None:
        self.inputs, self.weighted, self.prior = inputs, inputs * weights, prior
        gram = inputs.T @ self.weighted
        ridge = RIDGE * gram.diagonal().mean() + torch.finfo(gram.dtype).eps
        self._factor = torch.linalg.cholesky(gram + ridge * torch.eye(len(gram), dtype=gram.dtype, device=gram.device))

    def solve(self, targets: torch.Tensor) -> torch.Tensor:
        """The head nearest to ``targets``, (inputs + 1, outputs)."""
        residual = self.weighted.T @ (targets - self.inputs @ self.prior)
        return self.prior + torch.cholesky_solve(residual, self._factor)


def _inputs(network: Any, observations: Any) -> torch.Tensor:
    """What the last layer of a network sees, and a one for its bias, float64, (n, inputs + 1)."""
    body = heads.body_of(network)
    n = batch_size(observations)
    chunks = [take(observations, slice(start, start + CHUNK)) for start in range(0, n, CHUNK)]
    latent = torch.cat([body(network.extract_features(c, network.features_extractor)).double() for c in chunks])
    return torch.cat([latent, torch.ones(len(latent), 1, dtype=latent.dtype, device=latent.device)], dim=1)
