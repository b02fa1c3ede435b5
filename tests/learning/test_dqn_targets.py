"""Targets of DQN, QRDQN and OptionDQN against a table."""

import numpy as np
import pytest
from sb3_contrib import QRDQN
from sb3_contrib.qrdqn import qrdqn as qrdqn_module
from stable_baselines3 import DQN
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from torch.nn import functional

from sb3_options import OptionDQN
from sb3_options.callbacks import SubgoalDiscoveryCallback
from tests.learning import tables
from tests.support.sb3_helpers import RANDOM, TINY, env_of, optioned_rooms


@pytest.mark.parametrize("macro_q", [True, False])
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("algorithm", [DQN, OptionDQN])
def test_targets_are_exact(
    algorithm: type[OffPolicyAlgorithm], seed: int, macro_q: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = tables.random_task(seed)
    model = tables.filled(algorithm, task, macro_q, monkeypatch)
    rows = tables.rows_lived_through(task, macro_q)
    online, target_table = tables.q_tables(model)
    module = (functional, "smooth_l1_loss")
    predicted, target = tables.train_on_all_rows(model, module, monkeypatch)

    every = list(range(tables.N_ACTIONS))
    masked = algorithm is OptionDQN
    among = [tables.available_in(r.next_state, task.options) if masked else every for r in rows]
    expected = [tables.target_of(r, target_table[r.next_state], a) for r, a in zip(rows, among, strict=True)]
    np.testing.assert_allclose(target[:, 0], expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(predicted[:, 0], [online[r.state, r.action] for r in rows], rtol=0, atol=1e-6)

    # Without these the comparison would say little.
    assert len(rows) > 200
    # Stock DQN chose the empty slot, and what it ran was stored.
    assert (tables.N_PRIMITIVE + 1 in task.env.chosen) != masked
    assert tables.N_PRIMITIVE + 1 not in [r.action for r in rows]
    ended = {(r.terminal, round(r.discount, 6)) for r in rows if r.action >= tables.N_PRIMITIVE}
    assert {terminal for terminal, _ in ended} == {True, False}
    assert len({discount for _, discount in ended}) >= 3
    if masked:
        unmasked = [tables.target_of(r, target_table[r.next_state], every) for r in rows]
        assert np.abs(np.subtract(unmasked, expected)).max() > 0.1


@pytest.mark.parametrize("macro_q", [True, False])
@pytest.mark.parametrize("seed", [0, 1])
def test_quantile_targets_are_exact(seed: int, macro_q: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    task = tables.random_task(seed)
    model = tables.filled(QRDQN, task, macro_q, monkeypatch)
    rows = tables.rows_lived_through(task, macro_q)
    _, target_table = tables.q_tables(model)
    quantiles = target_table.reshape(tables.N_STATES, tables.N_QUANTILES, tables.N_ACTIONS)
    _, target = tables.train_on_all_rows(model, (qrdqn_module, "quantile_huber_loss"), monkeypatch)
    greedy = quantiles.mean(axis=1).argmax(axis=1)
    for row, seen in zip(rows, target, strict=True):
        best = quantiles[row.next_state, :, greedy[row.next_state]]
        np.testing.assert_allclose(seen, row.reward + (not row.terminal) * row.discount * best, rtol=0, atol=1e-6)
    assert {round(r.discount, 6) for r in rows if r.action >= tables.N_PRIMITIVE} >= {0.9, 0.81}


def test_targets_stay_exact_for_transitions_stored_before_an_option_was_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """An option that moves in while the agent trains counts in the targets of everything lived through already."""
    model = OptionDQN("MlpPolicy", optioned_rooms(2), gamma=tables.GAMMA, **TINY | RANDOM)
    callback = SubgoalDiscoveryCallback({"min_positive": 3, "goal_radius": 3.0, "decay": 0.5}, max_new_options=1)
    checked = []
    stock_train = model.train

    def train(gradient_steps: int, batch_size: int = 100) -> None:
        buffer = model._option_buffer()
        assert env_of(model).env_method("available", buffer.next_observations_stored())[0][:, 4:].tolist() == (
            buffer.next_available[: buffer.size()].tolist()
        )
        checked.append(bool(buffer.next_available.any()))
        stock_train(gradient_steps, batch_size)

    monkeypatch.setattr(model, "train", train)
    model.learn(2500, callback=callback)
    assert callback.discoveries
    assert checked[-1]
    assert not checked[0]
