"""Intra-option targets of DQN, OptionDQN and QRDQN against a table; which rows of a batch update which options."""

import pickle
from typing import Any

import numpy as np
import pytest
import torch
from sb3_contrib import QRDQN
from sb3_contrib.qrdqn import qrdqn as qrdqn_module
from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import VecNormalize
from torch.nn import functional

from sb3_options import OptionDQN, OptionReplayBuffer
from sb3_options.callbacks.installer import OptionInstaller
from sb3_options.callbacks.intra_option import IntraOptionUpdater
from sb3_options.learning.intra_option import Consistency, ConsistencyTable, consistency_of, intra_option_target
from sb3_options.learning.replay_buffer import QUANTILE_SHARE
from tests.learning.tables import (
    GAMMA,
    N_ACTIONS,
    N_PRIMITIVE,
    N_QUANTILES,
    N_STATES,
    Task,
    available_in,
    filled,
    random_task,
    rows_lived_through,
    tables,
    target_of,
    train_on_all_rows,
)
from tests.support.helpers import table_option
from tests.support.sb3_helpers import RANDOM, TINY, Row, env_of, fast_callback, optioned_rooms


def pairs_of(rows: list[Row], task: Task, *, outside: bool) -> list[tuple[Row, int, bool]]:
    """By the definition: which options are consistent with which rows, and whether they continue in s'."""
    pairs = []
    for row in rows:
        for slot, option in task.options.items():
            inside = option.initiation[row.state]
            if row.action < N_PRIMITIVE and option.policy[row.state] == row.action and (inside or outside):
                ahead = option.initiation[row.next_state] and not option.termination[row.next_state]
                pairs.append((row, slot, inside and ahead))
    return pairs


def installed_in(model: Any, *, intra_option: bool = True) -> OptionInstaller:
    model.replay_buffer.intra_option = intra_option
    installer = OptionInstaller(model, env_of(model), None)
    installer.on_rollout_end()
    return installer


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("algorithm", [DQN, OptionDQN])
def test_targets_are_exact(algorithm: Any, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    task = random_task(seed)
    model = filled(algorithm, task, True, monkeypatch)
    installed_in(model)
    masked = algorithm is OptionDQN
    rows = rows_lived_through(task, True)
    pairs = pairs_of(rows, task, outside=not masked)
    online, target_table = tables(model)
    predicted, target = train_on_all_rows(model, (functional, "smooth_l1_loss"), monkeypatch)

    def allowed(state: int) -> list[int]:
        return available_in(state, task.options) if masked else list(range(N_ACTIONS))

    expected = [target_of(r, target_table[r.next_state], allowed(r.next_state)) for r in rows]
    for row, slot, goes_on in pairs:
        option = N_PRIMITIVE + slot
        expected.append(target_of(row, target_table[row.next_state], [option] if goes_on else allowed(row.next_state)))
    np.testing.assert_allclose(target[:, 0], expected, rtol=0, atol=1e-6)
    updated = [online[row.state, N_PRIMITIVE + slot] for row, slot, _ in pairs]
    np.testing.assert_allclose(predicted[len(rows) :, 0], updated, rtol=0, atol=1e-6)
    assert len(pairs) > 50
    assert {(goes_on, row.terminal) for row, _, goes_on in pairs} >= {(True, False), (False, False), (False, True)}


def test_quantile_targets_are_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    task = random_task(1)
    model = filled(QRDQN, task, True, monkeypatch)
    installed_in(model)
    rows = rows_lived_through(task, True)
    quantiles = tables(model)[1].reshape(N_STATES, N_QUANTILES, N_ACTIONS)
    greedy = quantiles.mean(axis=1).argmax(axis=1)
    _, target = train_on_all_rows(model, (qrdqn_module, "quantile_huber_loss"), monkeypatch)
    buffer = model.replay_buffer
    limit = int(QUANTILE_SHARE * len(rows))
    selected = buffer.consistency.select(np.arange(len(rows)), limit)
    assert len(target) == len(rows)
    assert len(selected.rows) == limit
    for row, slot, goes_on, seen in zip(
        selected.rows, selected.slots, selected.continuation, target[len(rows) - limit :], strict=True
    ):
        lived = rows[row]
        option = task.options[int(slot)]
        ahead = option.initiation[lived.next_state] and not option.termination[lived.next_state]
        assert bool(goes_on) == (option.initiation[lived.state] and ahead)
        after = N_PRIMITIVE + slot if goes_on else greedy[lived.next_state]
        expected = lived.reward + (not lived.terminal) * GAMMA * quantiles[lived.next_state, :, after]
        np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-6)
    first = [
        r.reward + (not r.terminal) * r.discount * quantiles[r.next_state, :, greedy[r.next_state]]
        for r in rows[: len(rows) - limit]
    ]
    np.testing.assert_allclose(target[: len(first)], first, rtol=0, atol=1e-6)


