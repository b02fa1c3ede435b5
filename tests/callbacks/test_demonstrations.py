"""Options, and a policy's warm start, from demonstrations."""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from sb3_contrib import QRDQN, TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack, VecNormalize

from sb3_options import (
    MacroQ,
    OptionDQN,
    OptionsWrapper,
    load_demonstrations,
    logged_trajectory,
    record_demonstrations,
    save_demonstrations,
)
from sb3_options.callbacks import CheckpointCallback, SubgoalDiscoveryCallback, discover
from sb3_options.experience.trajectories import Trajectory
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import SubgoalOption
from tests.callbacks.test_checkpoint_resuming import check_resumes, model_of, trained, venv_of
from tests.support.documents import ROOT, python_of
from tests.support.helpers import equal, steady_option, trajectory_of
from tests.support.sb3_helpers import DOORWAY, FAST_DISCOVERY, make_optioned_rooms, optioned_rooms, small_rooms

GUIDE = ROOT / "docs" / "guide" / "demonstrations.md"
WIDTH = 9
UP, DOWN, LEFT, RIGHT = range(4)


def to_the_goal(observation: Any) -> int:
    """The way through the doorway of the small rooms."""
    y, x = divmod(int(np.argmax(observation)), WIDTH)
    doorway = int(DOORWAY[1])
    if x < DOORWAY[0] and y != doorway:
        return UP if y > doorway else DOWN
    return RIGHT if x < WIDTH - 1 else DOWN


def by_the_wall(observation: Any) -> int:
    """A longer way, along the left and the lower wall of the first room."""
    y, x = divmod(int(np.argmax(observation)), WIDTH)
    if x >= DOORWAY[0] - 1:
        return to_the_goal(observation)
    if y == 4:
        return RIGHT
    return LEFT if x > 0 else DOWN


@pytest.fixture(scope="module")
def shown() -> list[Trajectory]:
    return record_demonstrations(small_rooms(), to_the_goal, 12)


@pytest.fixture(autouse=True)
def few_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_options.callbacks.cloning.UPDATES", 200)


def callback(given: Any, **kwargs: Any) -> SubgoalDiscoveryCallback:
    return SubgoalDiscoveryCallback(FAST_DISCOVERY, max_new_options=1, demonstrations=given, **kwargs)


def ends_at_once() -> BaseCallback:
    """Ends training in the first step."""
    return ConvertCallback(lambda *_: False)


def test_episodes_of_a_policy_are_recorded_in_primitive_steps(shown: list[Trajectory]) -> None:
    assert len(shown) == 12
    assert all(each.is_success and each.terminated and each.rewards[-1] > 0 for each in shown)
    starts = {int(np.argmax(np.asarray(each.states)[0])) for each in shown}
    assert len(starts) > 3  # another seed for each episode
    again = record_demonstrations(small_rooms(), to_the_goal, 2, seed=1)
    assert equal(again[0].visits, shown[1].visits)


def test_a_model_shows_too_and_its_options_are_recorded_as_primitives() -> None:
    env = optioned_rooms(1)
    env.set_option(0, steady_option(RIGHT, max_duration=3))
    model = DQN("MlpPolicy", env, buffer_size=1, seed=0)
    model.predict = lambda *_, **__: (np.array(4), None)  # type: ignore[method-assign]
    (trajectory,) = record_demonstrations(env, model, 1)
    assert set(trajectory.actions.tolist()) == {RIGHT}
    assert len(trajectory) == 150


class RightOnly(gym.Wrapper[Any, Any, Any, Any]):
    """Refuses any action but one."""

    def action_masks(self) -> Any:
        return np.arange(4) == RIGHT

    def step(self, action: Any) -> Any:
        assert action == RIGHT
        return super().step(action)


