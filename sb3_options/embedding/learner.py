"""`FeatureLearner`: learns a feature map from saved trajectories, again and again while they become more."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable

import numpy as np
import torch

from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.embedding.pairs import Replay
from sb3_options.embedding.settings import EmbeddingSettings
from sb3_options.embedding.temporal_distance import contrastive_loss
from sb3_options.experience.trajectories import Trajectory

FIRST_TRAJECTORIES = 8
"""Trajectories before the map is learned first: eight random walks visit most of two rooms."""

MOST_STEPS = 20_000
"""Steps whose median length becomes the unit."""


class FeatureLearner:
    """Learns a `LearnedMap`, and scales it so that a primitive step that moves has a median length of 1.

    Radii, static filters and peaks of discovery are in units of one step, and so the learned space has to be.

    Args:
        feature_map: What is learned.
        settings: How.
        seed: Of the draws.

    Attributes:
        loss: Of the last gradient steps, the mean; NaN before the first.
        n_trajectories: How many there had been when the map was last learned; 0 before.
    """

    STATE = ("map", "_optimizer", "_generator", "loss", "n_trajectories")

    def __init__(self, feature_map: LearnedMap, settings: EmbeddingSettings, seed: int = 0) -> None:
        self.map, self.settings = feature_map, settings
        self._generator = torch.Generator().manual_seed(seed)
        self._optimizer = torch.optim.Adam(feature_map.encoder.parameters(), lr=settings.learning_rate)
        self.loss = math.nan
        self.n_trajectories = 0

    def is_due(self, n_trajectories: int) -> bool:
        """Whether to learn, after so many trajectories: first at `FIRST_TRAJECTORIES`, then at every doubling."""
        return n_trajectories >= max(FIRST_TRAJECTORIES, 2 * self.n_trajectories)

    def can_learn(self, trajectories: Iterable[Trajectory]) -> bool:
        """Whether any step of these leads to another observation."""
        return any((t.visits[1:] != t.visits[:-1]).any() for t in trajectories)

    def learn(self, trajectories: Iterable[Trajectory], n_trajectories: int) -> None:
        """Take gradient steps on pairs of the saved trajectories, oldest first, and find the scale.

        ``n_trajectories`` counts those that are no longer saved, too. After steps that led to numbers that are not
        finite the map is as it was.
        """
        replay = Replay(trajectories, self.map.encoder.form)
        before, after = replay.steps()
        if len(before) == 0:
            raise ValueError("a feature map can be learned only where a step leads to another observation")
        updates = self.settings.updates
        weights = copy.deepcopy(self.map.encoder.state_dict())
        if self.map.learned == 0:
            self.map.encoder.standardise_by(replay.observations)
        else:
            updates = math.ceil(updates / 2)
        losses = []
        for i in range(updates):
            for group in self._optimizer.param_groups:
                group["lr"] = self.settings.learning_rate * (1.0 - i / updates)
            losses.append(self._update(replay))
        self.n_trajectories = n_trajectories
        if not all(weight.isfinite().all() for weight in self.map.encoder.parameters()):
            self.map.encoder.load_state_dict(weights)
            self._optimizer.state.clear()
            raise ValueError(
                f"the learned feature map diverged and stays as it was: try a lower learning_rate than "
                f"{self.settings.learning_rate:g} (EmbeddingSettings)"
            )
        self.loss = float(np.mean(losses[-100:]))
        self.map.scale = np.ones(self.map.size)
        self.map.scale /= self._step_length(replay, before, after)
        self.map.learned += 1

    def _update(self, replay: Replay) -> float:
        s = self.settings
        rows = replay.sample(s.batch_size, s.horizon, self._generator)
        loss = contrastive_loss(*replay.encoded(self.map.encoder, *rows))
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]  # torch ships no annotation for it
        self._optimizer.step()
        return loss.item()

    def _step_length(self, replay: Replay, before: torch.Tensor, after: torch.Tensor) -> float:
        """The median distance between the observations of steps that move."""
        chosen = torch.randint(len(before), (min(len(before), MOST_STEPS),), generator=self._generator)
        rows, which = torch.unique(torch.cat([before[chosen], after[chosen]]), return_inverse=True)
        one, other = np.split(self.map.of_tensor(replay.observations[rows])[which.numpy()], 2)
        median = float(np.median(np.linalg.norm(one - other, axis=1)))
        return median if median > 0.0 else 1.0