def test_switched_off_a_batch_is_what_was_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    task = random_task(0)
    model = filled(DQN, task, True, monkeypatch)
    installed_in(model, intra_option=False)
    assert len(model.replay_buffer._get_samples(np.arange(50)).actions) == 50


def test_rows_of_options_are_normalised_with_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    model = filled(DQN, random_task(0), True, monkeypatch)
    installed_in(model)
    # Options that are worth nothing leave the rewards alone.
    monkeypatch.setattr(model.replay_buffer.consistency, "values", lambda _, options: torch.zeros(len(options), 1))
    normalizer = VecNormalize(env_of(model), norm_obs=False, gamma=GAMMA)
    normalizer.ret_rms.var = np.array(4.0)
    plain, normalized = (model.replay_buffer._get_samples(np.arange(50), env) for env in (None, normalizer))
    assert len(plain.rewards) > 50
    np.testing.assert_allclose(normalized.rewards, plain.rewards / 2.0, rtol=1e-6)


def test_without_options_a_batch_is_what_was_drawn() -> None:
    assert ConsistencyTable(10, 2, 0, lambda obs, options: options).select(np.arange(10), 10) is None


def test_consistency_follows_the_options_own_sets() -> None:
    option = table_option([0, 1, 1, 1], [1, 0, 1, 0], [0.0, 0.0, 0.25, 1.0])
    found = consistency_of(option, np.array([0, 1, 1, 2, 2]), np.array([1, 0, 1, 1, -1]), np.array([2, 2, 0, 3, 2]))
    assert found.consistent.tolist() == [True, True, False, True, False]
    assert found.inside.tolist() == [False, True, True, True, True]
    assert found.continuation.tolist() == [0.0, 0.75, 0.0, 0.0, 0.75]


def test_a_target_is_the_mixture_of_going_on_and_ending() -> None:
    one = torch.ones(1, 1)
    certain, discount = intra_option_target(2 * one, 0.9 * one, 0 * one, 0.75 * one, 4 * one)
    best = 8.0
    assert float(certain + discount * best) == pytest.approx(2 + 0.9 * (0.75 * 4 + 0.25 * 8))
    certain, _ = intra_option_target(2 * one, 0.9 * one, one, 0.75 * one, 4 * one)
    assert float(certain) == 2.0


