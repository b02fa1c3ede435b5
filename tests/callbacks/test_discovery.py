import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from sb3_contrib import QRDQN
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    EveryNTimesteps,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from sb3_options import OptionBank, OptionDQN, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback, reliability
from sb3_options.callbacks.records import OptionStatistics
from sb3_options.callbacks.reliability import MIN_RUNS, WINDOW
from sb3_options.density.regions import Region
from sb3_options.envs import Direction
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning import heads
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from tests.support import processes
from tests.support.helpers import DictEnv, place_of, steady_option
from tests.support.sb3_helpers import (
    DOORWAY,
    FAST_DISCOVERY,
    RANDOM,
    TINY,
    env_of,
    fast_callback,
    make_optioned_rooms,
    n_colours,
    optioned_rooms,
    small_rooms,
)

N_PRIMITIVE = 4
STEPS = 1800
"""Random primitive steps in which the doorway of the small rooms is found."""


def model_of(env: Any = None, algorithm: type[OffPolicyAlgorithm] = DQN, **kwargs: Any) -> Any:
    buffer = {"replay_buffer_class": OptionReplayBuffer}
    env = optioned_rooms() if env is None else env
    return algorithm("MlpPolicy", env, gamma=0.9, **buffer | TINY | RANDOM | kwargs)


class SilentFailures(gym.Wrapper[Any, Any, Any, Any]):
    """Says whether an episode succeeded where it did."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        if not info.get("is_success"):
            info.pop("is_success", None)
        return obs, float(reward), terminated, truncated, info


@pytest.mark.parametrize("n_envs", [1, 3])
def test_failures_before_the_first_reported_success_are_logged_with_it(n_envs: int) -> None:
    venv = DummyVecEnv([lambda: OptionsWrapper(SilentFailures(small_rooms(max_steps=60)), 1, gamma=0.9)] * n_envs)
    callback, model = SubgoalDiscoveryCallback(max_new_options=0), model_of(venv)
    for _ in range(2):  # the second training forgets what the first has logged
        began = len(callback.history)
        model.learn(4000, callback=callback)
        successes = [each.success for each in callback.history[began:]]
        assert not successes[0]
        assert any(successes)
        assert list(model.ep_success_buffer) == successes[-100:]


class Endless(gym.Wrapper[Any, Any, Any, Any]):
    """Goes on from the start after the goal."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        if terminated:
            obs, _ = self.env.reset()
        return obs, float(reward), False, truncated, info


def to_the_doorway(action: int, *nearby: tuple[float, float]) -> SubgoalOption:
    """An option for the doorway that always takes one action, in force near some places."""
    scale = np.ones(2)
    return SubgoalOption(
        Region(np.array([DOORWAY]), scale, 0.5),
        Region(np.array(nearby), scale, 0.5),
        TabularPolicy(np.array([DOORWAY]), np.eye(N_PRIMITIVE)[[action]]),
        policy_input="features",
        max_duration=3,
    )


def test_an_option_whose_runs_go_on_for_ever_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reliability, "MIN_RUNS", 10)
    monkeypatch.setattr(reliability, "RUNS_BETWEEN", 5)
    env = optioned_rooms()
    right, left = Direction.RIGHT, Direction.LEFT
    env.bank.add(to_the_doorway(right, (3, 2)))
    env.bank.add(to_the_doorway(left, (0, 2)))
    callback = SubgoalDiscoveryCallback(max_new_options=0, min_reached=0.5, interruption=False)
    model_of(env, seed=0).learn(6000, callback=callback)
    assert [(closed.slot, closed.why) for closed in callback.closed] == [(1, "unreliable")]
    assert callback.bank.filled == env.bank.filled == (0,)


def test_an_option_is_no_longer_offered_where_it_goes_on_for_ever() -> None:
    """To the right of (3, 0) is a wall."""
    env = optioned_rooms()
    env.bank.add(to_the_doorway(Direction.RIGHT, (3, 2), (3, 0)))
    callback = SubgoalDiscoveryCallback(max_new_options=0, min_reached=0.5, interruption=False)
    model_of(env, seed=0).learn(6000, callback=callback)
    assert not callback.closed
    for bank in (callback.bank, env.bank):
        option = bank[0]
        assert isinstance(option, SubgoalOption)
        assert option.initiation_set.points.tolist() == [[3, 2]]