def test_a_model_chooses_among_the_actions_that_the_environment_allows() -> None:
    env = OptionsWrapper(RightOnly(small_rooms()), 1, gamma=0.9)
    models = [
        MaskablePPO("MlpPolicy", env, seed=0),
        OptionDQN("MlpPolicy", env, gamma=0.9, buffer_size=1, seed=0),
        MaskablePPO("MlpPolicy", RightOnly(small_rooms()), seed=0),  # without slots
    ]
    for model in models:
        (trajectory,) = record_demonstrations(env, model, 1)
        assert set(trajectory.actions.tolist()) == {RIGHT}


def test_a_model_that_does_not_fit_the_environment_is_refused() -> None:
    with pytest.raises(ValueError, match="has 5 actions, the environment fewer"):
        record_demonstrations(small_rooms(), DQN("MlpPolicy", optioned_rooms(1), buffer_size=1), 1)
    stacked = VecNormalize(VecFrameStack(make_vec_env(small_rooms), 2))
    with pytest.raises(ValueError, match=r"The model sees Box\(.*\(90,\).*returns Box\(.*\(45,\)"):
        record_demonstrations(small_rooms(), PPO("MlpPolicy", stacked), 1)


def test_any_object_that_predicts_is_a_policy() -> None:
    class Right:
        def predict(self, observation: Any) -> Any:
            return RIGHT, None

    (trajectory,) = record_demonstrations(small_rooms(), Right(), 1)
    assert set(trajectory.actions.tolist()) == {RIGHT}


def test_a_model_keeps_its_memory_in_an_episode_and_sees_normalised_observations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    venv = VecNormalize(make_vec_env(small_rooms), norm_reward=False)
    venv.reset()
    venv.step(np.array([RIGHT]))
    model = RecurrentPPO("MlpLstmPolicy", venv, gamma=0.9, seed=0)
    predict = model.predict
    seen: list[tuple[Any, Any, Any]] = []

    def watched(observation: Any, state: Any, episode_start: Any) -> Any:
        seen.append((observation, state, episode_start))
        return predict(observation, state, episode_start)

    monkeypatch.setattr(model, "predict", watched)
    shown = record_demonstrations(small_rooms(), model, 2)
    begins = np.cumsum([0, *map(len, shown)])[:-1].tolist()
    assert [at for at, (_, state, _) in enumerate(seen) if state is None] == begins
    assert [at for at, (*_, start) in enumerate(seen) if start.tolist() == [True]] == begins
    assert any(np.any(state[0]) for _, state, _ in seen[1:3])
    first = np.asarray(shown[0].states)[shown[0].visits[0]]
    normalised: Any = venv.normalize_obs(first)
    assert np.array_equal(seen[0][0], normalised)
    assert not np.array_equal(seen[0][0], first)


@pytest.mark.parametrize("algorithm", [DQN, PPO, MaskablePPO])
def test_options_are_there_before_the_first_step(shown: list[Trajectory], algorithm: type[BaseAlgorithm]) -> None:
    env = make_vec_env(optioned_rooms, 2, seed=0)
    discovery = callback(shown)
    algorithm("MlpPolicy", env, gamma=0.9, seed=0).learn(1000, [discovery, ends_at_once()])  # type: ignore[call-arg]
    (found,) = discovery.discoveries
    assert (found.episode, found.timestep) == (0, 0)
    assert np.abs(found.subgoal - DOORWAY).sum() <= 1.0
    assert [len(bank) for bank in env.get_attr("bank")] == [1, 1]
    assert discovery.episodes == 0  # none of training


