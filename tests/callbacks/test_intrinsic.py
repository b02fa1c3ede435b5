"""The bonus against an oracle that works it out from the primitive steps alone."""

import math
from collections import Counter
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import QRDQN, TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_options import OptionDQN, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import IntrinsicRewardCallback, PrimitiveStepsCallback
from sb3_options.learning.bonus_replay import set_bonus
from tests.learning.test_rollout_buffer import GAMMA, LAMBDA, make
from tests.support.helpers import steady_option
from tests.support.sb3_helpers import Corridor, StepLog

WEIGHT = 0.5


class Decisions(BaseCallback):
    """Keeps of every step how long each environment's action took, whether it was an option, and what ended."""

    def __init__(self) -> None:
        super().__init__()
        self.durations: list[list[int]] = []
        self.is_option: list[list[bool]] = []
        self.dones: list[Any] = []

    def _on_step(self) -> bool:
        runs = [info.get("option", {"duration": 1, "index": -1}) for info in self.locals["infos"]]
        self.durations.append([run["duration"] for run in runs])
        self.is_option.append([run["index"] >= 0 for run in runs])
        self.dones.append(self.locals["dones"].copy())
        return True


class Rollout(Decisions):
    """Keeps the first rollout too, as it is when this is called."""

    kept: Any = None

    def _on_step(self) -> bool:
        return self.kept is None and super()._on_step()

    def _on_rollout_end(self) -> None:
        buffer: Any = self.model.rollout_buffer  # type: ignore[attr-defined]  # of on-policy algorithms
        self.kept = {name: getattr(buffer, name).copy() for name in ("rewards", "advantages", "returns")}


def place(step: Any) -> tuple[int, ...]:
    """Where a primitive step led."""
    return tuple(np.rint(step.next_state).astype(int))


def counted(steps: list[list[int]], logs: list[list[Any]]) -> list[list[list[float]]]:
    """1 / √N of every primitive step: of each decision of each environment, in the order they happened."""
    visits: Counter[Any] = Counter()
    at = [0] * len(logs)
    bonuses: list[list[list[float]]] = []
    for durations in steps:
        bonuses.append([])
        for env, k in enumerate(durations):
            bonuses[-1].append([])
            for step in logs[env][at[env] : at[env] + k]:
                visits[place(step)] += 1
                bonuses[-1][-1].append(1 / math.sqrt(visits[place(step)]))
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
    bonuses = counted(before.durations, [env.log for env in logs])
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
                trace *= GAMMA ** before.durations[later][env] * LAMBDA
            for name in ("advantages", "returns"):
                added = after.kept[name][t, env] - before.kept[name][t, env]
                assert added == pytest.approx(total, rel=1e-3, abs=1e-4)
    assert model.gae_lambda == LAMBDA


class Batch(BaseCallback):
    """Samples all rows once at step ``at``, with the bonus and without, and keeps what it added."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self.at = at

    def _on_step(self) -> bool:
        return not hasattr(self, "added")

    def _on_rollout_start(self) -> None:
        if self.num_timesteps < self.at:
            return
        buffer: Any = self.model.replay_buffer  # type: ignore[attr-defined]  # of off-policy algorithms
        rows = np.arange(buffer.size())
        normalizer = self.model.get_vec_normalize_env()
        samples = buffer._get_samples(rows, normalizer)
        set_bonus(buffer, None)
        plain = buffer._get_samples(rows, normalizer)
        self.added = (samples.rewards - plain.rewards).numpy()[:, 0]


@pytest.mark.parametrize("normalized", [True, False])
@pytest.mark.parametrize("algorithm", [OptionDQN, DQN, QRDQN])
def test_a_replay_buffer_is_relabelled_with_the_counts_of_now(algorithm: Any, normalized: bool) -> None:
    venv, logs = logged(2, options=True)
    env: Any = VecNormalize(venv, gamma=GAMMA, clip_reward=np.inf) if normalized else venv
    model = algorithm(
        "MlpPolicy", env, gamma=GAMMA, replay_buffer_class=OptionReplayBuffer, learning_starts=50, train_freq=4,
        exploration_fraction=1.0, policy_kwargs={"net_arch": [8]}, buffer_size=5000, seed=0,
    )  # fmt: skip
    bonus = IntrinsicRewardCallback(weight=WEIGHT)
    batch, kept = Batch(300), Decisions()
    model.learn(400, callback=CallbackList([kept, PrimitiveStepsCallback(), bonus, batch]))
    steps = kept.durations[:-1]  # the last one ended training after the batch
    visits: Counter[Any] = Counter()
    rows: list[list[Any]] = []
    at = [0, 0]
    for t, of_step in enumerate(steps):
        for env, k in enumerate(of_step):
            run = logs[env].log[at[env] : at[env] + k]
            at[env] += k
            assert bool(kept.dones[t][env]) == (run[-1].terminated or run[-1].truncated)
            visits.update(place(step) for step in run)
            rows += [run, *([step] for step in run if kept.is_option[t][env])]
    weight = WEIGHT / std_of_returns(counted(steps, [env.log for env in logs]))
    expected = [sum(GAMMA**i / math.sqrt(visits[place(step)]) for i, step in enumerate(run)) for run in rows]
    assert max(map(len, rows)) > 3
    np.testing.assert_allclose(batch.added, weight * np.array(expected), rtol=1e-3, atol=1e-5)
