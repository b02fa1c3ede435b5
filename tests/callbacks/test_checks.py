import copy
from typing import Any, cast

import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.callbacks import CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecNormalize

from sb3_options import MacroQ, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import IntrinsicRewardCallback, PrimitiveStepsCallback, SubgoalDiscoveryCallback
from sb3_options.learning import heads
from sb3_options.learning.macro_q import OneHot
from tests.callbacks.doorway import STEPS, discovered, model_of
from tests.support.sb3_helpers import Corridor, env_of, fast_callback, optioned_rooms, small_rooms

DQN_KWARGS: dict[str, Any] = {"gamma": 0.9, "buffer_size": 200, "learning_starts": 10, "seed": 0}


def dqn(env: Any, policy: str = "MlpPolicy", **kwargs: Any) -> DQN:
    return DQN(policy, env, **DQN_KWARGS | {"replay_buffer_class": OptionReplayBuffer} | kwargs)


class OwnBuffer(RolloutBuffer):
    """A user's own."""


class OwnReplay(ReplayBuffer):
    """A user's own."""


@pytest.mark.parametrize(
    ("model", "text"),
    [
        (
            lambda: dqn(small_rooms(), replay_buffer_class=None),
            r"The model's environment is not wrapped in OptionsWrapper: use OptionsWrapper\(env, max_options=",
        ),
        (
            lambda: dqn(DummyVecEnv([optioned_rooms, lambda: OptionsWrapper(small_rooms(), gamma=0.95)])),
            r"OptionsWrapper discounts with gamma=0\.95, DQN with gamma=0\.9: give both the same",
        ),
        (
            lambda: dqn(optioned_rooms(), replay_buffer_class=OwnReplay),
            r"DQN was built with OwnReplay, .*: pass DQN\(\.\.\., replay_buffer_class=OptionReplayBuffer\)",
        ),
        (
            lambda: dqn(optioned_rooms(), gamma=0.95),
            r"OptionsWrapper discounts with gamma=0\.9, DQN with gamma=0\.95: give both the same",
        ),
        (
            lambda: dqn(OptionsWrapper(Corridor("dict"), gamma=0.9), "MultiInputPolicy"),
            r"no default feature map for Dict\(.*: pass OptionsWrapper\(env, feature_map=\.\.\.\)",
        ),
        (
            lambda: PPO("MlpPolicy", optioned_rooms(), gamma=0.9, rollout_buffer_class=OwnBuffer),
            r"PPO was built with OwnBuffer, .*: derive a class from \(SMDPAdvantages, OwnBuffer\)",
        ),
    ],
    ids=["bare", "one-gamma-differs", "buffer", "gamma", "Dict", "rollouts"],
)
def test_says_what_to_change(model: Any, text: str) -> None:
    built: BaseAlgorithm = model()
    with pytest.raises(ValueError, match=text):
        built.learn(20, callback=SubgoalDiscoveryCallback())


def test_the_class_is_no_callback() -> None:
    with pytest.raises(TypeError, match="is a class: pass an object, callback=SubgoalDiscoveryCallback"):
        dqn(optioned_rooms()).learn(20, callback=cast("Any", SubgoalDiscoveryCallback))


@pytest.mark.parametrize("callback", [SubgoalDiscoveryCallback, PrimitiveStepsCallback])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_a_stock_replay_buffer_is_replaced(callback: Any, n_steps: int) -> None:
    stock = dqn(optioned_rooms(), replay_buffer_class=None, n_steps=n_steps).learn(100, callback=callback())
    ours = dqn(optioned_rooms(), replay_buffer_kwargs={"n_steps": n_steps}).learn(100, callback=callback())
    assert isinstance(stock.replay_buffer, OptionReplayBuffer)
    assert stock.replay_buffer.n_steps == n_steps
    for mine, theirs in zip(stock.policy.parameters(), ours.policy.parameters(), strict=True):
        assert torch.equal(mine, theirs)


def test_a_stock_replay_buffer_that_saves_memory_or_holds_options_is_not_replaced() -> None:
    kwargs = {"handle_timeout_termination": False}
    saves = dqn(optioned_rooms(), replay_buffer_class=None, optimize_memory_usage=True, replay_buffer_kwargs=kwargs)
    for model in (saves, dqn(optioned_rooms(), replay_buffer_class=None).learn(20)):
        with pytest.raises(ValueError, match=r"DQN was built with ReplayBuffer, .*: pass DQN"):
            model.learn(20, callback=PrimitiveStepsCallback())


def test_a_limit_of_runs_in_a_continuing_task_is_refused() -> None:
    limited = OptionsWrapper(small_rooms(), gamma=0.9, max_runs=3)
    with pytest.raises(ValueError, match="max_runs counts in an episode, and a continuing task has none"):
        dqn(limited).learn(20, callback=SubgoalDiscoveryCallback({"segmentation": "peaks"}))


