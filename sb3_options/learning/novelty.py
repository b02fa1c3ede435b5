"""Novelty of observations over the whole training: state counts, random network distillation, and their scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn
from torch.nn import functional

from sb3_options.density.arrays import short_key
from sb3_options.experience import observations as obs_batch
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray, Observations

NoveltyKind: TypeAlias = Literal["counts", "rnd", "noveld", "e3b"]
"""How novelty is measured: by `StateCounts`, `RandomNetworkDistillation`, `NovelD` or `EllipticalBonus`."""

CLIP = 5.0  # normalised observations are clipped to ± this (Burda et al. 2018, §2.4)
SMALLEST = 1e-8  # added to variances before dividing by their root
BINS = 20.0  #: Number of bins from the lowest to the highest value of a bounded number in a flat observation.
LARGEST_SPAN = 1e6  # a wider range than this (the largest float, say) is no bound
N_FEATURES = 64  # numbers that the random network makes of an observation
HIDDEN = 128  # units of a hidden layer; the predictor has one more such layer
LEARNING_RATE = 1e-3  # of Adam
BATCH = 64  # bonuses are computed, and networks take a gradient step, for at least this many primitive steps


class Steps(NamedTuple):
    """Primitive steps of several environments, those of each in order of time.

    Attributes:
        before: Observations acted in, (n, ...).
        actions: Primitive actions, (n,).
        after: Observations arrived in, (n, ...).
        envs: Numbers of the environments, (n,).
        begins: Whether the step is the first of its episode, (n,).
    """

    before: Observations
    actions: IntArray
    after: Observations
    envs: IntArray
    begins: BoolArray

    @classmethod
    def joined(cls, parts: Sequence[Steps]) -> Steps:
        """Return all steps, one part after the other."""
        before, actions, after, envs, begins = zip(*parts, strict=True)
        joined = np.concatenate
        together = obs_batch.concatenate
        return cls(together(before), joined(actions), together(after), joined(envs), joined(begins))


class StateCounts:
    """Counts visits N(s), of all environments together, and gives 1 / √N(s) (Strehl & Littman 2008; MBIE-EB).

    Observations are counted by features (batch, d). Those with equal bins of these widths, a number or (d,), are one
    state.
    """

    STATE = ("visits",)

    def __init__(self, features: obs_batch.FeatureMap, widths: float | FloatArray = 1.0) -> None:
        self.features = features
        self.widths = widths
        self.visits: dict[bytes, int] = {}

    def keys(self, observations: Observations) -> list[bytes]:
        """Return the state that each observation of a batch counts as."""
        rows = np.asarray(self.features(observations), dtype=np.float64)
        if not np.isfinite(rows).all():
            raise ValueError("The feature map of the bonus gave NaN or infinite features.")
        return [short_key(row.tobytes()) for row in np.rint(rows / self.widths).astype(np.int64)]

    def bonuses(self, steps: Steps) -> FloatArray:
        """Count each observation arrived in and return 1 / √N, (n,): 1 the first time. All duplicates count."""
        counts = np.empty(len(steps.actions))
        for i, key in enumerate(self.keys(steps.after)):
            counts[i] = self.visits[key] = self.visits.get(key, 0) + 1
        return 1.0 / np.sqrt(counts)

    def records(self) -> dict[str, float]:
        """Return the number of distinct visited states."""
        return {"states": float(len(self.visits))}


def is_table_like(space: spaces.Space[Any]) -> bool:
    """Return whether all parts of observations are whole numbers, so each can be counted as it is."""
    if isinstance(space, spaces.Dict):
        return all(is_table_like(part) for part in space.spaces.values())
    return space.dtype is not None and np.issubdtype(space.dtype, np.integer)


def bin_widths(space: spaces.Box) -> FloatArray:
    """Return bin widths of a flat observation, (d,): the range of each number over `BINS`, or 1 without a range."""
    spans = space.high.ravel().astype(np.float64) - space.low.ravel()
    return np.where(np.isfinite(spans) & (spans > 0.0) & (spans < LARGEST_SPAN), spans / BINS, 1.0)


class NetworkNovelty:
    """Networks on flat observations that learn from each visited one once; the rest is up to the subclass.

    Flat observations are normalised by their running mean and standard deviation, and clipped (Burda et al. 2018).
    """

    STATE: tuple[str, ...] = ("statistics", "loss", "_optimizer", "_n_learned", "_gradients")

    def __init__(self, size: int, trained: nn.Module) -> None:
        self.statistics = RunningMeanStd(shape=(size,))
        self.loss = math.nan
        self._trained = list(trained.parameters())
        self._optimizer = torch.optim.Adam(self._trained, lr=LEARNING_RATE, fused=True)
        self._n_learned = 0  # observations that the gradients are of

    def records(self) -> dict[str, float]:
        """Return the last loss, or nothing before the first."""
        return {} if math.isnan(self.loss) else {"loss": self.loss}

    def normalized(self, rows: FloatArray) -> torch.Tensor:
        """Return flat observations as the networks see them, (batch, d)."""
        scaled = (rows - self.statistics.mean) / np.sqrt(self.statistics.var + SMALLEST)
        return torch.as_tensor(np.clip(scaled, -CLIP, CLIP), dtype=torch.float32)

    @property
    def _gradients(self) -> list[torch.Tensor | None]:
        """Gradients of the observations since the last gradient step."""
        return [parameter.grad for parameter in self._trained]

    @_gradients.setter
    def _gradients(self, gradients: list[torch.Tensor | None]) -> None:
        for parameter, gradient in zip(self._trained, gradients, strict=True):
            parameter.grad = gradient

    def learn(self, losses: torch.Tensor) -> None:
        """Add the gradients of the losses of observations, (n,), and take a step once they are of ``BATCH`` or more."""
        (losses.sum() / BATCH).backward()  # type: ignore[no-untyped-call]  # torch ships no annotation for it
        self.loss = float(losses.detach().mean())
        self._n_learned += len(losses)
        if self._n_learned >= BATCH:
            self._optimizer.step()
            self._optimizer.zero_grad()
            self._n_learned = 0


class RandomNetworkDistillation(NetworkNovelty):
    """Prediction error of a network for the output of a random network (Burda et al. 2018, §2.2).

    The error is the mean of squares over the random network's outputs. Each visited observation is learned from once,
    as in the paper (4 epochs of a quarter of the batch).
    """

    STATE: tuple[str, ...] = ("target", "predictor")

    def __init__(self, size: int, seed: int = 0) -> None:
        with torch.random.fork_rng(devices=[]):  # the bonus must not change the model's own draws
            torch.manual_seed(seed)
            self.target = network(size, N_FEATURES, n_hidden=1).requires_grad_(requires_grad=False)
            self.predictor = network(size, N_FEATURES, n_hidden=2)
        super().__init__(size, self.predictor)

    def bonuses(self, steps: Steps) -> FloatArray:
        """Return the error for the observations arrived in, before the predictor learns from them, (n,)."""
        rows = obs_batch.flatten(steps.after)
        self.statistics.update(rows)
        errors = self.errors(self.normalized(rows))
        self.learn(errors)
        return as_array(errors)

    def errors(self, normalized: torch.Tensor) -> torch.Tensor:
        """Return the predictor's error for normalised observations, (batch,)."""
        return functional.mse_loss(self.predictor(normalized), self.target(normalized), reduction="none").mean(dim=1)


