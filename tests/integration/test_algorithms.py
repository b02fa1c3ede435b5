"""Every cell of the table in docs/concepts/learning.md: each algorithm trains, discovers an option, and goes on."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from sb3_contrib import QRDQN, TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_options import OptionDQN, OptionReplayBuffer
from sb3_options.learning import heads
from sb3_options.learning.rollout_buffer import SMDPAdvantages
from tests.support.sb3_helpers import RANDOM, TINY, fast_callback, optioned_rooms

PAGE = Path(__file__).parents[2] / "docs" / "concepts" / "learning.md"
ALGORITHMS: dict[str, Any] = {a.__name__: a for a in (DQN, QRDQN, OptionDQN, PPO, A2C, TRPO, RecurrentPPO, MaskablePPO)}
OFF_POLICY = (DQN, QRDQN, OptionDQN)
GAMMA = 0.9


class Promise(NamedTuple):
    """A row of the table."""

    discounts: bool
    macro_q: bool
    masks: bool
    at_once: bool


def promises() -> dict[str, Promise]:
    rows = re.findall(r"^\| (\w+) \|(.*)\|$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    cells = {name: [cell.strip() for cell in row.split("|")] for name, row in rows}
    return {
        name: Promise(row[0] == "yes", row[1] == "yes", row[2] == "yes", row[3] == "at once")
        for name, row in cells.items()
    }


def make(algorithm: Any) -> Any:
    venv = DummyVecEnv([lambda: optioned_rooms(2), lambda: optioned_rooms(2)])
    if algorithm in OFF_POLICY:
        own = {} if algorithm is OptionDQN else {"replay_buffer_class": OptionReplayBuffer}
        return algorithm("MlpPolicy", venv, gamma=GAMMA, **{**TINY, **RANDOM, **own})
    policy = "MlpPolicy"
    network: dict[str, Any] = {"net_arch": [16]}
    if algorithm is RecurrentPPO:
        policy, network = "MlpLstmPolicy", {"net_arch": [16], "lstm_hidden_size": 8}
    kwargs: dict[str, Any] = {"n_steps": 32, "gamma": GAMMA, "seed": 0, "policy_kwargs": network, "learning_rate": 1e-4}
    if algorithm is not A2C:
        kwargs["batch_size"] = 64
    if algorithm not in (A2C, TRPO):
        kwargs["n_epochs"] = 1
    return algorithm(policy, venv, **kwargs)


class Watch(BaseCallback):
    """Which options ran, where they began, and when each reached the environments and the network."""

    def __init__(self, discovery: Any) -> None:
        super().__init__()
        self.discovery = discovery
        self.began_inside: list[bool] = []
        self.durations: list[int] = []
        self.arrived_at_once: bool | None = None
        self.closed_choices = 0
        self.discounts_right = True
        self.learned_over_options = False

    def _on_step(self) -> bool:
        venv = self.training_env
        for info in self.locals["infos"]:
            option = info["option"]
            self.discounts_right &= option["discount"] == pytest.approx(GAMMA ** option["duration"])
            if option["index"] < 0:
                self.closed_choices += "actions" in option
                continue
            self.durations.append(option["duration"])
            first = option["observations"][:1]
            self.began_inside.append(bool(self.discovery.bank[option["index"]].initiation(first)[0]))
        buffer: Any = getattr(self.model, "replay_buffer", None)
        if buffer is not None and len(self.durations) % 50 == 1:
            self.learned_over_options |= bool((buffer.discounts[: buffer.size()] < GAMMA - 1e-3).any())
        if self.discovery.discoveries and self.arrived_at_once is None:
            self.arrived_at_once = len(venv.get_attr("bank")[0]) == 1
        return True

    def _on_rollout_end(self) -> None:
        buffer: Any = getattr(self.model, "rollout_buffer", None)
        if buffer is not None:
            assert isinstance(buffer, SMDPAdvantages)
            np.testing.assert_allclose(buffer.discounts, GAMMA**buffer.durations)
            self.learned_over_options |= bool((buffer.durations > 1).any())


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_table(name: str) -> None:
    algorithm, promise = ALGORITHMS[name], promises()[name]
    model = make(algorithm)
    discovery = fast_callback()
    watch = Watch(discovery)
    model.learn(3_000, callback=[discovery, watch])
    assert len(discovery.discoveries) == 1, "no option was discovered: nothing is tested"
    assert max(watch.durations) > 1, "no option ran for longer than a step: nothing is tested"

    # γᵏ
    assert promise.discounts
    assert watch.discounts_right
    assert watch.learned_over_options

    # Macro-Q: the steps inside options were stored too, as many rows as there were primitive steps and options.
    stores = isinstance(getattr(model, "replay_buffer", None), OptionReplayBuffer)
    assert promise.macro_q is (stores and model.replay_buffer.macro_q)
    if promise.macro_q:
        assert model.replay_buffer.size() == model.num_timesteps + len(watch.durations)

    # Masks
    assert promise.masks is all(watch.began_inside)
    if promise.masks:
        assert watch.closed_choices == 0

    # Injection
    assert promise.at_once is watch.arrived_at_once
    assert not heads.is_closed(model.policy, 4)
    assert heads.is_closed(model.policy, 5)
    assert all(torch.isfinite(p).all() for p in model.policy.parameters())


def test_every_algorithm_is_in_the_table() -> None:
    assert set(promises()) == set(ALGORITHMS)
