"""`MiniGridCNN`: convolutions over the cells in view, for the vectors of `MiniGridWrapper`."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_options.envs.minigrid.cells import DEPTH

MOST_WORDS = 500  # of missions: more than any task has, and less than the next larger view adds


class MiniGridCNN(BaseFeaturesExtractor):
    """Reads the cells of a `MiniGridWrapper` vector as a picture, and passes on the words of its mission.

    The convolutions are those of rl-starter-files: 16, 32 and 64 channels of 2 by 2 cells. Pass the class as
    ``policy_kwargs={"features_extractor_class": MiniGridCNN}`` to a model with an ``MlpPolicy``.

    Args:
        observation_space: Observation space of the wrapper, (v·v·21 + words,).
        view: v, cells across the view: odd, at least 7. Values other than 7 go into ``features_extractor_kwargs``.
    """

    def __init__(self, observation_space: gym.Space[Any], view: int = 7) -> None:
        if view < 7 or view % 2 == 0:
            raise ValueError(f"MiniGridCNN needs an odd view of 7 cells or more, got {view}.")
        length = int(np.prod(observation_space.shape or (0,)))
        n_cells = view * view * DEPTH
        if not n_cells <= length <= n_cells + MOST_WORDS:
            raise ValueError(
                f"MiniGridCNN needs the vectors of a MiniGridWrapper, of {n_cells} numbers for a view of {view} by "
                f"{view} cells and some for the mission, got {length}. For another view pass policy_kwargs="
                '{"features_extractor_class": MiniGridCNN, "features_extractor_kwargs": {"view": 9}}, for a model '
                'that was saved without them load(..., custom_objects={"policy_kwargs": ...}). It reads no '
                "stacked frames (VecFrameStack)."
            )
        side = (view - 1) // 2 - 2
        super().__init__(observation_space, 64 * side * side + length - n_cells)
        self.view = view
        self.n_cells = n_cells
        self.cnn = nn.Sequential(
            nn.Conv2d(DEPTH, 16, 2), nn.ReLU(), nn.MaxPool2d(2), nn.Conv2d(16, 32, 2), nn.ReLU(), nn.Conv2d(32, 64, 2),
            nn.ReLU(), nn.Flatten(),
        )  # fmt: skip

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return features (batch, n) of observations (batch, v·v·21 + words)."""
        cells, words = observations[:, : self.n_cells], observations[:, self.n_cells :]
        picture = cells.reshape(-1, self.view, self.view, DEPTH).permute(0, 3, 1, 2)
        return torch.cat([self.cnn(picture), words], dim=1)