def test_training_goes_on_from_a_reset_after_random_failures(
    shown: list[Trajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_options.callbacks.demonstrated.FAILURES", 4)
    workers = SubprocVecEnv([make_optioned_rooms] * 2, start_method="fork")
    env = VecNormalize(workers, norm_reward=False)
    try:
        discovery = callback(shown)
        model = PPO("MlpPolicy", env, gamma=0.9, n_steps=64, batch_size=64, seed=0)
        model.learn(256, discovery)
        assert discovery.discoveries[0].timestep == 0
        assert discovery.discovery is not None
        assert len(discovery.discovery.database) == len(shown) + 4 + discovery.episodes
        walks = [each.trajectory for each in discovery.discovery.database if each.trajectory.truncated][:4]
        assert {len(each) for each in walks} == {max(map(len, shown))}
        # A random policy reaches the goal of small rooms, too: then it is no failure.
        assert {each.success for each in discovery.discovery.database} == {True, False}
        assert all(each.success == bool(each.trajectory.is_success) for each in discovery.discovery.database)
    finally:
        env.close()


def test_a_walk_that_was_cut_off_is_a_failure(shown: list[Trajectory]) -> None:
    """A return of at least −100 is easily had in a few steps."""
    env = optioned_rooms()
    discovery = SubgoalDiscoveryCallback(
        FAST_DISCOVERY, demonstrations=shown, success=lambda trajectory: len(trajectory) < 100, max_new_options=1
    )
    PPO("MlpPolicy", env, gamma=0.9, n_steps=64, batch_size=64, seed=0).learn(1, [discovery, ends_at_once()])
    assert discovery.discovery is not None
    walks = [each for each in discovery.discovery.database if each.trajectory.truncated]
    assert len(walks) > 5
    assert not any(each.success for each in walks)


def test_random_actions_are_those_that_the_environment_allows() -> None:
    class OnlyUp(gym.Wrapper[Any, Any, Any, Any]):
        def action_masks(self) -> Any:
            return np.array([True, False, False, False])

    (walk,) = OptionsWrapper(OnlyUp(small_rooms()), 1).random_trajectories(1, 50, 0)
    assert walk.actions.tolist() == [UP] * 50
    assert (walk.terminated, walk.truncated) == (False, True)


def cloned(model: Any, given: list[Trajectory], **kwargs: Any) -> SubgoalDiscoveryCallback:
    """What a training knew before its first step."""
    discovery = SubgoalDiscoveryCallback(FAST_DISCOVERY, demonstrations=given, **kwargs)
    model.learn(1, [discovery, ends_at_once()])
    return discovery


def decisions_of(model: Any, env: Any, n_episodes: int) -> list[list[int]]:
    """Greedy decisions of some episodes, at most 20 in each."""
    episodes = []
    for seed in range(n_episodes):
        observation, _ = env.reset(seed=seed)
        ended = False
        taken: list[int] = []
        while not ended and len(taken) < 20:
            seen = observation
            if (normalizer := model.get_vec_normalize_env()) is not None:
                seen = normalizer.normalize_obs(observation)
            masks = {"action_masks": env.action_masks()} if isinstance(model, MaskablePPO | OptionDQN) else {}
            taken.append(int(model.predict(seen, deterministic=True, **masks)[0]))
            observation, _, ended, *_ = env.step(taken[-1])
        episodes.append(taken if ended else [])
    return episodes


@pytest.mark.parametrize(
    ("algorithm", "most"),
    [*((each, 1) for each in (PPO, A2C, TRPO, MaskablePPO, DQN, QRDQN, OptionDQN)), (PPO, 0), (OptionDQN, 0)],
)
def test_a_policy_begins_with_the_decisions_of_the_demonstrations(
    shown: list[Trajectory], monkeypatch: pytest.MonkeyPatch, algorithm: type[BaseAlgorithm], most: int
) -> None:
    env = optioned_rooms(1)
    how: dict[str, Any] = {"learning_rate": 0.003} if issubclass(algorithm, DQN | QRDQN) else {}
    if algorithm is QRDQN:
        monkeypatch.setattr("sb3_options.callbacks.cloning.UPDATES", 1000)
        how["policy_kwargs"] = {"n_quantiles": 25}
    model = algorithm("MlpPolicy", env, gamma=0.9, seed=0, **how)  # type: ignore[call-arg]
    assert len(cloned(model, shown, max_new_options=most).bank) == most
    episodes = decisions_of(model, env, len(shown))
    assert all(episodes)  # reach the goal
    assert sum(4 in taken for taken in episodes) >= 6 * most
    steps, decisions = sum(map(len, shown)), sum(map(len, episodes))
    assert decisions < 0.8 * steps if most else decisions == steps


def test_cloning_can_be_left_out(shown: list[Trajectory]) -> None:
    model = PPO("MlpPolicy", optioned_rooms(1), gamma=0.9, seed=0)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    cloned(model, shown, clone=False, max_new_options=0)
    after = model.policy.state_dict()
    assert all(equal(before[name].numpy(), after[name].numpy()) for name in before if "action_net" not in name)


@pytest.mark.parametrize(
    ("settled", "many", "clone", "stays"),
    [(0.7, 12, True, True), (1.1, 12, True, False), (0.7, 13, True, False), (0.7, 12, False, False)],
)
def test_options_of_a_cloned_policy_that_succeeds_are_not_learned_anew(
    shown: list[Trajectory], monkeypatch: pytest.MonkeyPatch, settled: float, many: int, clone: bool, stays: bool
) -> None:
    monkeypatch.setattr("sb3_options.callbacks.discovery.SETTLED", settled)
    monkeypatch.setattr("sb3_options.callbacks.discovery.MANY", many)
    discovery = callback(shown, clone=clone)
    model = PPO("MlpPolicy", optioned_rooms(1), gamma=0.9, n_steps=64, batch_size=64, seed=0)
    model.learn(64, [discovery, ends_at_once()])
    cloned_on = discovery.bank[0]
    model.learn(1_500, discovery, reset_num_timesteps=False)
    assert isinstance(cloned_on, SubgoalOption)
    later = discovery.bank[0]
    assert isinstance(later, SubgoalOption)
    assert (later.option_policy is cloned_on.option_policy) == stays


def test_normalized_observations_are_cloned_as_the_policy_sees_them(shown: list[Trajectory]) -> None:
    env = VecNormalize(make_vec_env(optioned_rooms, 1, seed=0), norm_reward=False)
    model = PPO("MlpPolicy", env, gamma=0.9, seed=0)
    cloned(model, shown, max_new_options=0)
    assert all(decisions_of(model, optioned_rooms(1), len(shown)))


def test_observations_of_several_parts_are_cloned() -> None:
    class Parts(gym.ObservationWrapper[Any, Any, Any]):
        def __init__(self) -> None:
            super().__init__(small_rooms())
            self.observation_space = gym.spaces.Dict({"place": self.env.observation_space})

        def observation(self, observation: Any) -> Any:
            return {"place": observation}

        def concept_features(self, observations: Any) -> Any:
            return observations["place"]

    given = record_demonstrations(Parts(), lambda seen: to_the_goal(seen["place"]), 12)
    env = OptionsWrapper(Parts(), 1, gamma=0.9)
    model = PPO("MultiInputPolicy", env, gamma=0.9, seed=0)
    cloned(model, given, max_new_options=0)
    assert all(decisions_of(model, env, len(given)))


def test_stacked_frames_cannot_be_cloned(shown: list[Trajectory]) -> None:
    env = VecFrameStack(make_vec_env(optioned_rooms, 1, seed=0), 2)
    model = PPO("MlpPolicy", env, gamma=0.9, seed=0)
    with pytest.raises(ValueError, match=r"single frames.*or pass .*clone=False"):
        cloned(model, shown, max_new_options=0)
    cloned(model, shown, max_new_options=0, clone=False)


@pytest.mark.parametrize(
    "learner", [lambda env: RecurrentPPO("MlpLstmPolicy", env, gamma=0.9), lambda env: MacroQ(env, gamma=0.9)]
)
def test_other_learners_are_given_options_alone(shown: list[Trajectory], learner: Any) -> None:
    assert len(cloned(learner(optioned_rooms(1)), shown).bank) == 1


def values_model(**kwargs: Any) -> OptionDQN:
    how = {"learning_rate": 0.003, "learning_starts": 0, "exploration_initial_eps": 0.05, **kwargs}
    return OptionDQN("MlpPolicy", optioned_rooms(1), gamma=0.9, seed=0, **how)


def test_demonstrations_are_in_the_replay_buffer_as_decisions(shown: list[Trajectory]) -> None:
    model = values_model()
    bank = cloned(model, shown, max_new_options=1).bank
    buffer: Any = model.replay_buffer
    named = buffer.actions[: buffer.size(), 0] == 4
    n_steps = sum(map(len, shown))
    assert named.sum() >= 6
    assert buffer.size() - named.sum() == n_steps  # steps inside options, too
    rows = np.flatnonzero(named)
    option = bank[0]
    assert isinstance(option, SubgoalOption)
    assert option.subgoal.contains(option.features(buffer._next_observations[""][rows])).all()
    durations = np.log(buffer.discounts[rows]) / np.log(0.9)
    assert np.allclose(durations, np.round(durations), atol=1e-4)
    assert durations.max() > 1.5
    ends = buffer.dones[: n_steps + len(rows)]
    assert ends.sum() >= len(shown)
    assert buffer.rewards[: len(ends)][ends > 0].tolist() == [1.0] * int(ends.sum())


def hooks(model: Any) -> int:
    return len(model.policy.optimizer._optimizer_step_pre_hooks)


@pytest.mark.parametrize("stays", [True, False])
def test_the_margin_stays_in_every_update_until_training_ends(shown: list[Trajectory], stays: bool) -> None:
    model = values_model(max_grad_norm=0.0)  # the gradient of DQN's own loss is cut to nothing
    discovery = callback(shown)
    model.learn(1, [discovery, ends_at_once()])
    assert not hooks(model)
    if not stays:
        discovery._margin = None
    before = [each.clone() for each in model.policy.q_net.parameters()]
    model.policy.optimizer.state.clear()  # Adam's moments would move them on
    model.learn(64, discovery, reset_num_timesteps=False)
    moved = any(not torch.equal(a, b) for a, b in zip(before, model.policy.q_net.parameters(), strict=True))
    assert moved == stays
    assert not hooks(model)


def test_an_agent_becomes_better_than_its_demonstrations() -> None:
    given = record_demonstrations(small_rooms(success_probability=1.0), by_the_wall, 12)
    env = OptionsWrapper(small_rooms(success_probability=1.0), 0, gamma=0.9)
    how: dict[str, Any] = {"learning_rate": 0.003, "learning_starts": 0, "target_update_interval": 100}
    model = OptionDQN("MlpPolicy", env, gamma=0.9, seed=0, **how, exploration_fraction=0.5)
    shown_steps = float(np.mean(list(map(len, given))))
    discovery = SubgoalDiscoveryCallback(FAST_DISCOVERY, max_new_options=0, demonstrations=given)
    model.learn(1, [discovery, ends_at_once()])
    at_first = np.mean([len(taken) for taken in decisions_of(model, env, 12)])
    assert at_first == pytest.approx(shown_steps, abs=0.5)
    model.learn(6_000, discovery)
    later = [len(taken) for taken in decisions_of(model, env, 12)]
    assert all(later)  # reach the goal
    assert np.mean(later) < shown_steps - 1


@pytest.mark.parametrize("in_update", [True, False])
def test_an_interrupt_leaves_at_most_one_margin(shown: list[Trajectory], in_update: bool) -> None:
    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    def interrupts(*_: Any) -> bool:
        if model.num_timesteps >= 8 and not in_update:
            raise KeyboardInterrupt
        if model.num_timesteps >= 8:
            model.policy.q_net.register_forward_hook(stop)
        return True

    model = values_model()
    discovery = callback(shown)
    with pytest.raises(KeyboardInterrupt):
        model.learn(64, [discovery, ConvertCallback(interrupts)])
    model.policy.q_net._forward_hooks.clear()
    assert hooks(model) <= in_update
    model.learn(32, discovery, reset_num_timesteps=False)
    assert not hooks(model)


def test_a_margin_follows_the_model_and_its_statistics(shown: list[Trajectory], tmp_path: Path) -> None:
    model = values_model()
    discovery = callback(shown)
    model.learn(8, discovery)
    model.save(tmp_path / "model.zip")
    env = VecNormalize(make_vec_env(lambda: optioned_rooms(1), 1, seed=0), gamma=0.9, clip_reward=np.inf)
    later = OptionDQN.load(tmp_path / "model.zip", env)
    margin = discovery._margin
    assert margin is not None
    later.learn(8, [discovery, ends_at_once()], reset_num_timesteps=False)
    assert margin.model is later
    statistics: Any = env.obs_rms
    statistics.mean[:] = 5.0
    assert margin._batch(8)[0].max() < 0


def test_rewards_are_normalised_by_the_returns_of_the_demonstrations(shown: list[Trajectory]) -> None:
    env = VecNormalize(make_vec_env(optioned_rooms, 1, seed=0), gamma=0.9, clip_reward=np.inf)
    model = OptionDQN("MlpPolicy", env, gamma=0.9, seed=0)
    cloned(model, shown, max_new_options=0)
    assert env.ret_rms.count > sum(map(len, shown)) - 1
    assert env.ret_rms.var == pytest.approx(len(shown) / sum(map(len, shown)), rel=0.2)  # a one at each end


def test_a_frozen_layer_stays_as_it_is(shown: list[Trajectory]) -> None:
    model = values_model()
    first: Any = model.policy.q_net.q_net[0]
    first.weight.requires_grad_(False)
    before = first.weight.clone()
    cloned(model, shown, max_new_options=0)
    assert torch.equal(first.weight, before)


def test_decisions_follow_the_options(shown: list[Trajectory]) -> None:
    model = values_model()
    margin = cloned(model, shown, max_new_options=1)._margin
    assert margin is not None
    assert (margin._actions == 4).any()
    margin.bank.remove(0)
    margin.loss()
    assert not (margin._actions == 4).any()


def test_images_are_stored_as_the_network_sees_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_options.callbacks.cloning.UPDATES", 5)
    env = gym.make("sb3_options/TwoRooms-v0", observation="image", max_steps=40)
    shown = record_demonstrations(env, lambda _: RIGHT, 3)
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", observation="image", max_steps=40), 1, gamma=0.9)
    model = DQN("CnnPolicy", env, gamma=0.9, seed=0, buffer_size=200, policy_kwargs={"net_arch": [8]})
    cloned(model, shown, max_new_options=0, success=lambda _: True)
    buffer: Any = model.replay_buffer
    stored = buffer._observations[""][: len(shown[0])]
    assert np.array_equal(stored.transpose(0, 2, 3, 1), np.asarray(shown[0].states)[shown[0].visits[:-1]])


@pytest.mark.usefixtures("keep_all")
def test_a_checkpoint_of_a_training_without_demonstrations_is_refused(shown: list[Trajectory], tmp_path: Path) -> None:
    trained(lambda: model_of("DQN", venv_of()), [callback(None), CheckpointCallback(tmp_path / "a", 50)], steps=120)
    file = sorted((tmp_path / "a").glob("0*"))[0]
    again = [callback(shown), CheckpointCallback(tmp_path / "b", 50)]
    with pytest.raises(ValueError, match="pass SubgoalDiscoveryCallback the same demonstrations and clone"):
        trained(lambda: model_of("DQN", venv_of()), again, resume=file, steps=120)


@pytest.mark.usefixtures("keep_all")
@pytest.mark.parametrize("name", ["PPO", "OptionDQN"])  # whose policies are cloned, and whose margin stays
def test_a_training_with_demonstrations_goes_on_as_if_never_ended(
    shown: list[Trajectory], tmp_path: Path, name: str
) -> None:
    check_resumes(lambda: model_of(name, venv_of()), lambda: [callback(shown)], tmp_path, steps=900)


def test_options_without_training(shown: list[Trajectory], tmp_path: Path) -> None:
    env = optioned_rooms()
    bank = discover(shown, env, settings=FAST_DISCOVERY, max_new_options=1)
    assert len(bank) == len(env.bank) == 1
    bank.save(tmp_path / "options.safetensors")
    assert len(OptionsWrapper(small_rooms(), gamma=0.9, options_file=tmp_path / "options.safetensors").bank) == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"actions": np.full(3, 4)},
        {"actions": np.full(3, -1)},
        {"rewards": np.array([0.0, np.nan, 1.0])},
        {"states": np.zeros((4, 7), np.float32)},
        {"states": {"place": np.zeros((4, 45), np.float32)}},
        {"states": np.full((4, 45), np.nan, np.float32)},
        {"visits": np.array([0, 1, 2, 4])},
        {"visits": np.arange(3)},
        {"visits": np.array([1, 0, 2, 3])},
        {"visits": np.array([0, 1, 2, 2])},
        {"rewards": np.zeros(4)},
    ],
)
def test_demonstrations_that_do_not_fit_are_refused(shown: list[Trajectory], wrong: dict[str, Any]) -> None:
    good = trajectory_of([np.eye(45, dtype=np.float32)[i] for i in range(4)], is_success=True)
    with pytest.raises(ValueError, match=r"Demonstration 1 does not fit .* Box\(0.0, 1.0.* from 0 to 3"):
        discover([shown[0], dataclasses.replace(good, **wrong)], optioned_rooms())