def test_runs_of_a_closed_option_do_not_count_for_the_next_one_in_its_slot() -> None:
    """With a rollout buffer a closed option goes on until the rollout ends, after its statistics were forgotten."""
    callback = fast_callback(max_new_options=1, min_reached=0.5)
    for _ in range(MIN_RUNS):
        callback._statistics.add(OptionRun(0, 1, 0.9, 0.9, "max_duration", np.eye(45)[:1], inside=True))
    model_of(seed=0).learn(2 * STEPS, callback=callback)
    assert [found.slot for found in callback.discoveries] == [0]
    assert not callback.closed


def test_a_subgoal_that_nothing_leads_to_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    groups = [{"name": "place", "features": [0, 1], "labels": ["row", "column"]}]
    callback = fast_callback(groups=groups, option_settings={"min_reach": 1.0, "value_function": "table"})
    with caplog.at_level(logging.WARNING, "sb3_options"):
        model_of(seed=0).learn(8 * STEPS, callback=callback)
    assert callback.discovery is not None
    assert callback.discovery.n_withdrawn > 1
    said = [record.getMessage() for record in caplog.records if "No option for" in record.getMessage()]
    assert said
    assert len(said) == len(set(said)) < callback.discovery.n_withdrawn


def test_an_option_from_a_file_grows_where_it_is_used(tmp_path: Path) -> None:
    env = optioned_rooms()
    env.bank.add(to_the_doorway(Direction.RIGHT, (3, 2)))
    env.bank.save(tmp_path / "options")
    env = OptionsWrapper(small_rooms(), 4, gamma=0.9, options_file=tmp_path / "options")
    callback = SubgoalDiscoveryCallback(max_new_options=0, option_settings={"grow": True, "value_function": "table"})
    model_of(env).learn(2 * STEPS, callback=callback)
    option = env.bank[0]
    assert isinstance(option, SubgoalOption)
    points = {tuple(point) for point in option.initiation_set.points}
    assert (3, 2) in points
    assert len(points) > 5


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ([{"name": "a", "features": [7]}], "7"),
        ([{"name": "a", "features": [0], "present": [[7]]}], "7"),
        ([{"name": "a", "features": [0]}, {"name": "a", "features": [1]}], "two groups of features have the same name"),
    ],
)
def test_groups_that_do_not_fit_are_refused_before_the_first_step(groups: list[Any], message: str) -> None:
    model = model_of()
    with pytest.raises(ValueError, match=message):
        model.learn(STEPS, callback=fast_callback(groups=groups))
    assert model.num_timesteps == 0


def test_a_share_is_refused_out_of_range() -> None:
    with pytest.raises(ValueError, match=r"min_reached must be a share, in \[0, 1\], got 2"):
        SubgoalDiscoveryCallback(min_reached=2)


@pytest.mark.parametrize("name", ["success", "static_filter", "save_path", "hparams"])
def test_what_is_no_such_thing_is_refused_when_the_callback_is_made(name: str) -> None:
    with pytest.raises(TypeError, match=f"^{name} must be .*, got 3"):
        SubgoalDiscoveryCallback(**{name: 3})  # type: ignore[arg-type]


def banks(venv: VecEnv) -> list[OptionBank]:
    return cast("list[OptionBank]", venv.get_attr("bank"))


def same_options(banks: list[OptionBank]) -> bool:
    """Whether all banks hold equal discovered options in the same slots, and at least one."""

    def content(bank: OptionBank) -> list[Any]:
        options = [(i, bank[i]) for i in bank.filled]
        return [
            (i, o.name, o.max_duration, o.subgoal.points.tolist(), sorted(map(tuple, o.initiation_set.points.tolist())),
             [a.tobytes() for a in o.option_policy.arrays().values()])
            for i, o in options if isinstance(o, SubgoalOption)
        ]  # fmt: skip

    first = content(banks[0])
    return bool(first) and all(content(bank) == first for bank in banks)


