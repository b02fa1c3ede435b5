"""Random finite MDPs with random options, and networks that are tables of them."""

from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import pytest
import torch
from sb3_contrib import QRDQN
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_options import OptionReplayBuffer, OptionsWrapper
from sb3_options.learning import heads
from tests.support.helpers import TableEnv, table_option
from tests.support.sb3_helpers import RANDOM, ActionLog, Row, StepLog, TableOption, expected_rows

GAMMA = 0.9
N_STATES, N_PRIMITIVE, MAX_OPTIONS = 8, 3, 3
N_ACTIONS = N_PRIMITIVE + MAX_OPTIONS
N_QUANTILES = 5
TABULAR: dict[str, Any] = {"policy_kwargs": {"net_arch": []}, "learning_starts": 0, "buffer_size": 5000, "seed": 3}


class Task(NamedTuple):
    """A random MDP with random options in slots 0 and 2, slot 1 being empty, and the logs of what happened."""

    env: ActionLog
    steps: StepLog
    options: dict[int, TableOption]


def random_task(seed: int) -> Task:
    rng = np.random.default_rng(seed)
    base = TableEnv(rng, N_STATES, N_PRIMITIVE)
    base.time_limit, base.terminal = 5, np.arange(N_STATES) == 0
    steps = StepLog(base)
    wrapped = OptionsWrapper(steps, MAX_OPTIONS, gamma=GAMMA)
    options: dict[int, TableOption] = {}
    for slot in (0, 2):
        table = TableOption(
            (rng.random(N_STATES) < 0.7).tolist(),
            rng.integers(N_PRIMITIVE, size=N_STATES).tolist(),
            (rng.random(N_STATES) < 0.2).tolist(),
            max_duration=4,
        )
        options[slot] = table
        wrapped.bank.add(table_option(*table[:3], max_duration=4), slot)
    return Task(ActionLog(wrapped), steps, options)


def filled(algorithm: type[OffPolicyAlgorithm], task: Task, macro_q: bool, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A model over Q tables drawn at random, whose buffer its own `learn` has filled with random actions."""
    quantiles = {"n_quantiles": N_QUANTILES} if algorithm is QRDQN else {}
    model = algorithm(
        "MlpPolicy", task.env, gamma=GAMMA, replay_buffer_class=OptionReplayBuffer,
        replay_buffer_kwargs={"macro_q": macro_q, "n_steps": 1},
        **TABULAR | RANDOM | {"policy_kwargs": {"net_arch": [], **quantiles}},
    )  # fmt: skip
    monkeypatch.setattr(model, "train", lambda gradient_steps, batch_size: None)
    model.learn(400)
    monkeypatch.undo()
    for layer, _ in heads.option_outputs(model.policy):
        torch.nn.init.uniform_(layer.weight, -1, 1)
        torch.nn.init.uniform_(layer.bias, -1, 1)
        with torch.no_grad():
            often = layer.bias.new_tensor([0.5, 1.5, 1.5])  # so that what is available matters
            layer.bias.view(-1, N_ACTIONS)[:, N_PRIMITIVE:] += often
    return model


def q_tables(model: Any) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """What the online and the target network give in each state, in float64, (states, outputs)."""
    layers = [layer for layer, _ in heads.option_outputs(model.policy)]
    both = [(layer.weight.detach().double().T + layer.bias.detach().double()).cpu().numpy() for layer in layers]
    return both[0], both[1]


def train_on_all_rows(
    model: Any, loss: tuple[Any, str], monkeypatch: pytest.MonkeyPatch
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """One gradient step on every stored row in order; what the algorithm handed to its loss: (predicted, target)."""
    handed: list[list[npt.NDArray[np.float64]]] = []
    module, name = loss
    stock = getattr(module, name)

    def spy(predicted: torch.Tensor, target: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
        handed.append([predicted.detach().double().cpu().numpy(), target.detach().double().cpu().numpy()])
        return cast("torch.Tensor", stock(predicted, target, *args, **kwargs))

    buffer = model.replay_buffer
    monkeypatch.setattr(buffer, "sample", lambda n, env=None: buffer._get_samples(np.arange(buffer.size()), env))
    monkeypatch.setattr(module, name, spy)
    model.train(1, buffer.size())
    monkeypatch.undo()
    assert len(handed) == 1
    return handed[0][0], handed[0][1]


def rows_lived_through(task: Task, macro_q: bool) -> list[Row]:
    return expected_rows(task.steps.log, task.env.chosen, task.options, N_PRIMITIVE, GAMMA, macro_q=macro_q)


def available_in(state: int, options: dict[int, TableOption]) -> list[int]:
    return [*range(N_PRIMITIVE), *(N_PRIMITIVE + i for i, o in options.items() if o.initiation[state])]


def target_of(row: Row, next_values: npt.NDArray[np.float64], actions: list[int]) -> float:
    """r + γᵏ max over ``actions`` of Q(s', a), or r at the end of an episode."""
    return row.reward + (0.0 if row.terminal else row.discount * float(max(next_values[a] for a in actions)))
