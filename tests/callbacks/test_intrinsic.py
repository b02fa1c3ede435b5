"""The bonus against an oracle that works it out from the primitive steps alone."""

import math
from collections import Counter
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_options import OptionsWrapper
from sb3_options.callbacks import IntrinsicRewardCallback, PrimitiveStepsCallback
from tests.learning.test_rollout_buffer import GAMMA, LAMBDA, make
from tests.support.helpers import steady_option
from tests.support.sb3_helpers import Corridor, StepLog

WEIGHT = 0.5


class Rollout(BaseCallback):
    """Keeps the first rollout as SB3 computed it and, where it is called after the bonus, as it was learned from."""

    def __init__(self) -> None:
        super().__init__()
        self.durations: list[list[int]] = []
        self.dones: list[Any] = []
        self.over = False

    def _on_step(self) -> bool:
        if not self.over:
            infos = self.locals["infos"]
            self.durations.append([info["option"]["duration"] if "option" in info else 1 for info in infos])
            self.dones.append(self.locals["dones"].copy())
        return not self.over

    def _on_rollout_end(self) -> None:
        buffer: Any = self.model.rollout_buffer  # type: ignore[attr-defined]  # of on-policy algorithms
        self.kept = {name: getattr(buffer, name).copy() for name in ("rewards", "advantages", "returns")}
        self.over = True


def counted(steps: list[list[int]], logs: list[list[Any]], place: Any) -> list[list[list[float]]]:
    """1 / √N of every primitive step: of each decision of each environment, in the order they happened."""
    visits: Counter[Any] = Counter()
    at = [0] * len(logs)
    bonuses: list[list[list[float]]] = []
    for durations in steps:
        bonuses.append([])
        for env, k in enumerate(durations):
            bonuses[-1].append([])
            for step in logs[env][at[env] : at[env] + k]:
                visits[place(step.next_state)] += 1
                bonuses[-1][-1].append(1 / math.sqrt(visits[place(step.next_state)]))
            at[env] += k
    return bonuses


def std_of_returns(bonuses: list[list[list[float]]]) -> float:
    """σ of Gₜ = γ Gₜ₋₁ + bₜ over the primitive steps of all environments."""
    returns = []
    for env in range(len(bonuses[0])):
        total = 0.0
        for step in bonuses:
            for bonus in step[env]:
                total = GAMMA * total + bonus
                returns.append(total)
    return float(np.std(returns))


def logged(n_envs: int, *, options: bool) -> tuple[DummyVecEnv, list[StepLog]]:
    logs = [StepLog(Corridor(limit=13 + 4 * i)) for i in range(n_envs)]

    def wrapped(env: StepLog) -> gym.Env[Any, Any]:
        if not options:
            return env
        optioned = OptionsWrapper(env, 2, gamma=GAMMA)
        optioned.bank.add(steady_option(1, max_duration=7))
        optioned.bank.add(steady_option(0, max_duration=3))
        return optioned

    return DummyVecEnv([lambda env=env: wrapped(env) for env in logs]), logs  # type: ignore[misc]  # bound early


@pytest.mark.parametrize("options", [True, False])
@pytest.mark.parametrize("algorithm", [PPO, A2C, TRPO, MaskablePPO, RecurrentPPO])
@pytest.mark.parametrize("bonus_first", [True, False])
def test_advantages_are_those_of_rewards_with_the_bonus(algorithm: Any, options: bool, bonus_first: bool) -> None:
    if algorithm is MaskablePPO and not options:
        pytest.skip("needs masks, which the corridor has not")
    venv, logs = logged(2, options=options)
    model = make(algorithm, venv)
    before, after = Rollout(), Rollout()
    bonus: list[BaseCallback] = [before, IntrinsicRewardCallback(weight=WEIGHT), after]
    counting: list[BaseCallback] = [PrimitiveStepsCallback()] if options else []
    model.learn(100_000, callback=CallbackList([*bonus, *counting] if bonus_first else [*counting, *bonus]))
    bonuses = counted(before.durations, [env.log for env in logs], lambda state: tuple(np.rint(state)))
    assert not options or max(len(of_run) for step in bonuses for of_run in step) > 3
    weight = WEIGHT / std_of_returns(bonuses)
    sums = np.array([[sum(GAMMA**i * b for i, b in enumerate(of_run)) for of_run in step] for step in bonuses])
    np.testing.assert_allclose(after.kept["rewards"] - before.kept["rewards"], weight * sums, rtol=1e-3, atol=1e-5)

    for env in range(2):
        for t in range(len(sums)):
            total, trace = 0.0, 1.0
            for later in range(t, len(sums)):
                total += trace * weight * sums[later, env]
                if before.dones[later][env]:
                    break
                trace *= GAMMA ** before.durations[later][env] * (1.0 if algorithm is None else model.gae_lambda)
            for name in ("advantages", "returns"):
                added = after.kept[name][t, env] - before.kept[name][t, env]
                assert added == pytest.approx(total, rel=1e-3, abs=1e-4)
    assert model.gae_lambda == LAMBDA