def test_demonstrations_without_a_success_or_of_another_type_are_refused() -> None:
    failed = trajectory_of([np.eye(45, dtype=np.float32)[i] for i in range(4)], is_success=False)
    with pytest.raises(ValueError, match="None of the 1 demonstrations succeeded"):
        discover([failed], optioned_rooms())
    with pytest.raises(TypeError, match="record_demonstrations"):
        discover([failed.actions], optioned_rooms())  # type: ignore[list-item]
    for env in (small_rooms(), optioned_rooms(0), make_vec_env(optioned_rooms)):
        with pytest.raises(ValueError, match=r"pass OptionsWrapper\(env, max_options=4\)"):
            discover([failed], env)  # type: ignore[arg-type]


@pytest.mark.parametrize("as_list", [True, False])
def test_a_log_gives_the_trajectory_that_was_recorded(shown: list[Trajectory], as_list: bool) -> None:
    for each in shown:
        log: Any = np.asarray(each.states)[each.visits]
        again = logged_trajectory(
            list(log) if as_list else log, each.actions, each.rewards, terminated=True, is_success=True
        )
        assert all(equal(getattr(again, field), value) for field, value in vars(each).items())


def test_a_log_of_a_dictionary_space_is_read() -> None:
    log = {"place": np.array([[1], [2], [1]])}
    again = logged_trajectory(log, [0, 1], [0.0, 0.0], terminated=False)
    assert equal(again.states, {"place": np.array([[1], [2]])})
    assert equal(again.visits, np.array([0, 1, 0]))
    assert again.truncated


