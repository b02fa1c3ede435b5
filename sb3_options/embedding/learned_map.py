"""`LearnedMap`: a feature map that is data, and can be trained further while in use."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from sb3_options.embedding.encoders import Encoder, ObservationForm, as_tensor
from sb3_options.embedding.settings import LEARNED, SIZE
from sb3_options.experience.observations import FloatArray, Observations, batch_size

BATCH = 512  # maximum observations encoded at once, so that many images take little memory
# Of features, in steps. So an observation nearly always has the same features in every batch, although the last bits of
# matrix products depend on the batch size.
DECIMALS = 3


class LearnedMap:
    """φ(x) = scale · encoder(x), where the scale makes one unit about one step.

    Before training it is a random network, and its distances have no meaning.
    """

    STATE = ("encoder", "scale", "learned", "fixed")

    name = LEARNED
    size = SIZE

    def __init__(self, form: ObservationForm, seed: int = 0) -> None:
        with torch.random.fork_rng(devices=[]):  # leaves all other random draws unchanged
            torch.manual_seed(seed)
            # Besides φ there is a potential c, which only training needs.
            self.encoder = Encoder(form, self.size + 1)
        self.scale = np.ones(self.size)
        self.learned = 0  # completed trainings
        self.fixed = False  # True once it no longer changes, because it came with options that live in its space

    def __call__(self, observations: Observations) -> FloatArray:
        """Return φ of a batch of observations, (batch, d); NaN if they are not finite in 32 bits."""
        if batch_size(observations) == 0:
            return np.zeros((0, self.size))
        rows = as_tensor(observations, self.encoder.form)
        features = self.of_tensor(rows)
        if rows.is_floating_point():  # the network clips its input, and would hide infinity
            features[~torch.isfinite(rows).all(dim=1).numpy()] = np.nan
        return features

    def of_tensor(self, rows: torch.Tensor) -> FloatArray:
        """Return φ of observations in the layout of `as_tensor`, (n, d)."""
        with torch.no_grad():
            made = torch.cat([self.encoder(part) for part in torch.split(rows, BATCH)])[:, : self.size]
        features: FloatArray = np.round(made.numpy().astype(np.float64) * self.scale, DECIMALS) + 0.0
        return features

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays of the map, by name."""
        weights = {f"encoder.{key}": value.detach().numpy().copy() for key, value in self.encoder.state_dict().items()}
        return {**weights, "scale": self.scale.copy(), "learned": np.array(self.learned)}

    def load(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Load the map from its `arrays`."""
        expected = {name: array.shape for name, array in self.arrays().items()}
        found = {name: np.shape(array) for name, array in arrays.items()}
        if found != expected:
            differ = sorted(name for name in {*expected, *found} if expected.get(name) != found.get(name))
            raise ValueError(
                f"the learned feature map does not fit: {differ[0]} has shape {found.get(differ[0])}, expected "
                f"{expected.get(differ[0])}. Observations must be those that it was learned for, here "
                f"{self.encoder.form.kind} observations of shape {self.encoder.form.shape}"
            )
        if not all(np.isfinite(array).all() for array in arrays.values()):
            raise ValueError("the learned feature map holds numbers that are not finite")
        weights = {key: torch.as_tensor(np.array(arrays[f"encoder.{key}"])) for key in self.encoder.state_dict()}
        self.encoder.load_state_dict(weights)
        self.scale = np.array(arrays["scale"], dtype=np.float64)
        self.learned = int(arrays["learned"])
