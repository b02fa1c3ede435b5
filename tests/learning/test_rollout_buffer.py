"""Advantages over options against an oracle that works them out from the primitive steps, one env at a time."""

import copy
from fractions import Fraction
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from sb3_contrib import TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_options import OptionDictRolloutBuffer, OptionRolloutBuffer, OptionsWrapper
from sb3_options.callbacks import PrimitiveStepsCallback
from sb3_options.callbacks.installer import OptionInstaller
from sb3_options.density.regions import Region
from sb3_options.learning.rollout_buffer import SMDPAdvantages
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from tests.support.helpers import CountingEnv, steady_option
from tests.support.sb3_helpers import Corridor, env_of, places

GAMMA, LAMBDA = 0.9, 0.8


ENOUGH = 100_000  # Primitive steps in which a rollout of any options is complete


class OneRollout(BaseCallback):
    """Ends training after one rollout; keeps it, and what it was computed from as environments and policy gave it."""

    buffer: Any = None

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[dict[str, Any]] = []

    def _on_training_start(self) -> None:
        buffer: Any = self.model.rollout_buffer  # type: ignore[attr-defined]  # of on-policy algorithms
        compute = buffer.compute_returns_and_advantage

        def spy(last_values: torch.Tensor, dones: Any) -> None:
            self.last_values = last_values.cpu().numpy().reshape(-1).copy()
            compute(last_values, dones)
            self.buffer, self.n_steps = copy.deepcopy(buffer), self.num_timesteps

        buffer.compute_returns_and_advantage = spy

    def _on_step(self) -> bool:
        if self.buffer is not None:
            return False
        infos = self.locals["infos"]
        kept = {
            "rewards": self.locals["rewards"].copy(),
            "values": self.locals["values"].cpu().numpy().reshape(-1),
            "dones": self.locals["dones"].copy(),
            "durations": [info["option"]["duration"] for info in infos],
            "timeout_values": [self._value_after_timeout(i, info) for i, info in enumerate(infos)],
        }
        self.steps.append(kept)
        return True

    def _value_after_timeout(self, i: int, info: dict[str, Any]) -> float:
        if not (self.locals["dones"][i] and info.get("TimeLimit.truncated", False)):
            return 0.0
        policy: Any = self.model.policy
        observation = policy.obs_to_tensor(info["terminal_observation"])[0]
        with torch.no_grad():
            if "lstm_states" not in self.locals:
                return float(policy.predict_values(observation))
            state = tuple(part[:, i : i + 1].contiguous() for part in self.locals["lstm_states"].vf)
            return float(policy.predict_values(observation, state, torch.zeros(1, device=policy.device)))


def oracle(steps: list[dict[str, Any]], last_values: Any, env: int) -> list[Fraction]:
    """A = Σⱼ (Π discounts and traces) δⱼ, summed forward in exact fractions, without a recursion."""
    gamma, lam = Fraction(GAMMA), Fraction(LAMBDA)
    values = [Fraction(float(s["values"][env])) for s in steps] + [Fraction(float(last_values[env]))]
    advantages = []
    for t in range(len(steps)):
        total, weight = Fraction(0), Fraction(1)
        for j in range(t, len(steps)):
            step = steps[j]
            k, done = step["durations"][env], bool(step["dones"][env])
            after = Fraction(step["timeout_values"][env]) if done else values[j + 1]
            total += weight * (Fraction(float(step["rewards"][env])) + gamma**k * after - values[j])
            if done:
                break
            weight *= gamma**k * lam
        advantages.append(total)
    return advantages


def optioned_corridor(limit: int) -> gym.Env[Any, Any]:
    env = OptionsWrapper(Corridor(limit=limit), 2, gamma=GAMMA)
    env.bank.add(steady_option(1, max_duration=7))
    env.bank.add(steady_option(0, max_duration=3))
    return env


def make(algorithm: type[OnPolicyAlgorithm], env: Any, **kwargs: Any) -> OnPolicyAlgorithm:
    policy = "MlpLstmPolicy" if algorithm is RecurrentPPO else "MlpPolicy"
    policy_kwargs = {"net_arch": [16]} | ({"lstm_hidden_size": 8} if algorithm is RecurrentPPO else {})
    settings: dict[str, Any] = {"n_steps": 64, "gamma": GAMMA, "gae_lambda": LAMBDA, "seed": 0} | kwargs
    if algorithm not in (A2C, TRPO):
        settings["n_epochs"] = 1
    if algorithm is not A2C:
        settings["batch_size"] = settings["n_steps"]
    return algorithm(policy, env, policy_kwargs=policy_kwargs, **settings)


