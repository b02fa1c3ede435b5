"""`FeatureLearner`: learns a feature map from saved trajectories, repeatedly as their number grows.

The objective is a contrastive temporal distance: the time from one observation to another, as a Euclidean distance.
Jiang et al. (2025), *Episodic Novelty Through Temporal Distance*, learn the successor distance of Myers et al. (2024),
d(x, y) = log p(y | y) − log p(y | x), with p the discounted distribution of future states. Their energy is
c(y) − d(x, y), where d is the quasimetric of Liu et al. (2023), *Metric Residual Networks*: an asymmetric part, plus
‖φ(x) − φ(y)‖. Here d is the second part alone, because diverse density, radii and static filters measure distances
without direction. So the difference between there and back is lost.

Gradient steps on pictures are slow. So they are spread over training, some of them every 500 primitive steps.
Their number follows from nominal seconds, so that one seed gives one result.
"""

import copy
import math
from collections.abc import Iterable

import numpy as np
import torch
from torch.nn import functional

from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.embedding.pairs import Replay
from sb3_options.embedding.settings import EmbeddingSettings
from sb3_options.experience.trajectories import Trajectory

FIRST_TRAJECTORIES = 8  # before the first training of the map: eight random walks visit most of two rooms
MOST_STEPS = 20_000  # maximum number of steps whose median length becomes the unit
STEPS_BETWEEN = 500  # primitive steps between two pauses for learning
PAUSE_SECONDS = 0.4  # nominal, in such a pause: in all, less than a second per thousand primitive steps
UPDATE_SECONDS = 1.5e-3  # nominal seconds of a gradient step, measured on one core
NUMBER_SECONDS = 8e-9  # and of each number in its observations
SOFT = 1e-4  # added under the root, whose slope at 0 is infinite; exceeds the rounding of the matrix product


class FeatureLearner:
    """Learns a `LearnedMap`, and scales it so that primitive steps that move have a median length of 1.

    Discovery measures radii, static filters and peaks in steps, so the learned space must do so too.
    """

    STATE = ("map", "n_trajectories", "done", "_encoder", "_optimizer", "_generator", "_goes_on_at")

    def __init__(self, feature_map: LearnedMap, settings: EmbeddingSettings, seed: int = 0) -> None:
        self.map = feature_map
        self.settings = settings
        self._encoder = copy.deepcopy(feature_map.encoder)  # the map stays unchanged until this copy is trained
        self._generator = torch.Generator().manual_seed(seed)
        self._optimizer = torch.optim.Adam(self._encoder.parameters(), lr=settings.learning_rate)
        self.n_trajectories = 0  # at the last training of the map
        self.done = 0  # gradient steps of the training in progress
        self._goes_on_at = 0  # primitive steps

    @property
    def updates(self) -> int:
        """Gradient steps of one training: half as many if the map was trained before."""
        return math.ceil(self.settings.updates / (2 if self.map.learned else 1))

    def is_due(self, n_trajectories: int, n_steps: int) -> bool:
        """Whether to start or continue learning after this many trajectories and primitive steps.

        Learning begins at ``FIRST_TRAJECTORIES``, then at every doubling.
        """
        if self.done:
            return n_steps >= self._goes_on_at
        return n_trajectories >= max(FIRST_TRAJECTORIES, 2 * self.n_trajectories)

    def learn(self, trajectories: Iterable[Trajectory], n_trajectories: int, n_steps: int) -> bool:
        """Take gradient steps on pairs from the saved trajectories, oldest first, for ``PAUSE_SECONDS``.

        The last gradient step replaces the map, and sets its scale. ``n_trajectories`` and ``n_steps`` include
        trajectories no longer saved. If weights are not finite, the map stays unchanged.

        Returns:
            Whether the map has changed. It has not if no step leads to another observation.
        """
        replay = Replay(trajectories, self.map.encoder.form, self._generator)
        before, after = replay.steps()
        if len(before) == 0:
            return False
        if not self.done:
            self._encoder.load_state_dict(self.map.encoder.state_dict())
            if not self.map.learned:
                self._encoder.standardise_by(replay.observations)
        # A gradient step encodes both observations of each pair.
        n_numbers = min(2 * self.settings.batch_size, len(replay)) * math.prod(self.map.encoder.form.shape)
        at_once = int(PAUSE_SECONDS / (UPDATE_SECONDS + NUMBER_SECONDS * n_numbers))
        end = min(self.updates, self.done + max(1, at_once))
        for i in range(self.done, end):
            for group in self._optimizer.param_groups:
                group["lr"] = self.settings.learning_rate * (1.0 - i / self.updates)
            self._update(replay)
        self.done = end
        self._goes_on_at = n_steps + STEPS_BETWEEN
        if end < self.updates:
            return False
        self.done = 0
        self.n_trajectories = n_trajectories
        if not all(weight.isfinite().all() for weight in self._encoder.parameters()):
            self._optimizer.state.clear()
            raise ValueError(
                f"the learned feature map diverged and stays as it was: try a lower learning_rate than "
                f"{self.settings.learning_rate:g} (EmbeddingSettings)"
            )
        self.map.encoder.load_state_dict(self._encoder.state_dict())
        self.map.scale = np.ones(self.map.size)  # in which the length is measured
        self.map.scale /= self._step_length(replay, before, after)
        self.map.learned += 1
        return True

    def _update(self, replay: Replay) -> None:
        s = self.settings
        rows = replay.sample(s.batch_size, s.horizon, self._generator)
        loss = contrastive_loss(*replay.encoded(self._encoder, *rows))
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]  # torch ships no annotation for it
        self._optimizer.step()

    def _step_length(self, replay: Replay, before: torch.Tensor, after: torch.Tensor) -> float:
        """Return the median distance between the observations of steps that move."""
        chosen = torch.randint(len(before), (min(len(before), MOST_STEPS),), generator=self._generator)
        rows, which = torch.unique(torch.cat([before[chosen], after[chosen]]), return_inverse=True)
        one, other = np.split(self.map.of_tensor(replay.observations[rows])[which.numpy()], 2)
        median = float(np.median(np.linalg.norm(one - other, axis=1)))
        return median if median > 0.0 else 1.0


def energies(began: torch.Tensor, led: torch.Tensor) -> torch.Tensor:
    """Return c(yⱼ) − ‖φ(xᵢ) − φ(yⱼ)‖ of all pairs, (n, n), from encoded x and y, (n, d + 1): φ, then c."""
    x, y = began[:, :-1], led[:, :-1]
    squares = x.square().sum(dim=1)[:, None] + y.square().sum(dim=1) - 2.0 * x @ y.T
    return led[:, -1] - torch.sqrt(squares.clamp(min=0.0) + SOFT)


def contrastive_loss(began: torch.Tensor, led: torch.Tensor) -> torch.Tensor:
    """Return symmetric InfoNCE: which y followed which x, and vice versa (Jiang et al. 2025)."""
    logits = energies(began, led)
    same = torch.arange(len(logits))
    return 0.5 * (functional.cross_entropy(logits, same) + functional.cross_entropy(logits.T, same))