def as_array(tensor: torch.Tensor) -> FloatArray:
    """Return the numbers of a tensor, without its gradient."""
    return tensor.detach().numpy().astype(np.float64)


def network(size: int, n_outputs: int, *, n_hidden: int) -> nn.Sequential:
    """Return a network with hidden layers of ``HIDDEN`` units and orthogonal weights."""
    layers = nn.Sequential(*create_mlp(size, n_outputs, [HIDDEN] * n_hidden))
    return layers.apply(partial(BasePolicy.init_weights, gain=math.sqrt(2.0)))


class ReturnScale:
    """The running standard deviation of the intrinsic return, which divides bonuses (Burda et al. 2018, §2.4).

    The return is Gₜ = γ Gₜ₋₁ + bₜ over the primitive steps of each environment, across the ends of episodes.
    """

    STATE = ("returns", "statistics")

    def __init__(self, gamma: float, n_envs: int) -> None:
        self.gamma = gamma
        self.returns = np.zeros(n_envs)
        self.statistics = RunningMeanStd(shape=())

    def update(self, bonuses: Sequence[FloatArray]) -> None:
        """Add primitive steps with the bonuses of each environment, (k,) each."""
        passed = []
        for env, of_env in enumerate(bonuses):
            for bonus in of_env:
                self.returns[env] = self.gamma * self.returns[env] + bonus
                passed.append(self.returns[env])
        self.statistics.update(np.array(passed))

    @property
    def std(self) -> float:
        """The standard deviation so far."""
        return float(np.sqrt(self.statistics.var + SMALLEST))
