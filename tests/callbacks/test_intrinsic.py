"""The bonus against an oracle that works it out from the primitive steps alone."""

import math
from collections import Counter
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import numpy as np
import pytest
import torch
from sb3_contrib import TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecFrameStack, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_options import OptionDQN, OptionsWrapper
from sb3_options.callbacks import IntrinsicRewardCallback, PrimitiveStepsCallback
from sb3_options.experience.observations import flatten
from sb3_options.learning.episodic_novelty import keys_of
from sb3_options.learning.novelty import NoveltyKind, RandomNetworkDistillation, StateCounts, Steps
from tests.learning.test_replay_buffer import optioned, place_in
from tests.learning.test_rollout_buffer import GAMMA, LAMBDA, make
from tests.support.helpers import steady_option
from tests.support.sb3_helpers import Corridor, StepLog, optioned_rooms

WEIGHT = 0.5


class Rollout(BaseCallback):
    """Keeps the first rollout, as it is when this is called, and of every step how long each action took."""

    def __init__(self) -> None:
        super().__init__()
        self.kept: Any = None
        self.durations: list[list[int]] = []
        self.dones: list[Any] = []

    def _on_step(self) -> bool:
        if self.kept is None:
            infos = self.locals["infos"]
            self.durations.append([info.get("option", {"duration": 1})["duration"] for info in infos])
            self.dones.append(self.locals["dones"].copy())
        return self.kept is None

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


@pytest.mark.parametrize(
    ("algorithm", "options", "bonus_first"),
    [(algorithm, True, True) for algorithm in (PPO, A2C, TRPO, MaskablePPO, RecurrentPPO)]
    + [(PPO, True, False), (PPO, False, True), (RecurrentPPO, False, True)],
)
def test_advantages_are_those_of_rewards_with_the_bonus(algorithm: Any, options: bool, bonus_first: bool) -> None:
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


class Seen:
    """Stands in for novelty, and keeps the primitive steps that it is asked about."""

    def __init__(self) -> None:
        self.steps: list[Any] = []

    def bonuses(self, steps: Steps) -> Any:
        keys = zip(keys_of(flatten(steps.before)), keys_of(flatten(steps.after)), strict=True)
        self.steps += zip(steps.envs.tolist(), keys, steps.actions.tolist(), steps.begins.tolist(), strict=True)
        return np.ones(len(steps.envs))

    def records(self) -> dict[str, float]:
        return {}


@pytest.mark.parametrize("options", [True, False])
@pytest.mark.parametrize("above", [True, False])
def test_novelty_is_asked_about_each_primitive_step(options: bool, above: bool) -> None:
    """Episodes of the environments end at different times; observations are the same to the last bit that counts.

    What wrappers above do to observations is undone, to the last of an episode too.
    """
    venv, logs = logged(2, options=options)
    bonus, seen = IntrinsicRewardCallback(), Seen()
    bonus.novelty = seen  # type: ignore[assignment]  # behaves as one
    env = VecNormalize(VecFrameStack(venv, 3), norm_reward=False, gamma=GAMMA) if above else venv
    callbacks: list[BaseCallback] = [bonus, PrimitiveStepsCallback()] if options else [bonus]
    model = make(PPO, env)
    model.learn(200, callback=callbacks)
    before = [len(log.log) for log in logs]
    model.learn(200, callback=callbacks)  # the environments are reset in mid-episode
    for i, log in enumerate(logs):
        begins = [True, *(step.terminated or step.truncated for step in log.log[:-1])]
        begins[before[i]] = True
        expected = [
            (i, (key(step.state), key(step.next_state)), step.action, begin)
            for step, begin in zip(log.log, begins, strict=True)
        ]
        assert [step for step in seen.steps if step[0] == i] == expected
        assert sum(begins) > 3


def test_lost_steps_are_none() -> None:
    class Loses(VecEnvWrapper):
        n = 0

        def reset(self) -> Any:
            return self.venv.reset()

        def step_wait(self) -> Any:
            observations, rewards, dones, infos = self.venv.step_wait()
            self.n += 1
            if self.n == 7:
                infos[1]["lost"] = True
            return observations, rewards, dones, infos

    venv, logs = logged(2, options=False)
    bonus, seen = IntrinsicRewardCallback(), Seen()
    bonus.novelty = seen  # type: ignore[assignment]  # behaves as one
    make(PPO, Loses(venv)).learn(128, callback=bonus)
    for i, log in enumerate(logs):
        actions = [step.action for step in log.log]
        assert [action for env, _, action, _ in seen.steps if env == i] == actions[: 6 if i else None] + actions[7:] * i


def test_networks_learn_as_often_whatever_the_length_of_a_rollout() -> None:
    bonus = IntrinsicRewardCallback("rnd")
    make(PPO, Corridor(), n_steps=65, batch_size=65).learn(4 * 65, callback=bonus)
    assert isinstance(bonus.novelty, RandomNetworkDistillation)
    (moments, *_) = bonus.novelty._optimizer.state.values()
    assert (int(moments["step"]), bonus.novelty._n_learned) == (4, 1)  # steps for 64, 65, 65 and 65 observations