@pytest.mark.parametrize("algorithm", [DQN, QRDQN, OptionDQN])
def test_discovers_the_doorway_and_installs_an_option_that_leads_there(algorithm: type[OffPolicyAlgorithm]) -> None:
    callback = fast_callback()
    quantiles = {"policy_kwargs": {"net_arch": [16], "n_quantiles": 8}} if algorithm is QRDQN else {}
    model = model_of(algorithm=algorithm, **quantiles)
    model.learn(STEPS, callback=callback)
    (found,) = callback.discoveries
    assert np.abs(found.subgoal - DOORWAY).sum() <= 1
    assert found.slot == 0
    assert 0 < found.episode <= callback.episodes
    assert 0 < found.timestep <= model.num_timesteps == callback.num_timesteps
    assert found.initiation_states == len(cast("SubgoalOption", callback.bank[0]).initiation_set.points) > 5
    assert np.isfinite(found.log_density)
    assert same_options([callback.bank, *banks(env_of(model))])
    assert [heads.is_closed(model.policy, N_PRIMITIVE + i) for i in range(4)] == [False, True, True, True]

    # The option itself, from every cell of the left room.
    reached = []
    env = optioned_rooms()
    for x in range(4):
        for y in range(5):
            env.reset(seed=5 * x + y, options={"start": (x, y)})
            env.set_option(0, callback.bank[0])
            if env.action_masks()[N_PRIMITIVE]:
                _, _, _, _, info = env.step(N_PRIMITIVE)
                reached.append(info["option"]["termination"] == "subgoal")
    assert len(reached) > 5
    assert np.mean(reached) > 0.7


def test_uses_the_option_once_it_has_it() -> None:
    model, callback = model_of(), fast_callback()
    model.learn(STEPS, callback=callback)
    stored = model.replay_buffer.actions[: model.replay_buffer.size(), 0]
    uses = callback._statistics.values()["options/slot_0/uses"]
    assert (stored == N_PRIMITIVE).sum() == uses > 5
    assert not (stored > N_PRIMITIVE).any()


class TestReachesEveryEnvironment:
    @pytest.mark.parametrize("n_envs", [1, 4])
    def test_in_one_process(self, n_envs: int) -> None:
        venv = DummyVecEnv([optioned_rooms] * n_envs)
        callback = fast_callback()
        model_of(venv).learn(STEPS, callback=callback)
        assert same_options([callback.bank, *banks(venv)])

    def test_in_worker_processes(self) -> None:
        venv = SubprocVecEnv([make_optioned_rooms] * 2, start_method="fork")
        try:
            callback = fast_callback()
            model = model_of(venv)
            model.learn(STEPS, callback=callback)
            assert len(callback.discoveries) == 1
            assert same_options([callback.bank, *banks(venv)])
            # Bound to the feature map that each worker has.
            assert venv.env_method("available", np.eye(45, dtype=np.float32))[1][:, N_PRIMITIVE].sum() > 5
        finally:
            venv.close()

    @pytest.mark.parametrize("how", ["list", "before", "CallbackList", "EveryNTimesteps", "deep"])
    def test_in_the_evaluation_beside_it(self, how: str) -> None:
        evaluation = EvalCallback(Monitor(optioned_rooms()), n_eval_episodes=1, eval_freq=100_000, verbose=0)
        callback = fast_callback()
        nested: dict[str, Callable[[], Any]] = {
            "list": lambda: [callback, evaluation],
            "before": lambda: [evaluation, callback],
            "CallbackList": lambda: CallbackList([callback, CallbackList([evaluation])]),
            "EveryNTimesteps": lambda: [callback, EveryNTimesteps(50_000, evaluation)],
            "deep": lambda: [CallbackList([EveryNTimesteps(50_000, CallbackList([evaluation]))]), callback],
        }
        model_of().learn(STEPS, callback=nested[how]())
        assert len(callback.discoveries) == 1
        assert same_options([callback.bank, *banks(evaluation.eval_env)])

    def test_and_the_evaluation_uses_it(self) -> None:
        """Episodes that are evaluated count primitive steps too."""
        evaluation = EvalCallback(Monitor(optioned_rooms()), n_eval_episodes=3, eval_freq=400, verbose=0)
        lengths: list[int] = []

        class Lengths(BaseCallback):
            def _on_step(self) -> bool:
                lengths.extend(e for e in cast("Any", evaluation.eval_env).envs[0].get_episode_lengths())
                return True

        evaluation.callback = Lengths()
        callback = fast_callback()
        model = model_of()
        model.learn(STEPS, callback=[callback, evaluation])
        assert isinstance(cast("Any", evaluation.eval_env).envs[0].env, OptionsWrapper)
        assert lengths
        assert max(lengths) <= 150