@pytest.mark.parametrize("algorithm", [PPO, A2C, TRPO, MaskablePPO, RecurrentPPO])
def test_advantages_and_returns_are_exact_with_timeouts_inside_options(algorithm: Any) -> None:
    # 13 steps: the option of 7 steps is cut off by the limit again and again.
    venv = DummyVecEnv([lambda: optioned_corridor(13), lambda: optioned_corridor(17)])
    model = make(algorithm, venv)
    kept = OneRollout()
    model.learn(ENOUGH, callback=[PrimitiveStepsCallback(), kept])
    assert isinstance(kept.buffer, SMDPAdvantages)
    durations = np.array([s["durations"] for s in kept.steps])
    timeouts = np.array([s["timeout_values"] for s in kept.steps]) != 0
    assert (timeouts & (durations > 1)).sum() >= 3, "no timeout inside an option: the case is not tested"
    for env in range(2):
        expected = oracle(kept.steps, kept.last_values, env)
        values = np.array([s["values"][env] for s in kept.steps], dtype=np.float64)
        np.testing.assert_allclose(kept.buffer.advantages[:, env], [float(a) for a in expected], rtol=0, atol=1e-6)
        returns = [float(a) for a in expected] + values
        np.testing.assert_allclose(kept.buffer.returns[:, env], returns, rtol=0, atol=1e-6)


