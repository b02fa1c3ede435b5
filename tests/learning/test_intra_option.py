"""Intra-option targets of DQN, OptionDQN and QRDQN against a table; what a batch teaches."""

import pickle
from typing import Any

import numpy as np
import pytest
import torch
from sb3_contrib import QRDQN
from sb3_contrib.qrdqn import qrdqn as qrdqn_module
from stable_baselines3 import DQN
from torch.nn import functional

from sb3_options import OptionDQN, OptionReplayBuffer
from sb3_options.callbacks.serving import OptionServer
from sb3_options.callbacks.teaching import IntraOptionTeacher
from sb3_options.learning.intra_option import IntraOptionMemory, Judgement, intra_option_target, judge
from sb3_options.learning.replay_buffer import QUANTILE_LESSONS
from tests.learning.test_dqn import (
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


def lessons_of(rows: list[Row], task: Task, *, outside: bool) -> list[tuple[Row, int, bool]]:
    """By the definition: which rows teach which slot, and whether its option goes on in s'."""
    lessons = []
    for row in rows:
        for slot, option in task.options.items():
            inside = option.initiation[row.state]
            if row.action < N_PRIMITIVE and option.policy[row.state] == row.action and (inside or outside):
                ahead = option.initiation[row.next_state] and not option.termination[row.next_state]
                lessons.append((row, slot, inside and ahead))
    return lessons


def served(model: Any, *, intra_option: bool = True) -> OptionServer:
    model.replay_buffer.intra_option = intra_option
    server = OptionServer(model, env_of(model), None)
    server.rollout_ends()
    return server


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("algorithm", [DQN, OptionDQN])
def test_targets_are_exact(algorithm: Any, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    task = random_task(seed)
    model = filled(algorithm, task, True, monkeypatch)
    served(model)
    masked = algorithm is OptionDQN
    rows = rows_lived_through(task, True)
    lessons = lessons_of(rows, task, outside=not masked)
    online, target_table = tables(model)
    predicted, target = train_on_all_rows(model, (functional, "smooth_l1_loss"), monkeypatch)

    def allowed(state: int) -> list[int]:
        return available_in(state, task.options) if masked else list(range(N_ACTIONS))

    expected = [target_of(r, target_table[r.next_state], allowed(r.next_state)) for r in rows]
    for row, slot, goes_on in lessons:
        option = N_PRIMITIVE + slot
        expected.append(target_of(row, target_table[row.next_state], [option] if goes_on else allowed(row.next_state)))
    np.testing.assert_allclose(target[:, 0], expected, rtol=0, atol=1e-6)
    taught = [online[row.state, N_PRIMITIVE + slot] for row, slot, _ in lessons]
    np.testing.assert_allclose(predicted[len(rows) :, 0], taught, rtol=0, atol=1e-6)
    assert len(lessons) > 50
    assert {(goes_on, row.terminal) for row, _, goes_on in lessons} >= {(True, False), (False, False), (False, True)}


def test_quantile_targets_are_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    task = random_task(1)
    model = filled(QRDQN, task, True, monkeypatch)
    served(model)
    rows = rows_lived_through(task, True)
    quantiles = tables(model)[1].reshape(N_STATES, N_QUANTILES, N_ACTIONS)
    greedy = quantiles.mean(axis=1).argmax(axis=1)
    _, target = train_on_all_rows(model, (qrdqn_module, "quantile_huber_loss"), monkeypatch)
    buffer = model.replay_buffer
    limit = int(QUANTILE_LESSONS * len(rows))
    lessons = buffer.memory.lessons(np.arange(len(rows)), limit)
    assert len(target) == len(rows)
    assert len(lessons.rows) == limit
    for row, slot, goes_on, seen in zip(
        lessons.rows, lessons.slots, lessons.goes_on, target[len(rows) - limit :], strict=True
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
    served(model, intra_option=False)
    assert len(model.replay_buffer._get_samples(np.arange(50)).actions) == 50


def test_without_options_a_batch_is_what_was_drawn() -> None:
    assert IntraOptionMemory(10, 2, 0, lambda obs, options: options).lessons(np.arange(10), 10) is None


def test_judges_by_the_options_own_sets() -> None:
    option = table_option([0, 1, 1, 1], [1, 0, 1, 0], [0.0, 0.0, 0.25, 1.0])
    judged = judge(option, np.array([0, 1, 1, 2, 2]), np.array([1, 0, 1, 1, -1]), np.array([2, 2, 0, 3, 2]))
    assert judged.takes.tolist() == [True, True, False, True, False]
    assert judged.inside.tolist() == [False, True, True, True, True]
    assert judged.goes_on.tolist() == [0.0, 0.75, 0.0, 0.0, 0.75]


def test_a_target_is_the_mixture_of_going_on_and_ending() -> None:
    one = torch.ones(1, 1)
    certain, discount = intra_option_target(2 * one, 0.9 * one, 0 * one, 0.75 * one, 4 * one)
    best = 8.0
    assert float(certain + discount * best) == pytest.approx(2 + 0.9 * (0.75 * 4 + 0.25 * 8))
    certain, _ = intra_option_target(2 * one, 0.9 * one, one, 0.75 * one, 4 * one)
    assert float(certain) == 2.0


class TestMemory:
    def memory(self, **kwargs: Any) -> IntraOptionMemory:
        memory = IntraOptionMemory(6, 2, 2, lambda obs, options: options[:, None].float(), **kwargs)
        inside = np.array([0, 0, 1, 1, 1, 1], dtype=bool)
        memory.note(np.arange(6), 1, Judgement(np.ones(6, dtype=bool), inside, np.array([0, 0, 0, 1, 0.5, 1])))
        return memory

    def test_lessons_inside_come_first(self) -> None:
        lessons = self.memory().lessons(np.arange(6), 4)
        assert lessons is not None
        assert lessons.rows.tolist() == [2, 3, 4, 5]
        assert lessons.slots.tolist() == [1] * 4

    def test_all_of_them_where_there_is_room(self) -> None:
        lessons = self.memory().lessons(np.array([5, 0]), 4)
        assert lessons is not None
        assert lessons.rows.tolist() == [5, 0]

    def test_masking_algorithms_learn_inside_only(self) -> None:
        lessons = self.memory(outside=False).lessons(np.arange(6), 6)
        assert lessons is not None
        assert lessons.rows.tolist() == [2, 3, 4, 5]

    def test_quantiles_learn_from_what_is_certain_only(self) -> None:
        lessons = self.memory(quantiles=True).lessons(np.arange(6), 6)
        assert lessons is not None
        assert lessons.rows.tolist() == [0, 1, 2, 3, 5]

    def test_what_is_overwritten_or_removed_teaches_nothing(self) -> None:
        memory = self.memory()
        memory.forget(np.array([2, 3]))
        lessons = memory.lessons(np.arange(2, 6), 6)
        assert lessons is not None
        assert lessons.rows.tolist() == [4, 5]
        memory.forget_option(1)
        assert memory.lessons(np.arange(6), 6) is None

    def test_values_do_not_travel(self) -> None:
        memory = pickle.loads(pickle.dumps(self.memory()))
        assert memory.values is None
        assert memory.lessons(np.arange(6), 6) is None


def test_new_steps_are_judged_as_the_old_ones_were(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judged in portions while training goes on, rows say the same as judged all at once at its end."""
    task = random_task(3)
    model = filled(DQN, task, True, monkeypatch)
    server = served(model)
    assert server.teacher is not None
    memory, buffer = server.teacher.memory, model.replay_buffer
    monkeypatch.setattr("sb3_options.callbacks.teaching.JUDGED_AT_ONCE", 40)
    obs, actions, next_obs = buffer.stored(np.s_[:200])
    info = {"option": {"index": -1, "duration": 1, "discount": GAMMA, "termination": "primitive"}}
    for i in range(200):
        add = (obs[i : i + 1], next_obs[i : i + 1], np.array([actions[i] % N_PRIMITIVE]))
        buffer.add(*add, np.zeros(1), np.zeros(1), [info])
        server.rollout_ends()
    in_portions = memory.takes.copy(), memory.inside.copy(), memory.goes_on.copy()
    for slot in task.options:
        server.teacher.judge_all(slot)
    assert memory.takes[: buffer.size()].sum() > 100
    for before, after in zip(in_portions, (memory.takes, memory.inside, memory.goes_on), strict=True):
        assert np.array_equal(before[: buffer.size()], after[: buffer.size()])


def test_an_option_that_keeps_learning_is_judged_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the buffer holds of it then follows from its latest policy."""
    monkeypatch.setattr("sb3_options.callbacks.teaching.REJUDGE_SHARE", 10**9)  # at once, and not before long
    monkeypatch.setattr("sb3_options.callbacks.teaching.JUDGED_AT_ONCE", 1)
    rejudged: list[int] = []
    stock = IntraOptionTeacher.judge_all

    def judge_all(teacher: IntraOptionTeacher, slot: int) -> None:
        rejudged.append(slot)
        stock(teacher, slot)

    monkeypatch.setattr(IntraOptionTeacher, "judge_all", judge_all)
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
    assert len(rejudged) > 3
    assert callback._server is not None
    teacher = callback._server.teacher
    assert teacher is not None
    before = teacher.memory.takes.copy(), teacher.memory.goes_on.copy()
    stock(teacher, 0)
    assert teacher.memory.takes[:, 0].sum() > 100
    for old, new in zip(before, (teacher.memory.takes, teacher.memory.goes_on), strict=True):
        assert np.array_equal(old, new)