class TestGoesOn:
    def test_when_learn_is_called_again(self) -> None:
        callback, model = fast_callback(), model_of()
        model.learn(STEPS, callback=callback)
        options, head = banks(env_of(model))[0].slots, heads.option_outputs(model.policy)[0][0].weight.clone()
        assert len(callback.discoveries) == 1
        model.learn(0, callback=callback, reset_num_timesteps=False)
        assert len(callback.discoveries) == 1
        assert torch.equal(head, heads.option_outputs(model.policy)[0][0].weight)
        assert [o.name for o in banks(env_of(model))[0].slots if o] == [o.name for o in options if o]
        model.learn(400, callback=callback, reset_num_timesteps=False)
        # SB3 only looks at the budget when a rollout of 16 decisions ends.
        assert model.num_timesteps >= STEPS + 400

    def test_with_a_new_callback_that_finds_the_next_one(self) -> None:
        model = model_of()
        model.learn(STEPS, callback=fast_callback())
        again = fast_callback()
        model.learn(STEPS, callback=again)
        assert 0 in again.bank.filled
        assert all(d.slot == 1 for d in again.discoveries)

    def test_with_hand_made_options_that_were_there_before(self) -> None:
        env = optioned_rooms()
        hand_made = steady_option(3, name="mine", max_duration=2)
        env.bank.add(hand_made, 1)
        callback, model = fast_callback(), model_of(env)
        evaluation = EvalCallback(Monitor(optioned_rooms()), eval_freq=100_000, verbose=0)
        model.learn(STEPS, callback=[callback, evaluation])
        assert callback.bank[1] is env.bank[1] is banks(evaluation.eval_env)[0][1] is hand_made
        assert [d.slot for d in callback.discoveries] == [0]
        assert callback._statistics.values()["options/slot_1/mean_duration"] > 1

    @pytest.mark.parametrize("most", [0, 1])
    def test_until_it_has_made_as_many_as_it_may(self, most: int) -> None:
        callback, model = fast_callback(max_new_options=most), model_of()
        model.learn(STEPS, callback=callback)
        assert len(callback.discoveries) == len(callback.bank) == most

    def test_until_every_slot_is_filled(self) -> None:
        callback, model = fast_callback(max_new_options=None), model_of(optioned_rooms(1))
        model.learn(2 * STEPS, callback=callback)
        assert len(callback.discoveries) == 1

    def test_after_nan_observations(self, caplog: pytest.LogCaptureFixture) -> None:
        class Spoilt(gym.ObservationWrapper[Any, Any, Any]):
            seen = 0

            def observation(self, observation: Any) -> Any:
                self.seen += 1
                return observation * np.nan if 40 <= self.seen < 45 else observation

        env = OptionsWrapper(Spoilt(small_rooms(observation="xy")), gamma=0.9, feature_map=lambda o: np.asarray(o))
        callback, model = fast_callback(), model_of(env)
        with caplog.at_level(logging.WARNING, "sb3_options"):
            model.learn(STEPS, callback=callback)
        assert model.num_timesteps >= STEPS
        logged = [r.getMessage() for r in caplog.records]
        assert len(logged) == 1
        assert logged[0].startswith("No discovery after episode 1: ")
        assert "NaN" in logged[0]
        assert len(callback.discoveries) == 1

    def test_when_episodes_never_succeed(self) -> None:
        callback, model = fast_callback(), model_of(optioned_rooms(max_steps=5))
        model.learn(500, callback=callback)
        assert callback.episodes >= 90
        assert callback.discoveries == []

    @pytest.mark.parametrize(("max_segment", "n_told"), [(100, 1), (600, 0)])
    def test_when_episodes_never_end(self, caplog: pytest.LogCaptureFixture, max_segment: int, n_told: int) -> None:
        """It says so once, long before training ends."""
        callback = SubgoalDiscoveryCallback({**FAST_DISCOVERY, "max_segment": max_segment})
        model_of(DummyVecEnv([lambda: OptionsWrapper(Endless(small_rooms(max_steps=10**6)), 1, gamma=0.9)] * 2)).learn(
            1000, callback=callback
        )
        assert callback.episodes == 0
        said = [record.getMessage() for record in caplog.records if "no episode has ended" in record.getMessage()]
        assert len(said) == n_told
        assert all(f"in {max_segment} primitive steps of each environment" in text for text in said)


