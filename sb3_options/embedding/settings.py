"""Settings of learned feature maps."""

from typing import Annotated, Literal, TypeAlias

from sb3_options.checked import Field, settings

MapName: TypeAlias = Literal["temporal-distance"]  # feature maps that can be learned

LEARNED: MapName = "temporal-distance"
"""Name of the learned feature map."""

SIZE = 8  # dimensions d of its concept space, enough for the distances of rooms


@settings
class EmbeddingSettings:
    """How a feature map is learned (`learner.FeatureLearner`).

    Attributes:
        updates: Gradient steps of the first training. Each later training has half as many.
        batch_size: Pairs of observations in a gradient step.
        learning_rate: Adam's initial learning rate. It falls linearly to 0.
        horizon: Mean number of primitive steps between the observations of a pair; they are geometrically
            distributed, with γ = 1 − 1/horizon.
    """

    updates: Annotated[int, Field(ge=1)] = 500
    batch_size: Annotated[int, Field(ge=2)] = 256
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 5e-3
    horizon: Annotated[float, Field(gt=1, allow_inf_nan=False)] = 10.0