def test_steps_before_an_error_count() -> None:
    class Fails(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls == 100:
                raise KeyboardInterrupt
            return True

    bonus, model = IntrinsicRewardCallback(), make(PPO, Corridor(), n_steps=64, batch_size=64)
    with pytest.raises(KeyboardInterrupt):
        model.learn(640, callback=[bonus, Fails()])
    model.learn(64, callback=bonus)
    assert sum(visits_of(bonus).values()) == 164


def key(observation: Any) -> bytes:
    return keys_of(flatten(np.asarray(observation)[None]))[0]


def visits_of(bonus: IntrinsicRewardCallback) -> dict[bytes, int]:
    assert isinstance(bonus.novelty, StateCounts)
    return bonus.novelty.visits


@pytest.mark.parametrize("kind", ["box", "discrete", "dict", "dict_discrete", "image"])
def test_every_kind_of_observation_is_counted_as_the_environment_gave_it(kind: str) -> None:
    venv = DummyVecEnv([lambda: optioned(kind)] * 2)
    policy = "MultiInputPolicy" if kind.startswith("dict") else "MlpPolicy"
    model = PPO(
        policy, venv, gamma=GAMMA, policy_kwargs={"net_arch": [8]}, seed=0, n_steps=32, batch_size=64, n_epochs=1
    )
    bonus = IntrinsicRewardCallback()
    model.learn(160, callback=[bonus, PrimitiveStepsCallback()])
    logs = [step for i in range(2) for step in venv.get_attr("log")[i]]
    expected = Counter(place_in(step.next_state) for step in logs)
    assert sorted(visits_of(bonus).values()) == sorted(expected.values())


def test_without_weight_nothing_changes() -> None:
    """Nothing is drawn from the environment's spaces either."""
    weights = []
    for callback in (None, *(IntrinsicRewardCallback(kind, weight=0.0) for kind in get_args(NoveltyKind))):
        env = Corridor()
        env.observation_space.seed(0)
        model = make(PPO, env)
        model.learn(256, callback=callback)
        assert env.observation_space.np_random.random() == np.random.default_rng(0).random()
        weights.append(torch.cat([p.detach().flatten() for p in model.policy.parameters()]))
    assert len(weights) == 5
    assert all(torch.equal(weights[0], each) for each in weights)


@pytest.mark.parametrize("kind", ["counts", "rnd", "noveld", "e3b"])
def test_logs_and_goes_on(kind: Any, tmp_path: Path) -> None:
    model = PPO("MlpPolicy", optioned_rooms(1), gamma=0.9, seed=0, tensorboard_log=str(tmp_path), n_steps=64)
    bonus = IntrinsicRewardCallback(kind)
    model.learn(256, callback=bonus)
    before = bonus.novelty
    model.learn(64, callback=bonus, reset_num_timesteps=False)
    assert bonus.novelty is before
    if isinstance(before, StateCounts):
        assert sum(before.visits.values()) == 320
    scalars = EventAccumulator(str(min(tmp_path.rglob("events*"))))
    scalars.Reload()
    shown = "intrinsic/states" if kind == "counts" else "intrinsic/loss"
    assert {"intrinsic/bonus", "intrinsic/return_std", shown} <= set(scalars.Tags()["scalars"])
    assert 0 < scalars.Scalars("intrinsic/bonus")[-1].value < 0.2


class TestErrors:
    @pytest.mark.parametrize("arguments", [{"kind": "icm"}, {"weight": -0.1}, {"weight": float("nan")}])
    def test_bad_arguments(self, arguments: dict[str, Any]) -> None:
        text = "kind must be one of 'counts', 'rnd', 'noveld', 'e3b', and weight finite and at least 0, got"
        with pytest.raises(ValueError, match=text):
            IntrinsicRewardCallback(**arguments)

    def test_no_discount(self) -> None:
        with pytest.raises(ValueError, match=r"needs gamma below 1, or its return has no bound, got gamma=1\.0"):
            make(PPO, Corridor(), gamma=1.0).learn(64, callback=IntrinsicRewardCallback())

    def test_actions_that_nothing_predicts(self) -> None:
        model = PPO("MlpPolicy", "Pendulum-v1", n_steps=16, batch_size=16)
        with pytest.raises(TypeError, match=r"'e3b' predicts discrete actions, got Box"):
            model.learn(16, callback=IntrinsicRewardCallback("e3b"))

    def test_nothing_to_count(self) -> None:
        model = PPO("MultiInputPolicy", Corridor("dict"), n_steps=16, batch_size=16)
        with pytest.raises(ValueError, match=r"nothing to count in Dict.*pass OptionsWrapper\(feature_map"):
            model.learn(16, callback=IntrinsicRewardCallback())

    def test_an_algorithm_without_rollouts(self) -> None:
        with pytest.raises(TypeError, match="for algorithms with rollouts, such as PPO and A2C: OptionDQN has none"):
            OptionDQN("MlpPolicy", optioned_rooms(), gamma=0.9).learn(10, callback=IntrinsicRewardCallback())