class TestSuccess:
    def test_is_the_users(self) -> None:
        asked = []

        def never(trajectory: Any) -> bool:
            asked.append(len(trajectory))
            return False

        callback, model = fast_callback(success=never), model_of()
        model.learn(1000, callback=callback)
        assert len(asked) == callback.episodes > 5
        assert callback.discoveries == []

    def test_so_is_the_static_filter(self) -> None:
        def only_right(features: Any, start: Any, end: Any) -> Any:
            return features[:, 0] > 5.5

        callback, model = fast_callback(static_filter=only_right), model_of()
        model.learn(STEPS, callback=callback)
        assert [d.subgoal[0] > 5.5 for d in callback.discoveries] == [True]


class TestSavePath:
    def test_is_written_at_each_new_option(self, tmp_path: Path) -> None:
        path = tmp_path / "deep" / "options.safetensors"
        written: list[tuple[bool, int]] = []
        callback = fast_callback(save_path=path)

        class Look(BaseCallback):
            def _on_step(self) -> bool:
                written.append((path.exists(), len(callback.discoveries)))
                return True

        model_of().learn(STEPS, callback=[callback, Look()])
        assert set(written) == {(False, 0), (True, 1)}
        bank = optioned_rooms().bank
        bank.load(path)
        assert same_options([bank, callback.bank])

    def test_holds_in_the_end_what_options_have_become(self, tmp_path: Path) -> None:
        path = tmp_path / "options.safetensors"
        callback = fast_callback(save_path=path, option_settings={"grow": True, "value_function": "table"})
        model_of().learn(3 * STEPS, callback=callback)
        bank = optioned_rooms().bank
        bank.load(path)
        assert same_options([bank, callback.bank])
        saved, present = bank[0], callback.bank[0]
        assert isinstance(saved, SubgoalOption)
        assert isinstance(present, SubgoalOption)
        assert saved.initiation_set.points.tolist() == present.initiation_set.points.tolist()

    def test_prints_if_asked(self, capsys: pytest.CaptureFixture[str]) -> None:
        callback = fast_callback(verbose=1)
        model_of().learn(STEPS, callback=callback)
        (found,) = callback.discoveries
        place = ", ".join(f"{x:g}" for x in found.subgoal)
        text = f"Option 0: reach {place}, after {found.episode} episodes and {found.timestep:,} steps"
        said = capsys.readouterr().out
        assert text in said
        assert "No subgoal" not in said
        assert callback.why_nothing() is None

    @pytest.mark.parametrize(
        ("asked", "why", "said"),
        [
            ({"verbose": 1}, "No subgoal was discovered: no episode has ended", True),
            ({"verbose": 0}, "No subgoal was discovered: no episode has ended", False),
            ({"verbose": 1, "max_new_options": 0}, "Discovery was switched off.", False),
        ],
    )
    def test_says_in_the_end_why_there_is_none(
        self, capsys: pytest.CaptureFixture[str], asked: dict[str, Any], why: str, said: bool
    ) -> None:
        callback = fast_callback(**asked)
        model_of().learn(20, callback=callback)
        assert (callback.why_nothing() or "").startswith(why)
        assert (why in capsys.readouterr().out) is said


def test_one_seed_one_result() -> None:
    def run() -> tuple[dict[str, torch.Tensor], list[Any], list[OptionBank]]:
        callback, model = (
            fast_callback(option_settings={"value_function": "network", "network_updates": 50}),
            model_of(),
        )
        model.learn(STEPS, callback=callback)
        found = [(d.slot, d.episode, d.timestep, d.subgoal.tolist(), d.log_density) for d in callback.discoveries]
        return model.policy.state_dict(), found, [callback.bank]

    (weights, found, bank), (weights_2, found_2, bank_2) = run(), run()
    assert len(found) == 1
    assert found == found_2
    assert same_options(bank + bank_2)
    assert all(torch.equal(weights[name], weights_2[name]) for name in weights)