class TestConsistencyTable:
    def table(self, **kwargs: Any) -> ConsistencyTable:
        table = ConsistencyTable(6, 2, 2, lambda obs, options: options[:, None].float(), **kwargs)
        inside = np.array([0, 0, 1, 1, 1, 1], dtype=bool)
        table.record(np.arange(6), 1, Consistency(np.ones(6, dtype=bool), inside, np.array([0, 0, 0, 1, 0.5, 1])))
        return table

    def test_rows_inside_come_first(self) -> None:
        selected = self.table().select(np.arange(6), 4)
        assert selected is not None
        assert selected.rows.tolist() == [2, 3, 4, 5]
        assert selected.slots.tolist() == [1] * 4

    def test_all_of_them_where_there_is_room(self) -> None:
        selected = self.table().select(np.array([5, 0]), 4)
        assert selected is not None
        assert selected.rows.tolist() == [5, 0]

    def test_masking_algorithms_learn_inside_only(self) -> None:
        selected = self.table(outside=False).select(np.arange(6), 6)
        assert selected is not None
        assert selected.rows.tolist() == [2, 3, 4, 5]

    def test_quantiles_learn_from_what_is_certain_only(self) -> None:
        selected = self.table(quantiles=True).select(np.arange(6), 6)
        assert selected is not None
        assert selected.rows.tolist() == [0, 1, 2, 3, 5]

    def test_what_is_overwritten_or_removed_updates_nothing(self) -> None:
        table = self.table()
        table.clear_rows(np.array([2, 3]))
        selected = table.select(np.arange(2, 6), 6)
        assert selected is not None
        assert selected.rows.tolist() == [4, 5]
        table.clear_slot(1)
        assert table.select(np.arange(6), 6) is None

    def test_values_do_not_travel(self) -> None:
        table = pickle.loads(pickle.dumps(self.table()))
        assert table.values is None
        assert table.select(np.arange(6), 6) is None


def test_new_steps_are_compared_as_the_old_ones_were(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compared in portions while training goes on, rows say the same as compared all at once at its end."""
    task = random_task(3)
    model = filled(DQN, task, True, monkeypatch)
    installer = installed_in(model)
    assert installer.updater is not None
    table, buffer = installer.updater.table, model.replay_buffer
    monkeypatch.setattr("sb3_options.callbacks.intra_option.PORTION", 40)
    obs, actions, next_obs = buffer.stored(np.s_[:200])
    info = {"option": {"index": -1, "duration": 1, "discount": GAMMA, "termination": "primitive"}}
    for i in range(200):
        add = (obs[i : i + 1], next_obs[i : i + 1], np.array([actions[i] % N_PRIMITIVE]))
        buffer.add(*add, np.zeros(1), np.zeros(1), [info])
        installer.on_rollout_end()
    in_portions = table.consistent.copy(), table.inside.copy(), table.continuation.copy()
    for slot in task.options:
        installer.updater.compare_all(slot)
    assert table.consistent[: buffer.size()].sum() > 100
    for before, after in zip(in_portions, (table.consistent, table.inside, table.continuation), strict=True):
        assert np.array_equal(before[: buffer.size()], after[: buffer.size()])


def test_an_option_that_keeps_learning_is_compared_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the buffer holds of it then follows from its latest policy."""
    monkeypatch.setattr("sb3_options.callbacks.intra_option.CHANGE_SHARE", 10**9)  # at once, and not before long
    monkeypatch.setattr("sb3_options.callbacks.intra_option.PORTION", 1)
    compared: list[int] = []
    stock = IntraOptionUpdater.compare_all

    def compare_all(updater: IntraOptionUpdater, slot: int) -> None:
        compared.append(slot)
        stock(updater, slot)

    monkeypatch.setattr(IntraOptionUpdater, "compare_all", compare_all)
    model = DQN(
        "MlpPolicy",
        optioned_rooms(2),
        gamma=GAMMA,
        replay_buffer_class=OptionReplayBuffer,
        replay_buffer_kwargs={"intra_option": True},
        **TINY | RANDOM,
    )
    callback = fast_callback(option_settings={"keep_learning": True})
    model.learn(3000, callback=callback)
    assert len(compared) > 3
    assert callback._installer is not None
    updater = callback._installer.updater
    assert updater is not None
    before = updater.table.consistent.copy(), updater.table.continuation.copy()
    stock(updater, 0)
    assert updater.table.consistent[:, 0].sum() > 100
    for old, new in zip(before, (updater.table.consistent, updater.table.continuation), strict=True):
        assert np.array_equal(old, new)
