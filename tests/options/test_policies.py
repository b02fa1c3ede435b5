from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

from sb3_options.options.policies import NetworkPolicy, OptionPolicy, TabularPolicy, from_arrays

STATES = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 5.0]])
VALUES = np.array([[1.0, 2.0, 0.0], [-np.inf, -7.0, -8.0], [-1.0, -np.inf, -1.0]])


def network(rng: np.random.Generator, sizes: list[int]) -> NetworkPolicy:
    layers = list(pairwise(sizes))
    return NetworkPolicy(
        rng.normal(size=sizes[0]),
        rng.uniform(0.5, 2.0, size=sizes[0]),
        [rng.normal(size=layer) for layer in layers],
        [rng.normal(size=n) for _, n in layers],
    )


class TestTable:
    policy = TabularPolicy(STATES, VALUES)

    def test_greedy_action_of_known_observations(self) -> None:
        assert self.policy.actions(STATES[[2, 0, 1, 0]]).tolist() == [0, 1, 1, 1]

    def test_unknown_observations_take_the_nearest_known(self) -> None:
        observations = np.array([[0.9, 0.3], [0.0, 4.0], [0.0, 0.0], [-50.0, 2.0]])
        assert self.policy.actions(observations).tolist() == [1, 0, 1, 1]

    def test_minus_zero_is_zero(self) -> None:
        policy = TabularPolicy(np.array([[1e-300], [-0.0]]), np.array([[1.0, 0.0], [0.0, 1.0]]))
        assert policy.actions(np.array([[0.0], [-0.0]])).tolist() == [1, 1]

    def test_an_action_never_tried_is_never_taken(self) -> None:
        policy = TabularPolicy(np.array([[0.0]]), np.array([[-np.inf, -1e6]]))
        assert policy.actions(np.array([[0.0], [9.0]])).tolist() == [1, 1]


class TestNetwork:
    def test_forward_pass_is_that_of_torch(self, rng: np.random.Generator) -> None:
        policy = network(rng, [4, 8, 8, 3])
        x = rng.normal(size=(200, 4))
        hidden = torch.as_tensor((x - policy.mean) / policy.std)
        for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
            hidden = hidden @ torch.as_tensor(weight) + torch.as_tensor(bias)
            hidden = torch.relu(hidden) if i < 2 else hidden
        expected = hidden.argmax(dim=1).numpy()
        assert len(np.unique(expected)) > 1
        np.testing.assert_array_equal(policy.actions(x), expected)
        policy.biases.pop(1)
        with pytest.raises(ValueError, match="shorter than"):  # a layer without a bias
            policy.actions(x)


@pytest.mark.parametrize("kind", ["table", "network", "linear"])
def test_arrays_there_and_back(kind: str, rng: np.random.Generator) -> None:
    policy: OptionPolicy = (
        TabularPolicy(rng.normal(size=(20, 2)), rng.normal(size=(20, 3)))
        if kind == "table"
        else network(rng, [2, 3] if kind == "linear" else [2, 16, 16, 3])
    )
    back = from_arrays(policy.arrays(), 2, 3)
    observations = rng.normal(size=(1000, 2))
    actions = policy.actions(observations)
    assert type(back) is type(policy)
    assert len(np.unique(actions)) > 1
    np.testing.assert_array_equal(back.actions(observations), actions)


TABLE: dict[str, Any] = {"table_states": STATES, "table_values": VALUES}
NETWORK: dict[str, Any] = network(np.random.default_rng(0), [2, 4, 3]).arrays()


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({**TABLE, "table_states": np.zeros((3, 3))}, r"observations of shape \(3, 3\).*expected 2 numbers an obs"),
        ({**TABLE, "table_values": np.zeros((3, 4))}, r"values of shape \(3, 4\).*and 3 primitive actions"),
        ({**TABLE, "table_values": np.zeros((2, 3))}, r"values of shape \(2, 3\)"),
        ({**TABLE, "table_values": np.zeros(3)}, r"values of shape \(3,\)"),
        ({**TABLE, "table_values": np.full_like(VALUES, np.nan)}, "all finite"),
        ({**TABLE, "table_values": np.full_like(VALUES, -np.inf)}, "all finite"),
        ({**TABLE, "table_states": np.full_like(STATES, np.inf)}, "all finite"),
        ({"table_states": np.zeros((0, 2)), "table_values": np.zeros((0, 3))}, r"observations of shape \(0, 2\)"),
        ({**NETWORK, "network_mean": np.zeros(3)}, r"its network maps 3 numbers to 3 actions with layers \[2, 4, 3\]"),
        ({**NETWORK, "network_std": np.zeros((2, 1))}, r"its network maps 2 numbers"),
        ({**NETWORK, "network_weight_0": np.zeros((2, 5))}, r"its network maps"),
        ({**NETWORK, "network_weight_1": np.zeros(3)}, r"its network maps"),
        (
            {**NETWORK, "network_bias_1": np.zeros(4)},
            r"to 4 actions with layers \[2, 4, 4\], expected 2 numbers an observation",
        ),
        ({**NETWORK, "network_bias_0": np.zeros((4, 1))}, r"layers \[2, -1, 3\]"),
    ],
)
def test_arrays_that_do_not_fit(arrays: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        from_arrays(arrays, 2, 3)