@pytest.mark.parametrize("observation", ["xy", "image"])
def test_other_observations(observation: str) -> None:
    policy = {"policy": "CnnPolicy"} if observation == "image" else {}
    env = optioned_rooms(observation=observation)
    model = OptionDQN(
        policy.get("policy", "MlpPolicy"), env, gamma=0.9, buffer_size=3000, learning_starts=2496, train_freq=16,
        batch_size=4, seed=0, policy_kwargs={"net_arch": [8]}, **RANDOM,
    )  # fmt: skip
    callback = fast_callback()
    model.learn(2500, callback=callback)
    assert len(callback.discoveries) == 1
    assert model._option_buffer().next_available.any()


def test_dict_observations() -> None:
    env = OptionsWrapper(DictEnv(), gamma=0.9, feature_map=place_of)
    model = OptionDQN("MultiInputPolicy", env, gamma=0.9, learning_starts=50, buffer_size=1000, seed=0, **RANDOM)
    callback = fast_callback(static_filter=lambda f, s, e: np.abs(f[:, 0] - 5) < 2)
    model.learn(1500, callback=callback)
    assert [abs(d.subgoal[0] - 5) < 2 for d in callback.discoveries] == [True]


@pytest.fixture(scope="module")
def events(tmp_path_factory: pytest.TempPathFactory) -> tuple[EventAccumulator, Any]:
    """What a run left for TensorBoard, and its model."""
    log = tmp_path_factory.mktemp("log")
    model = model_of(tensorboard_log=str(log))
    slower = SubgoalDiscoveryCallback({**FAST_DISCOVERY, "decay": 0.8}, max_new_options=1)
    model.learn(STEPS, callback=slower)
    (file,) = log.rglob("events.out.tfevents.*")
    accumulator = EventAccumulator(str(file), size_guidance={"images": 0, "scalars": 0})
    accumulator.Reload()
    return accumulator, model