def journey(env: CountingEnv, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """A user's own steps, whose actions take times of their own: 1 or 4 steps along a line of 8."""
    place, k = min(sum((1, 4)[taken] for taken in env.actions), 8), (1, 4)[action]
    option = {"index": -1, "duration": k, "discount": GAMMA**k}
    return np.array([place / 8]), -sum(GAMMA**i for i in range(k)), place == 8, False, {"option": option}


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_a_users_own_environment_of_variable_durations(algorithm: Any) -> None:
    model = make(algorithm, CountingEnv(step=journey), n_steps=32)
    kept = OneRollout()
    model.learn(ENOUGH, callback=[PrimitiveStepsCallback(), kept])
    buffer = kept.buffer
    assert isinstance(buffer, OptionRolloutBuffer)
    actions = buffer.actions.reshape(-1)
    np.testing.assert_array_equal(buffer.durations.reshape(-1), np.where(actions == 1, 4, 1))
    np.testing.assert_allclose(buffer.discounts.reshape(-1), np.where(actions == 1, GAMMA**4, GAMMA))
    assert kept.n_steps == buffer.durations.sum()


def test_dict_observations() -> None:
    env = OptionsWrapper(Corridor("dict"), 1, gamma=GAMMA, feature_map=places)
    env.bank.add(steady_option(1, max_duration=3))
    model = PPO("MultiInputPolicy", env, n_steps=32, batch_size=32, n_epochs=1, gamma=GAMMA)
    model.learn(32, callback=PrimitiveStepsCallback())
    assert isinstance(model.rollout_buffer, OptionDictRolloutBuffer)
    assert (model.rollout_buffer.durations > 1).any()


def test_normalised_rewards_keep_the_bootstrap() -> None:
    venv = VecNormalize(DummyVecEnv([lambda: optioned_corridor(13)]), gamma=GAMMA, clip_reward=np.inf)
    model = make(PPO, venv)
    kept = OneRollout()
    model.learn(ENOUGH, callback=[PrimitiveStepsCallback(), kept])
    timeouts = np.array([s["timeout_values"] for s in kept.steps]).reshape(-1)
    plain = np.array([s["rewards"] for s in kept.steps]).reshape(-1)
    k = np.array([s["durations"] for s in kept.steps]).reshape(-1)
    rewards = kept.buffer.rewards.reshape(-1)
    np.testing.assert_allclose(rewards, plain + GAMMA**k * timeouts, rtol=1e-6, atol=1e-6)
    assert (timeouts != 0).any()


def test_without_a_callback_it_says_what_to_pass() -> None:
    model = PPO("MlpPolicy", optioned_corridor(20), n_steps=16, rollout_buffer_class=OptionRolloutBuffer, batch_size=16)
    with pytest.raises(ValueError, match=r"was not told how long the actions took: pass PrimitiveStepsCallback\(\) or"):
        model.learn(16)


def opened(env: OptionsWrapper, share: float, masks: Any = None) -> Any:
    """What MaskablePPO, with equal primitives, makes of the probabilities when it opens the options that are there."""
    model: Any = make(MaskablePPO, env)
    for parameter in model.policy.action_net.parameters():
        parameter.data.zero_()
    OptionInstaller(model, env_of(model), None, max_option_exploration=share)
    observation = torch.zeros((1, 2), device=model.device)
    return model.policy.get_distribution(observation, action_masks=masks).distribution.probs[0].detach()


@pytest.mark.parametrize(("share", "n_present"), [(0.5, 1), (0.8, 1), (0.5, 2)])
def test_an_option_opens_with_its_share_of_the_probability_where_masks_keep_it_in_its_place(
    share: float, n_present: int
) -> None:
    env = OptionsWrapper(Corridor(), 3, gamma=GAMMA)
    for _ in range(n_present):
        env.bank.add(steady_option(1))
    probabilities = opened(env, share, masks=np.array([[True, True, *[True] * n_present, *[False] * (3 - n_present)]]))
    last = share / (1.0 - share) / n_present  # odds of the option that came last against the primitives together
    assert float(probabilities[1 + n_present] / probabilities[:2].sum()) == pytest.approx(last, rel=1e-5)
    assert float(probabilities[0]) == pytest.approx(float(probabilities[1]))


@pytest.mark.parametrize(
    ("starts", "slot", "odds"),
    [((2, 5, 8), 2, 3.0), ((2, 2, 2), 2, 1.0), ((2, 3, 8), 1, 2.0)],
    ids=["disjoint", "the same", "half of it shared"],
)
def test_options_share_the_opening_odds_with_those_available_in_the_same_states(
    starts: tuple[int, ...], slot: int, odds: float
) -> None:
    """Each I is a place and the next one."""
    env = OptionsWrapper(Corridor(), 3, gamma=GAMMA, feature_map=places)
    policy = TabularPolicy(np.zeros((1, 2)), np.zeros((1, 2)))
    for place in starts:
        inside = Region(np.array([[place], [place + 1.0]]), np.ones(1), 0.1)
        env.bank.add(SubgoalOption(Region(np.array([[11.0]]), np.ones(1), 0.1), inside, policy))
    probabilities = opened(env, share=0.75)
    assert float(probabilities[2 + slot] / probabilities[:2].sum()) == pytest.approx(odds, rel=1e-5)


def test_an_untrained_model_opens_the_heads_of_options_that_are_there_a_trained_one_keeps_them() -> None:
    env = OptionsWrapper(Corridor(), 2, gamma=GAMMA)
    env.bank.add(steady_option(1))
    model: Any = make(PPO, env)
    head = model.policy.action_net
    OptionInstaller(model, env_of(model), None)
    assert torch.equal(head.weight[2], head.weight[:2].mean(dim=0))
    assert torch.equal(head.bias[2], head.bias[:2].mean(dim=0))
    model.learn(ENOUGH, callback=[PrimitiveStepsCallback(), OneRollout()])
    learned = head.weight[2].clone()
    OptionInstaller(model, env_of(model), None)
    assert torch.equal(head.weight[2], learned)
    assert not torch.equal(learned, head.weight[:2].mean(dim=0))


def rewarded_at_the_end(k: int) -> OptionsWrapper:
    """Its option reaches the goal, rewarded with 1, in k steps."""
    env = OptionsWrapper(
        CountingEnv(step=lambda env, _: (np.array([env.time / k]), float(env.time == k), env.time == k, False, {})),
        1,
        gamma=GAMMA,
    )
    env.bank.add(steady_option(1, max_duration=200))
    return env


def test_rewards_inside_options_are_normalised_before_they_are_summed() -> None:
    """A clipped sum would be the same however long the option took."""
    lengths = (1, 20, 60)
    venv = VecNormalize(DummyVecEnv([partial(rewarded_at_the_end, k) for k in lengths]), gamma=GAMMA, training=False)
    venv.ret_rms.var = np.array(1e-4)  # a reward of 1 is 100 standard deviations, and clipped at 10
    model = make(PPO, venv)
    model.learn(64, callback=PrimitiveStepsCallback())
    buffer: Any = model.rollout_buffer
    actions = buffer.actions.reshape(64, 3)
    for env, k in enumerate(lengths):
        whole = (actions[:, env] == 2) & (buffer.durations[:, env] == k)
        assert whole.any()
        np.testing.assert_allclose(buffer.rewards[whole, env], 10 * GAMMA ** (k - 1), rtol=1e-6)
