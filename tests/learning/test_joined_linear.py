from typing import Any

import pytest
import torch
from torch import nn

from sb3_options.learning.joined_linear import JoinedLinear, by_action, check_optimizer, widened, widened_linear

N_FIRST, N_LATER = 5, 3


def layer_of(outputs_per_action: int = 1, n_features: int = 64) -> nn.Linear:
    torch.manual_seed(0)
    return nn.Linear(n_features, N_FIRST * outputs_per_action)


def opened(layer: JoinedLinear) -> JoinedLinear:
    """With something in its later rows."""
    with torch.no_grad():
        later = by_action(layer.weight, layer.outputs_per_action)[:, N_FIRST:]
        later.copy_(torch.randn(later.shape))
    return layer


@pytest.mark.parametrize("outputs_per_action", [1, 7])
@pytest.mark.parametrize("n_features", [3, 64, 512])
def test_first_outputs_are_bit_identical(outputs_per_action: int, n_features: int) -> None:
    layer = layer_of(outputs_per_action, n_features)
    wider = opened(widened_linear(layer, N_LATER, outputs_per_action, []))
    for batch in (1, 2, 3, 32, 64, 257):
        x = torch.randn(batch, n_features)
        before = layer(x).unflatten(-1, (outputs_per_action, -1))
        after = wider(x).unflatten(-1, (outputs_per_action, -1))
        assert torch.equal(before, after[..., :N_FIRST])
        plain = nn.functional.linear(x, wider.weight, wider.bias)
        torch.testing.assert_close(wider(x), plain, rtol=1e-5, atol=1e-5)


def test_one_observation_without_a_batch() -> None:
    wider = opened(widened_linear(layer_of(7), N_LATER, 7, []))
    x = torch.randn(64)
    assert wider(x).shape == (7 * (N_FIRST + N_LATER),)
    torch.testing.assert_close(wider(x), wider(x[None])[0])


def test_gradients_of_first_rows_are_bit_identical() -> None:
    layer = layer_of(7)
    wider = opened(widened_linear(layer, N_LATER, 7, []))
    x, weights = torch.randn(32, 64), torch.randn(32, 7, N_FIRST)
    gradients = []
    for each in (layer, wider):
        seen = x.clone().requires_grad_()
        values = each(seen).unflatten(-1, (7, -1))[..., :N_FIRST]
        (values * weights).sum().backward()
        assert each.weight.grad is not None
        assert seen.grad is not None
        gradients.append((by_action(each.weight.grad, 7), seen.grad))
    (stock, stock_x), (joined, joined_x) = gradients
    assert torch.equal(stock, joined[:, :N_FIRST])
    assert (joined[:, N_FIRST:] == 0).all()
    assert torch.equal(stock_x, joined_x)


def test_files_and_copies_see_a_linear_layer() -> None:
    wider = opened(widened_linear(layer_of(), N_LATER, 1, []))
    plain = nn.Linear(64, N_FIRST + N_LATER)
    assert list(wider.state_dict()) == list(plain.state_dict())
    plain.load_state_dict(wider.state_dict())
    again = JoinedLinear(plain, N_FIRST)
    x = torch.randn(9, 64)
    assert torch.equal(again(x), wider(x))
    assert again.weight is plain.weight
    assert "out_features=8" in repr(wider)
    assert "n_first=5" in repr(wider)


def test_rows_of_quantiles_stand_by_action() -> None:
    rows = torch.arange(6.0).reshape(6, 1)  # 2 quantiles of 3 actions
    assert widened(rows, 1, 2)[:, 0].tolist() == [0, 1, 2, 0, 3, 4, 5, 0]
    assert widened(rows, 1)[:, 0].tolist() == [0, 1, 2, 3, 4, 5, 0]


@pytest.mark.parametrize(
    ("optimizer_class", "kwargs", "keys"),
    [
        (torch.optim.Adam, {"amsgrad": True}, {"exp_avg", "exp_avg_sq", "max_exp_avg_sq"}),
        (torch.optim.RMSprop, {"momentum": 0.9, "centered": True}, {"square_avg", "grad_avg", "momentum_buffer"}),
        (torch.optim.SGD, {"momentum": 0.9}, {"momentum_buffer"}),
    ],
)
def test_moments_are_kept_for_old_rows(optimizer_class: Any, kwargs: dict[str, Any], keys: set[str]) -> None:
    network = nn.Sequential(nn.Linear(4, 8), nn.Tanh(), layer_of(2, 8))
    last: Any = network[2]
    optimizer = optimizer_class(
        [{"params": [*network[0].parameters()]}, {"params": [*last.parameters()], "lr": 0.5}], lr=0.1, **kwargs
    )
    network(torch.randn(16, 4)).pow(2).sum().backward()
    optimizer.step()
    groups, kept = [*optimizer.param_groups], dict(optimizer.state[last.weight])
    first = optimizer.state[network[0].weight]
    wider = widened_linear(last, N_LATER, 2, [optimizer])
    moments = optimizer.state[wider.weight]
    assert keys <= set(moments) == set(kept)
    for key, value in moments.items():
        if key in keys:
            rows = by_action(value, 2)
            assert torch.equal(rows[:, :N_FIRST], by_action(kept[key], 2))
            assert (kept[key] != 0).any()
            assert (rows[:, N_FIRST:] == 0).all()
        else:
            assert value == kept[key]
    assert all(a is b for a, b in zip(groups, optimizer.param_groups, strict=True))
    assert optimizer.param_groups[1]["params"][0] is wider.weight
    assert optimizer.param_groups[1]["params"][1] is wider.bias
    assert optimizer.param_groups[1]["lr"] == 0.5
    assert optimizer.state[network[0].weight] is first
    assert len(optimizer.state) == 4
    network[2] = wider
    optimizer.zero_grad()
    network(torch.randn(16, 4)).pow(2).sum().backward()
    optimizer.step()


def test_an_optimizer_that_keeps_other_shapes_is_refused() -> None:
    layer = layer_of()
    optimizer: Any = torch.optim.Adafactor(layer.parameters())
    check_optimizer(optimizer, layer)  # nothing kept yet
    layer(torch.randn(2, 64)).sum().backward()
    optimizer.step()
    with pytest.raises(TypeError, match=r"Adafactor keeps 'row_var' of shape \(5, 1\) for .* \(5, 64\).*Adam"):
        check_optimizer(optimizer, layer)


@pytest.mark.parametrize(("n_first", "outputs_per_action"), [(0, 1), (5, 1), (2, 3)])
def test_rows_that_do_not_divide_are_refused(n_first: int, outputs_per_action: int) -> None:
    with pytest.raises(ValueError, match=rf"5 outputs, {outputs_per_action} per action, cannot be joined of {n_first}"):
        JoinedLinear(layer_of(), n_first, outputs_per_action)