@pytest.mark.parametrize(("n_actions", "n_rewards", "n_observations"), [(1, 1, 3), (2, 1, 3), (1, 2, 3), (0, 0, 1)])
def test_a_log_that_misses_a_step_is_refused(n_actions: int, n_rewards: int, n_observations: int) -> None:
    with pytest.raises(ValueError, match=rf"T \+ 1 observations.*; got {n_actions}, {n_rewards} and {n_observations}"):
        logged_trajectory(np.zeros((n_observations, 2)), [0] * n_actions, [0.0] * n_rewards, terminated=False)


def test_actions_of_a_log_are_whole_numbers() -> None:
    with pytest.raises(TypeError, match="integer"):
        logged_trajectory(np.zeros((2, 2)), [0.7], [0.0], terminated=False)  # type: ignore[list-item]


def test_the_guide_reads_a_data_set_of_minari(
    shown: list[Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("h5py", reason="needs Minari: pip install .[minari]")
    minari = pytest.importorskip("minari", reason="needs Minari: pip install .[minari]")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episodes = [
        minari.data_collector.EpisodeBuffer(
            observations=list(np.asarray(each.states)[each.visits]),
            actions=list(each.actions),
            rewards=list(each.rewards),
            terminations=[*[False] * (len(each) - 1), True],
            truncations=[False] * len(each),
            infos={},
        )
        for each in shown
    ]
    rooms = small_rooms()
    spaces = {"observation_space": rooms.observation_space, "action_space": rooms.action_space}
    with warnings.catch_warnings(action="ignore"):  # it asks for an author, a licence and the like
        minari.create_dataset_from_buffers("rooms/expert-v0", episodes, **spaces)
    _, program = python_of(GUIDE, "py")
    read: dict[str, Any] = {}
    exec(program, read)
    assert [each.visits.tolist() for each in read["shown"]] == [each.visits.tolist() for each in shown]
    assert len(discover(read["shown"], optioned_rooms(), settings=FAST_DISCOVERY))


def test_a_person_plays_as_in_the_guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With real events in the queue of a window that nobody sees; the last one closes it."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.chdir(tmp_path)
    pygame = pytest.importorskip("pygame", reason="needs MiniGrid: pip install .[minigrid]")
    actions = pytest.importorskip("minigrid.core.actions").Actions
    program, _ = python_of(GUIDE, "py")
    assert "DoorKey-5x5" in program
    assert "episodes=5" in program
    pygame.display.init()
    for key in [pygame.K_UP, pygame.K_a, pygame.K_UP, pygame.K_RIGHT, pygame.K_UP, pygame.K_UP]:
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    played: dict[str, Any] = {}
    with warnings.catch_warnings(action="ignore"):  # pygame looks for fonts that this machine may lack
        exec(program.replace("DoorKey-5x5", "Empty-5x5").replace("episodes=5", "episodes=1"), played)
    (shown,) = load_demonstrations("played.safetensors")
    assert shown.is_success
    assert shown.actions.tolist() == [2, 2, 1, 2, 2]  # K_a means nothing
    with pytest.raises(SystemExit, match="closed"):
        played["player"](None)
    played["task"].close()
    named = [played["KEYS"][key] for key in (pygame.K_LEFT, pygame.K_RIGHT, pygame.K_UP, pygame.K_p, pygame.K_SPACE)]
    assert named == [actions.left, actions.right, actions.forward, actions.pickup, actions.toggle]


def test_a_file_holds_the_same_trajectories_and_a_damaged_one_is_refused(
    shown: list[Trajectory], tmp_path: Path
) -> None:
    path = tmp_path / "demonstrations.safetensors"
    save_demonstrations(path, shown)
    for read, written in zip(load_demonstrations(path), shown, strict=True):
        assert all(equal(getattr(read, field), value) for field, value in vars(written).items())
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match="holds no demonstrations, or it is damaged"):
        load_demonstrations(path)
    save_demonstrations(path, [shown[0], "no trajectory"])  # type: ignore[list-item]
    with pytest.raises(ValueError, match="something other than trajectories"):
        load_demonstrations(path)
    OptionBank(4, 1).save(path)
    with pytest.raises(ValueError, match="its format is"):
        load_demonstrations(path)