@pytest.mark.parametrize(
    ("evaluation", "text"),
    [
        (small_rooms, "The environment of EvalCallback is not wrapped in OptionsWrapper: use"),
        (
            lambda: optioned_rooms(3),
            r"EvalCallback has actions Discrete\(7\), the training environment Discrete\(8\): give both the same max",
        ),
    ],
)
def test_another_evaluation_environment_is_refused(evaluation: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        dqn(optioned_rooms(4)).learn(20, callback=[SubgoalDiscoveryCallback(), EvalCallback(evaluation())])


def test_what_changes_observations_above_the_options_is_refused() -> None:
    class Halved(VecEnvWrapper):
        def reset(self) -> Any:
            return np.asarray(self.venv.reset()) / 2

        def step_wait(self) -> Any:
            observations, *others = self.venv.step_wait()
            return (np.asarray(observations) / 2, *others)

    scaled = Halved(DummyVecEnv([optioned_rooms]), observation_space=spaces.Box(0.0, 0.5, (45,)))
    with pytest.raises(ValueError, match=r"observations change from Box.* to Box.*: put what changes them beneath"):
        dqn(scaled).learn(10, callback=SubgoalDiscoveryCallback())


@pytest.mark.parametrize("callback", [SubgoalDiscoveryCallback, PrimitiveStepsCallback, IntrinsicRewardCallback])
def test_a_callback_that_does_not_see_every_step_is_refused(callback: Any) -> None:
    model = PPO("MlpPolicy", optioned_rooms(), gamma=0.9, n_steps=16, batch_size=16)
    with pytest.raises(ValueError, match=f"^{callback.__name__} is inside another callback, .*: pass it to learn"):
        model.learn(20, callback=[EveryNTimesteps(500, callback())])
    model.learn(20, callback=CallbackList([CallbackList([callback()])]))


@pytest.mark.parametrize("callback", [SubgoalDiscoveryCallback, PrimitiveStepsCallback])
def test_a_clip_of_summed_rewards_is_refused(callback: Any) -> None:
    def normalized(**kwargs: Any) -> VecNormalize:
        return VecNormalize(DummyVecEnv([optioned_rooms]), gamma=0.9, **kwargs)

    text = r"^VecNormalize clips the reward of a whole option at 10\.0, .+ clip_reward to np\.inf, .+ norm_reward=False"
    with pytest.raises(ValueError, match=text):
        dqn(normalized()).learn(20, callback=callback())
    dqn(normalized(clip_reward=np.inf)).learn(20, callback=callback())
    dqn(normalized(norm_reward=False)).learn(20, callback=callback())
    with pytest.raises(ValueError, match=r"^MacroQ learns from the steps inside options.+leave VecNormalize out\.$"):
        MacroQ(normalized(), gamma=0.9, features=OneHot(45, coded=True)).learn(20, callback=callback())


def test_masks_of_the_environments_own_actions_are_refused_above_options() -> None:
    masked = ActionMasker(optioned_rooms(2), lambda _: np.ones(4, dtype=bool))
    model = MaskablePPO("MlpPolicy", masked, gamma=0.9, n_steps=16, batch_size=16)
    text = r"action_masks\(\) has shape \(4,\), and there are 6 actions .* beneath, Option"
    with pytest.raises(ValueError, match=text):
        model.learn(16, callback=SubgoalDiscoveryCallback())


def test_a_rule_that_says_no_in_words_ends_training() -> None:
    callback = SubgoalDiscoveryCallback(success=lambda _: "no")  # type: ignore[arg-type, return-value]
    with pytest.raises(TypeError, match="success must return True or False, got 'no'"):
        dqn(optioned_rooms(2)).learn(1000, callback=callback)


def test_the_options_of_a_training_are_changed_in_its_environments() -> None:
    """What the callback tells is a copy; between trainings the environments count."""
    callback = fast_callback()
    env = optioned_rooms(2)
    model = model_of(env)
    model.learn(STEPS, callback=callback)
    assert callback.bank.filled
    slot = callback.bank.filled[0]
    callback.bank.remove(slot)
    assert slot in callback.bank.filled
    renamed = copy.copy(discovered(callback.bank, slot))
    renamed.name = "mine"
    venv = env_of(model)
    venv.env_method("set_option", slot, renamed)
    model.learn(200, callback=callback, reset_num_timesteps=False)
    assert callback.bank[slot].name == env.bank[slot].name == "mine"  # type: ignore[union-attr]  # filled
    for each in env.bank.filled:
        venv.env_method("set_option", each, None)
    callback.max_new_options = 0
    model.learn(200, callback=callback, reset_num_timesteps=False)
    assert not callback.bank.filled
    assert not env.bank.filled
    assert heads.is_closed(model.policy, env.n_primitive + slot)
    assert not callback._keeper.made


def test_a_second_discovery_is_refused() -> None:
    with pytest.raises(ValueError, match="compete for trajectories and slots: pass only one"):
        dqn(optioned_rooms()).learn(10, CallbackList([fast_callback(), SubgoalDiscoveryCallback(method="random")]))
