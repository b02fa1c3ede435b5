"""The head of a new option: what stored steps teach it, and what stays as it was."""

from typing import Any

import numpy as np
import pytest
import torch
from sb3_contrib import QRDQN
from stable_baselines3 import DQN

from sb3_options import OptionDQN
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.callbacks.serving import OptionServer
from sb3_options.learning import head_teaching, heads
from tests.learning.test_dqn import (
    GAMMA,
    N_ACTIONS,
    N_PRIMITIVE,
    N_QUANTILES,
    N_STATES,
    Task,
    filled,
    random_task,
    tables,
)
from tests.support.helpers import table_option
from tests.support.sb3_helpers import RANDOM, TINY, env_of, optioned_rooms


def with_option_moving_in(algorithm: Any, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Task, OptionServer]:
    """A model over tables with a full buffer, into whose slot 0, closed until now, an option is about to move."""
    task = random_task(1)
    model = filled(algorithm, task, True, monkeypatch)
    table = task.options.pop(2)
    task.env.env.set_option(0, None)  # type: ignore[attr-defined]  # OptionsWrapper
    task.env.env.set_option(2, None)  # type: ignore[attr-defined]  # OptionsWrapper
    rows = model.replay_buffer.actions >= N_PRIMITIVE
    model.replay_buffer.actions[rows] = 0  # nothing names a closed action
    server = OptionServer(model, env_of(model), None)
    server.put(0, table_option(*table[:3], max_duration=4))
    task.options[0] = table
    return model, task, server


@pytest.mark.parametrize("algorithm", [DQN, OptionDQN, QRDQN])
def test_opens_at_its_own_value(algorithm: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a table fitted exactly: the fixed point of r + γ U over the stored steps, solved as a linear system."""
    model, task, server = with_option_moving_in(algorithm, monkeypatch)
    monkeypatch.setattr(head_teaching, "RIDGE", 1e-4)  # with next to no prior
    option = task.options[0]
    before = tables(model)[1].reshape(N_STATES, -1, N_ACTIONS)
    closed = server.n_primitive  # slot 0
    best = before.mean(axis=1)
    best[:, N_PRIMITIVE:] = -np.inf
    best = before[np.arange(N_STATES), :, best.argmax(axis=1)]  # (states, outputs)
    server.rollout_ends()
    buffer = model.replay_buffer
    obs, actions, next_obs = buffer.stored(np.s_[: buffer.size()])
    n = before.shape[1]
    weight, system, right = np.zeros(N_STATES), np.zeros((N_STATES, N_STATES)), np.zeros((N_STATES, n))
    for i in range(buffer.size()):
        s, s2 = int(np.ravel(obs[i])[0]), int(np.ravel(next_obs[i])[0])
        inside = option.initiation[s]
        if option.policy[s] != actions[i] or not (inside or algorithm is not OptionDQN):
            continue
        goes_on = inside and option.initiation[s2] and not option.termination[s2]
        alive = buffer.discounts[i] * (1 - buffer.dones[i] * (1 - buffer.timeouts[i]))
        weight[s] += 1
        right[s] += buffer.rewards[i]
        if goes_on:
            system[s, s2] += alive
        else:
            right[s] += alive * best[s2]
    seen = weight > 0
    scale = np.where(seen, weight, 1)[:, None]
    expected = np.linalg.solve(np.eye(N_STATES) - system / scale, right / scale)
    online, target = (t.reshape(N_STATES, -1, N_ACTIONS)[:, :, closed] for t in tables(model))
    # The states differ by how often they were seen, and the ridge and the last sweep leave a little.
    np.testing.assert_allclose(target[seen], expected[seen], atol=0.02 * np.ptp(expected))
    np.testing.assert_allclose(online[seen], expected[seen], atol=0.02 * np.ptp(expected))
    assert seen.sum() >= 4
    assert np.ptp(expected[seen]) > 0.3
    assert n == (N_QUANTILES if algorithm is QRDQN else 1)


@pytest.mark.parametrize("algorithm", [DQN, OptionDQN, QRDQN])
def test_all_other_outputs_stay_bit_for_bit(algorithm: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    model, _, server = with_option_moving_in(algorithm, monkeypatch)
    others = [a for a in range(N_ACTIONS) if a != N_PRIMITIVE]
    before = tables(model)
    server.rollout_ends()
    for a, b in zip(before, tables(model), strict=True):
        first, second = a.reshape(N_STATES, -1, N_ACTIONS), b.reshape(N_STATES, -1, N_ACTIONS)
        assert np.array_equal(first[:, :, others], second[:, :, others])
        assert not np.array_equal(first[:, :, N_PRIMITIVE], second[:, :, N_PRIMITIVE])


@pytest.mark.parametrize("teach_head", [True, False])
def test_a_discovered_option_is_taught_if_asked(teach_head: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    model = OptionDQN("MlpPolicy", optioned_rooms(2), gamma=GAMMA, **TINY | RANDOM)
    seen: list[Any] = []
    stock = OptionServer.rollout_ends

    def spy(server: OptionServer) -> None:
        moved_in = list(server._moved_in)
        before = outputs_of(model)
        stock(server)
        if moved_in:
            seen.append((moved_in, before, outputs_of(model)))

    monkeypatch.setattr(OptionServer, "rollout_ends", spy)
    callback = SubgoalDiscoveryCallback(
        {"min_positive": 3, "goal_radius": 3.0, "decay": 0.5}, max_new_options=1, teach_head=teach_head
    )
    model.learn(2500, callback=callback)
    (slots, before, after), *_ = seen
    assert slots == [0]
    for a, b in zip(before, after, strict=True):
        others = [i for i in range(a.shape[1]) if i != 4]
        assert torch.equal(a[:, others], b[:, others])
        assert torch.equal(a[:, 4], b[:, 4]) != teach_head


@torch.no_grad()
def outputs_of(model: Any) -> tuple[torch.Tensor, torch.Tensor]:
    seen = torch.eye(45)
    return model.q_net(seen), model.q_net_target(seen)


def test_without_values_of_actions_there_is_nothing_to_teach() -> None:
    policy = type("Policy", (), {})()
    with pytest.raises(TypeError, match="gives no values of actions; DQN, QRDQN and OptionDQN do"):
        heads.networks(policy)
