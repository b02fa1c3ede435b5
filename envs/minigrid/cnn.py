"""`MiniGridCNN`: convolutions over the cells in view, for the vectors of `MiniGridWrapper`."""

from __future__ import annotations

from math import isqrt
from typing import Any

import gymnasium as gym
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_options.envs.minigrid.cells import DEPTH


class MiniGridCNN(BaseFeaturesExtractor):
    """Reads the cells of a vector of `MiniGridWrapper` as a picture, and its words of the mission as they are.

    The convolutions are those of rl-starter-files: 16, 32 and 64 channels of 2 by 2 cells. Pass it as
    ``policy_kwargs={"features_extractor_class": MiniGridCNN}`` to a model with an ``MlpPolicy``.

    Args:
        observation_space: Of the wrapper, (v·v·21 + words,).

    Raises:
        ValueError: Observations are shorter than a view of 7 by 7 cells.
    """

    def __init__(self, observation_space: gym.Space[Any]) -> None:
        (length,) = observation_space.shape or (0,)
        view = isqrt(length // DEPTH)
        view -= 1 - view % 2  # views are odd, and words fewer than the cells of a larger one
        if view < 7:
            raise ValueError(f"MiniGridCNN needs the vectors of a MiniGridWrapper, 1029 numbers or more, got {length}.")
        side, n_cells = (view - 1) // 2 - 2, view * view * DEPTH
        super().__init__(observation_space, 64 * side * side + length - n_cells)
        self.view, self.n_cells = view, n_cells
        self.cnn = nn.Sequential(
            nn.Conv2d(DEPTH, 16, 2), nn.ReLU(), nn.MaxPool2d(2), nn.Conv2d(16, 32, 2), nn.ReLU(), nn.Conv2d(32, 64, 2),
            nn.ReLU(), nn.Flatten(),
        )  # fmt: skip

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Features (batch, n) of observations (batch, v·v·21 + words)."""
        cells, words = observations[:, : self.n_cells], observations[:, self.n_cells :]
        picture = cells.reshape(-1, self.view, self.view, DEPTH).permute(0, 3, 1, 2)
        return torch.cat([self.cnn(picture), words], dim=1)
