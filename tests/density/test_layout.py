"""Memory that evaluations share."""

import torch

from sb3_options.density.bags import Bags
from sb3_options.density.layout import Workspace


def test_ids_of_a_copy_are_not_believed() -> None:
    """After a copy the keys are ids of other objects: arrays of another segment's size must not be handed out."""
    small = Bags.pack([[[0.0]]]).segments[0]
    large = Bags.pack([[[0.0], [1.0], [2.0]], [[5.0], [6.0]]]).segments[0]
    workspace, like = Workspace(), torch.zeros(1, dtype=torch.float64)
    shapes = [workspace.take(segment, 4, like).p.shape for segment in (small, large)]
    workspace._views = dict(zip(workspace._views, reversed(workspace._views.values()), strict=True))
    assert [workspace.take(segment, 4, like).p.shape for segment in (small, large)] == shapes
    assert shapes[0] != shapes[1]
