"""Policies π of discovered options: greedy in a value function, stored as plain arrays."""

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from sb3_options.density.arrays import row_keys
from sb3_options.experience.observations import FloatArray, IntArray, Observations, flatten
from sb3_options.options.settings import PolicyInput as PolicyInput
from sb3_options.state import storable


@storable
class TabularPolicy:
    """Greedy in a table of action values (m, n_primitive) of known observations as flat rows (m, size).

    An observation that is not in the table takes the action of the nearest one in it. Untried actions have −∞.
    """

    STATE = ("states", "values")

    def __init__(self, states: FloatArray, values: FloatArray) -> None:
        self.states = states + 0.0  # -0.0 and 0.0 are one state, but not one key
        self.values = values
        self._greedy: IntArray = values.argmax(axis=1)
        self._row_of = {key: i for i, key in enumerate(row_keys(self.states))}

    def actions(self, observations: Observations) -> IntArray:
        """Return the greedy primitive action in each observation, shape (batch,)."""
        return self._greedy[self._rows(observations)]

    def best_values(self, observations: Observations) -> FloatArray:
        """Return the value of that action, shape (batch,)."""
        return np.asarray(self.values.max(axis=1)[self._rows(observations)])

    def _rows(self, observations: Observations) -> IntArray:
        """Return the row of each observation, or of the nearest one in the table, shape (batch,)."""
        rows = flatten(observations) + 0.0
        keys = row_keys(rows) if len(rows) > 1 else [row.tobytes() for row in rows]
        known = np.array([self._row_of.get(key, -1) for key in keys], dtype=np.int64)
        new = np.flatnonzero(known < 0)
        if len(new) == 1:
            known[new] = self._nearest(rows[new[0]])
        elif len(new):
            # A batch from a replay buffer holds the same observation many times.
            distinct, which = np.unique(rows[new], axis=0, return_inverse=True)
            known[new] = np.array([self._nearest(row) for row in distinct])[which.ravel()]
        return known

    def rows_for(self, observations: Observations) -> tuple[IntArray, FloatArray, FloatArray]:
        """Extend the table by distinct observations: return their rows (n,), and copies of states and values."""
        flat = flatten(observations) + 0.0
        rows = np.array([self._row_of.get(key, -1) for key in row_keys(flat)], dtype=np.int64)
        new = np.flatnonzero(rows < 0)
        rows[new] = len(self.states) + np.arange(len(new))
        empty = np.full((len(new), self.values.shape[1]), -np.inf)
        return rows, np.concatenate([self.states, flat[new]]), np.concatenate([self.values, empty])

    def _nearest(self, row: FloatArray) -> int:
        from scipy.spatial.distance import cdist  # here, because it takes a third of a second to import

        return int(cdist(row[None], self.states).argmin())

    def arrays(self) -> dict[str, npt.NDArray[np.float64]]:
        """Return all arrays of the policy, by name."""
        return {"table_states": self.states, "table_values": self.values}


@storable
class NetworkPolicy:
    """Greedy in a small network of action values, with ReLU between its layers, for observations that do not repeat.

    The forward pass uses numpy: for one observation it is several times faster than torch.
    """

    STATE = ("mean", "std", "weights", "biases")

    def __init__(self, mean: FloatArray, std: FloatArray, weights: list[FloatArray], biases: list[FloatArray]) -> None:
        self.mean = mean
        self.std = std
        self.weights = weights
        self.biases = biases

    def actions(self, observations: Observations) -> IntArray:
        """Return the greedy primitive action in each observation, shape (batch,)."""
        hidden = (flatten(observations) - self.mean) / self.std
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = np.maximum(hidden @ weight + bias, 0.0)
        return np.asarray((hidden @ self.weights[-1] + self.biases[-1]).argmax(axis=1))

    def arrays(self) -> dict[str, npt.NDArray[np.float64]]:
        """Return all arrays of the policy, by name."""
        layers = {f"network_weight_{i}": w for i, w in enumerate(self.weights)}
        layers |= {f"network_bias_{i}": b for i, b in enumerate(self.biases)}
        return {"network_mean": self.mean, "network_std": self.std, **layers}


OptionPolicy: TypeAlias = TabularPolicy | NetworkPolicy
"""Policy of a `SubgoalOption`; its "observations" are features if it acts on those."""


def from_arrays(
    arrays: dict[str, npt.NDArray[np.float64]], observation_size: int | None, n_primitive: int
) -> OptionPolicy:
    """Return the policy of ``arrays``, for observations of any size if ``observation_size`` is None."""
    numbers = "some" if observation_size is None else observation_size
    expected = f"expected {numbers} numbers an observation and {n_primitive} primitive actions, all finite"
    if "table_states" in arrays:
        states, values = arrays["table_states"], arrays["table_values"]
        fits = states.ndim == 2 and len(states) > 0 and observation_size in (None, states.shape[1])
        fits = fits and values.shape == (len(states), n_primitive)
        if not (fits and np.isfinite(states).all() and np.isfinite(values.max(axis=1)).all()):
            raise ValueError(
                f"its table has observations of shape {states.shape} and values of shape {values.shape}, {expected}"
            )
        return TabularPolicy(states, values)
    n_layers = sum(name.startswith("network_weight_") for name in arrays)
    weights = [arrays[f"network_weight_{i}"] for i in range(n_layers)]
    biases = [arrays[f"network_bias_{i}"] for i in range(n_layers)]
    mean, std = arrays["network_mean"], arrays["network_std"]
    n_inputs = mean.size if observation_size is None else observation_size
    sizes = [n_inputs, *(b.shape[0] if b.ndim == 1 else -1 for b in biases)]
    fits = n_layers > 0 and mean.shape == std.shape == (n_inputs,) and sizes[-1] == n_primitive
    if not (fits and all(w.shape == (sizes[i], sizes[i + 1]) for i, w in enumerate(weights))):
        raise ValueError(f"its network maps {mean.size} numbers to {sizes[-1]} actions with layers {sizes}, {expected}")
    return NetworkPolicy(mean, std, weights, biases)