class TestTensorBoard:
    def last(self, events: EventAccumulator, tag: str) -> float:
        return float(events.Scalars(tag)[-1].value)

    def test_scalars(self, events: tuple[EventAccumulator, Any]) -> None:
        accumulator, model = events
        tags = set(accumulator.Tags()["scalars"])
        assert tags >= {
            "options/count", "options/slot_0/uses", "options/slot_0/mean_duration", "options/slot_0/ended_subgoal",
            "time/primitive_steps", "discovery/seconds", "discovery/leading_average", "discovery/best_log_density",
        }  # fmt: skip
        assert accumulator.Scalars("options/count")[0].value == 0
        assert self.last(accumulator, "options/count") == 1
        assert 0 < self.last(accumulator, "discovery/seconds") < 60
        assert self.last(accumulator, "options/slot_0/mean_duration") > 1
        assert max(s.value for s in accumulator.Scalars("discovery/leading_average")) > 0
        shares = [self.last(accumulator, t) for t in tags if t.startswith("options/slot_0/ended_")]
        assert sum(shares) == pytest.approx(1.0)
        for event in accumulator.Scalars("time/primitive_steps"):
            assert event.value <= event.step <= model.num_timesteps
        assert accumulator.Scalars("options/count")[-1].step == model.num_timesteps

    def test_images(self, events: tuple[EventAccumulator, Any]) -> None:
        accumulator, _ = events
        names = {"diverse_density", "first_visits", "initiation_set", "option_policy", "options"}
        assert set(accumulator.Tags()["images"]) == {f"discovery/{name}" for name in names}
        for name in names:
            picture = iio.imread(accumulator.Images(f"discovery/{name}")[-1].encoded_image_string)
            height, width = picture.shape[:2]
            assert height >= 200
            assert width >= 300
            inside = picture[height // 5 : -height // 5, width // 5 : -width // 5, :3]
            assert n_colours(inside) > 10, name

    def test_text_and_settings(self, events: tuple[EventAccumulator, Any]) -> None:
        accumulator, model = events
        *_, last = accumulator.Tensors("options/slot_0/text_summary")
        assert last.step == model.num_timesteps
        (text,) = last.tensor_proto.string_val
        assert b"| option | reach 5, 2 |" in text
        assert re.search(rb"% of the last runs, 100 at most: the subgoal was reached", text)
        told = accumulator.PluginTagToContent("hparams")
        assert "_hparams_/experiment" not in told, "TensorBoard would show the columns of one run for all"
        settings = HParamsPluginData.FromString(told["_hparams_/session_start_info"]).session_start_info.hparams
        assert settings["algo"].string_value == type(model).__name__
        assert settings["discovery.decay"].number_value == 0.8
        assert [each.step for each in accumulator.Scalars("at_end/success_rate")] == [model.num_timesteps]


def test_without_tensorboard_no_picture_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    drawing = "sb3_options.callbacks.discovery_log.discovery_figures"
    monkeypatch.setattr(drawing, lambda *_: pytest.fail("drew a picture"))
    callback = fast_callback()
    model_of().learn(STEPS, callback=callback)
    assert callback.discoveries


def test_statistics_of_endings_add_up_even_when_one_has_left_the_window() -> None:
    statistics = OptionStatistics()
    statistics.add(OptionRun(2, 9, 0.9**9, 0.9, "truncated"))
    assert statistics.values()["options/slot_2/ended_truncated"] == 1.0
    for _ in range(WINDOW):
        statistics.add(OptionRun(2, 3, 0.9**3, 0.9, "subgoal"))
    assert statistics.values() == {
        "options/slot_2/uses": WINDOW + 1, "options/slot_2/runs": WINDOW + 1, "options/slot_2/steps_outside": 0,
        "options/slot_2/mean_duration": 3.0,
        "options/slot_2/ended_truncated": 0.0, "options/slot_2/ended_subgoal": 1.0,
    }  # fmt: skip


def test_steps_outside_the_initiation_set_are_no_runs() -> None:
    statistics = OptionStatistics()
    statistics.add(OptionRun(0, 1, 0.9, 0.9, "left_initiation", inside=False))
    assert statistics.values() == {
        "options/slot_0/uses": 1, "options/slot_0/runs": 0, "options/slot_0/steps_outside": 1,
    }  # fmt: skip
    for _ in range(3):
        statistics.add(OptionRun(0, 5, 0.9**5, 0.9, "subgoal", inside=True))
        statistics.add(OptionRun(0, 1, 0.9, 0.9, "left_initiation", inside=False))
    values = statistics.values()
    assert (values["options/slot_0/runs"], values["options/slot_0/steps_outside"]) == (3, 4)
    assert (values["options/slot_0/mean_duration"], values["options/slot_0/ended_subgoal"]) == (5.0, 1.0)


ACT_AGAIN = """
import numpy as np
from stable_baselines3 import DQN
from sb3_options import OptionDQN, OptionReplayBuffer
from tests.support.sb3_helpers import optioned_rooms

observations = np.load("observations.npy")
for algorithm in (DQN, OptionDQN):
    name = algorithm.__name__
    env = optioned_rooms()
    model = algorithm("MlpPolicy", env, gamma=0.9, replay_buffer_class=OptionReplayBuffer, buffer_size=1,
                      policy_kwargs={"net_arch": [16]})
    model.set_parameters(f"{name}.zip")
    env.bank.load(f"{name}.safetensors")
    actions = model.predict(observations, deterministic=True)[0]
    np.save(f"{name}.npy", np.stack([actions, env.bank[0].policy(observations), env.available(observations)[:, 4]]))
"""


def test_saved_and_loaded_in_a_new_process_acts_the_same(tmp_path: Path) -> None:
    cells = np.random.default_rng(0).integers(45, size=1000)
    observations = np.eye(45, dtype=np.float32)[cells]
    np.save(tmp_path / "observations.npy", observations)
    expected = {}
    for algorithm in (DQN, OptionDQN):
        model, callback = model_of(algorithm=algorithm), fast_callback()
        model.learn(STEPS, callback=callback)
        for layer, _ in heads.option_outputs(model.policy):
            torch.nn.init.constant_(layer.bias[N_PRIMITIVE], 0.3)  # so that the option is chosen at times
        actions = model.predict(observations, deterministic=True)[0]
        assert (actions == N_PRIMITIVE).any()
        model.save(tmp_path / f"{algorithm.__name__}.zip")
        callback.bank.save(tmp_path / f"{algorithm.__name__}.safetensors")
        (bank,) = banks(env_of(model))
        expected[algorithm.__name__] = np.stack(
            [actions, cast("SubgoalOption", bank[0]).policy(observations), bank.available(observations)[:, N_PRIMITIVE]]
        )
    script = f"import sys; sys.path.insert(0, {str(Path(__file__).parents[2])!r})\n{ACT_AGAIN}"
    result = processes.python("-c", script, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    for name, values in expected.items():
        np.testing.assert_array_equal(np.load(tmp_path / f"{name}.npy"), values)
