"""Every ``VecEnv`` of SB3, and every wrapper around it: same rollouts, same weights, options in step everywhere."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnv,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_options import OptionBank, OptionDQN, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback
from sb3_options.cli import train
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.execution.vec_env import as_wrapper_sees
from sb3_options.options.option import SubgoalOption
from sb3_options.runs.config import DQNConfig
from tests.support.helpers import DictEnv, place_of
from tests.support.sb3_helpers import (
    FAST_DISCOVERY,
    RANDOM,
    SMALL_ROOMS,
    TINY,
    fast_callback,
    optioned_rooms,
    small_rooms,
)

SLOT_0 = 4
PPO_TINY: dict[str, Any] = {
    "policy_kwargs": {"net_arch": [16]}, "n_steps": 64, "batch_size": 64, "n_epochs": 1, "ent_coef": 0.05, "seed": 0,
}  # fmt: skip


def make_monitored_rooms() -> gym.Env[Any, Any]:
    """What a worker process calls."""
    return OptionsWrapper(Monitor(small_rooms()), gamma=0.9)


@contextmanager
def rooms(kind: str, n_envs: int) -> Iterator[VecEnv]:
    """``n_envs`` monitored small rooms with options, in this process or in workers."""
    makers: list[Callable[[], gym.Env[Any, Any]]] = [make_monitored_rooms] * n_envs
    venv = SubprocVecEnv(makers, start_method="fork") if kind == "subproc" else DummyVecEnv(makers)
    venv.seed(7)
    try:
        yield venv
    finally:
        venv.close()


def dqn(venv: VecEnv, algorithm: Any = DQN, **kwargs: Any) -> Any:
    keywords = TINY | RANDOM | {"gamma": 0.9, "learning_starts": 50} | kwargs
    if algorithm is not OptionDQN:
        keywords["replay_buffer_class"] = OptionReplayBuffer
    return algorithm("MlpPolicy", venv, **keywords)


def ppo(venv: VecEnv, **kwargs: Any) -> PPO:
    return PPO("MlpPolicy", venv, gamma=0.9, **PPO_TINY | kwargs)


@pytest.fixture(scope="module")
def doorway() -> SubgoalOption:
    """The option that discovery makes of the doorway."""
    callback = fast_callback()
    dqn(DummyVecEnv([optioned_rooms])).learn(1500, callback=callback)
    option = callback.bank[0]
    assert isinstance(option, SubgoalOption)
    return option.bind(None)


Row = tuple[Any, ...]


def rollout(venv: VecEnv, doorway: SubgoalOption, n_steps: int) -> list[Row]:
    """What comes back for a fixed sequence of actions; the option arrives, changes its slot and leaves on the way."""
    rng = np.random.default_rng(3)
    rows: list[Row] = [(venv.reset(),)]
    for step in range(n_steps):
        if step == n_steps // 4:
            venv.env_method("set_option", 0, doorway)
        if step == n_steps // 2:
            venv.env_method("set_option", 2, doorway)
            venv.env_method("set_option", 0, None)
        observations: Any
        observations, rewards, dones, infos = venv.step(rng.integers(8, size=venv.num_envs))
        ends = [{k: v for k, v in info.get("episode", {}).items() if k != "t"} for info in infos]
        rows.append((np.copy(observations), rewards, dones, [info["option"] for info in infos], ends))
    return rows


@pytest.mark.parametrize("n_envs", [1, 2, 8])
def test_identical_rollouts_in_one_process_and_in_workers(n_envs: int, doorway: SubgoalOption) -> None:
    with rooms("dummy", n_envs) as here, rooms("subproc", n_envs) as workers:
        expected, got = rollout(here, doorway, 400), rollout(workers, doorway, 400)
    for mine, theirs in zip(expected, got, strict=True):
        np.testing.assert_equal(theirs, mine)
    options = [option for row in expected[1:] for option in row[3]]
    assert {option["index"] for option in options} == {-1, 0, 2}
    assert max(option["duration"] for option in options) > 2
    assert any(end for row in expected[1:] for end in row[4])


def test_options_arrive_between_decisions(doorway: SubgoalOption) -> None:
    """A slot is empty until `set_option` returns, and filled in every environment from the next decision on."""
    with rooms("subproc", 2) as venv:
        venv.reset()
        for _ in range(3):
            _, _, _, infos = venv.step(np.array([SLOT_0, SLOT_0]))
            assert [info["option"]["index"] for info in infos] == [-1, -1]
        venv.env_method("set_option", 0, doorway)
        _, _, _, infos = venv.step(np.array([SLOT_0, SLOT_0]))
        assert [info["option"]["index"] for info in infos] == [0, 0]


@pytest.mark.parametrize("algorithm", [DQN, OptionDQN, PPO])
def test_same_weights_bit_for_bit(algorithm: Any) -> None:
    weights, discoveries = [], []
    for kind in ("dummy", "subproc"):
        with rooms(kind, 2) as venv:
            model = ppo(venv) if algorithm is PPO else dqn(venv, algorithm)
            callback = fast_callback(option_settings={"keep_learning": True})
            model.learn(2000, callback=callback)
            weights.append({name: value.clone() for name, value in model.policy.state_dict().items()})
            discoveries.append([(d.slot, d.episode, d.timestep, d.subgoal.tolist()) for d in callback.discoveries])
    assert discoveries[0] == discoveries[1]
    assert len(discoveries[0]) == 1
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def stacked(venv: VecEnv) -> VecEnv:
    return VecFrameStack(venv, 3)


AROUND: dict[str, Callable[[VecEnv], VecEnv]] = {
    "VecNormalize": lambda venv: VecNormalize(venv, gamma=0.9, clip_reward=np.inf),
    "VecFrameStack": stacked,
    "VecCheckNan": lambda venv: VecCheckNan(venv, raise_exception=True),
    "VecNormalize(VecFrameStack)": lambda venv: VecNormalize(stacked(venv), gamma=0.9, clip_reward=np.inf),
    "VecCheckNan(VecNormalize(VecFrameStack))": lambda venv: VecCheckNan(
        VecNormalize(stacked(venv), gamma=0.9, clip_reward=np.inf), raise_exception=True
    ),
}


@pytest.mark.parametrize(
    ("name", "algorithm"),
    [*[(name, DQN) for name in AROUND], ("VecNormalize(VecFrameStack)", OptionDQN), *[(name, PPO) for name in AROUND]],
)
def test_trains_and_discovers_within(name: str, algorithm: Any) -> None:
    with rooms("dummy", 2) as bare:
        venv = AROUND[name](bare)
        buffer = {"replay_buffer_kwargs": {"macro_q": "VecFrameStack" not in name}}
        model: BaseAlgorithm = ppo(venv) if algorithm is PPO else dqn(venv, algorithm, **buffer)
        used: list[int] = []
        callback = fast_callback()
        n_timesteps = 4000 if algorithm is PPO else 2500
        model.learn(n_timesteps, callback=[callback, Spy(lambda spy: used.extend(spy.durations()))])
        assert len(callback.discoveries) == 1
        np.testing.assert_allclose(callback.discoveries[0].subgoal, (4.0, 2.0), atol=1.0)
        assert max(used) > 2
        assert model.num_timesteps >= n_timesteps
        assert all(torch.isfinite(value).all() for value in model.policy.state_dict().values())


def test_normalised_beneath_stacked_suits_rollouts() -> None:
    """rl-zoo3's order."""
    with rooms("dummy", 2) as bare:
        callback = fast_callback()
        ppo(stacked(VecNormalize(bare, gamma=0.9))).learn(4000, callback=callback)
        assert len(callback.discoveries) == 1


class Spy(BaseCallback):
    """Looks on after every step."""

    def __init__(self, look: Callable[["Spy"], Any]) -> None:
        super().__init__()
        self.look = look

    def durations(self) -> list[int]:
        return [info["option"]["duration"] for info in self.locals["infos"] if info["option"]["index"] >= 0]

    def _on_step(self) -> bool:
        self.look(self)
        return True


class TestStackedFrames:
    @pytest.mark.parametrize("normalise", [False, True])
    def test_masks_are_those_of_the_newest_frame(self, doorway: SubgoalOption, normalise: bool) -> None:
        with rooms("dummy", 2) as bare:
            venv = AROUND["VecNormalize(VecFrameStack)"](bare) if normalise else stacked(bare)
            model = dqn(venv, OptionDQN, replay_buffer_kwargs={"macro_q": False})
            venv.env_method("set_option", 0, doorway)
            rng, seen = np.random.default_rng(0), set()
            observations: Any = venv.reset()
            for _ in range(200):
                masks = np.stack(venv.env_method("action_masks"))
                np.testing.assert_array_equal(model._available(observations), masks)
                seen |= set(masks[:, SLOT_0].tolist())
                observations, _, _, _ = venv.step(rng.integers(8, size=2))
            assert seen == {False, True}

    def test_stored_transitions_know_which_options_may_start(self) -> None:
        with rooms("dummy", 2) as bare:
            model = dqn(stacked(bare), OptionDQN, replay_buffer_kwargs={"macro_q": False})
            callback = fast_callback()
            model.learn(2000, callback=callback)
            buffer = model.replay_buffer
            newest: Any = as_wrapper_sees(model.env, buffer.next_observations_stored())
            assert newest.shape == (buffer.size(), 45)
            expected = bare.env_method("available", newest, indices=[0])[0][:, SLOT_0:]
            np.testing.assert_array_equal(buffer.next_available[: buffer.size()], expected)
            assert 0 < expected[:, 0].sum() < buffer.size()

    def test_macro_q_is_refused_before_training(self) -> None:
        with rooms("dummy", 1) as bare:
            model = dqn(stacked(bare))
            text = r"never stacked by VecFrameStack.*DQN\(\.\.\., replay_buffer_kwargs=\{'macro_q': False\}\), or stack"
            with pytest.raises(ValueError, match=text):
                model.learn(2000, callback=fast_callback())
            assert model.num_timesteps == 0

    def test_normalised_beneath_stacked_is_refused_where_it_is_stored(self) -> None:
        with rooms("dummy", 1) as bare:
            model = dqn(stacked(VecNormalize(bare, gamma=0.9)), replay_buffer_kwargs={"macro_q": False})
            text = r"DQN stores what VecNormalize was given.*: use VecNormalize\(VecFrameStack\(venv, n\)\)"
            with pytest.raises(ValueError, match=text):
                model.learn(2000, callback=fast_callback())


def test_one_entry_of_a_dict_is_refused() -> None:
    env = OptionsWrapper(DictEnv(), gamma=0.9, feature_map=place_of)
    model = dqn(VecExtractDictObs(DummyVecEnv([lambda: env]), "place"))
    with pytest.raises(
        ValueError, match=r"observations change from Dict\(.* to Box\(.*: put what changes them beneath"
    ):
        model.learn(20, callback=SubgoalDiscoveryCallback())


class Restless(gym.Env[npt.NDArray[np.float32], int]):
    """Its observation is not a number from the tenth step on."""

    action_space: Any = spaces.Discrete(2)
    observation_space: Any = spaces.Box(0.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.time += 1
        return np.full(1, np.nan if self.time == 10 else 0.5, np.float32), 0.0, False, False, {}


def test_check_nan_still_finds_what_it_looks_for() -> None:
    venv = VecCheckNan(DummyVecEnv([lambda: OptionsWrapper(Restless(), gamma=0.9)]), raise_exception=True)
    with pytest.raises(ValueError, match="found nan in observations"):
        dqn(venv).learn(100, callback=SubgoalDiscoveryCallback())


class TestVecMonitor:
    @pytest.mark.parametrize("callback", [SubgoalDiscoveryCallback, PrimitiveStepsCallback])
    def test_is_said_to_count_something_else(
        self, caplog: pytest.LogCaptureFixture, callback: type[BaseCallback]
    ) -> None:
        model = dqn(VecMonitor(DummyVecEnv([optioned_rooms])))
        with caplog.at_level(logging.WARNING, "sb3_options"):
            model.learn(200, callback=callback())
        assert caplog.text.count("VecMonitor above OptionsWrapper counts decisions") == 1
        assert "make_vec_env(..., wrapper_class=OptionsWrapper)" in caplog.text

    def test_nothing_is_said_of_a_monitor(self, caplog: pytest.LogCaptureFixture) -> None:
        with caplog.at_level(logging.WARNING, "sb3_options"), rooms("dummy", 1) as venv:
            dqn(venv).learn(200, callback=SubgoalDiscoveryCallback())
        assert not caplog.records


@pytest.mark.slow
def test_command_line_trains_alike_in_worker_processes(tmp_path: Path) -> None:
    weights = []
    for kind in ("dummy", "subproc"):
        config = DQNConfig(
            env_kwargs={"map": SMALL_ROOMS.strip(), "max_steps": 150},
            n_timesteps=2500, n_envs=2, eval_freq=500, eval_episodes=2, exploration_final_eps=0.5, progress=False,
            discovery=DiscoverySettings(**FAST_DISCOVERY), tensorboard_log=tmp_path / kind, vec_env=kind,
        )  # fmt: skip
        folder = train(config)
        assert (folder / "subgoals.png").is_file()
        assert OptionsWrapper(small_rooms(), options_file=folder / "options.safetensors").bank.filled == (0,)
        weights.append(DQN.load(folder / "model.zip", device="cpu").policy.state_dict())
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


class TestEvaluationEnvironment:
    @pytest.mark.parametrize("algorithm", [DQN, PPO])
    @pytest.mark.parametrize("kind", ["subproc", "VecNormalize"])
    def test_has_every_option_at_the_same_decision(self, kind: str, algorithm: Any) -> None:
        """Also when options learn further."""
        inner = "subproc" if kind == "subproc" else "dummy"
        around = AROUND["VecNormalize"] if kind == "VecNormalize" else lambda venv: venv
        with rooms(inner, 2) as train_rooms, rooms(inner, 1) as eval_rooms:
            train_env, eval_env = around(train_rooms), around(eval_rooms)
            model: BaseAlgorithm = ppo(train_env) if algorithm is PPO else dqn(train_env)
            evaluation = EvalCallback(eval_env, n_eval_episodes=1, eval_freq=500, verbose=0)
            discovery = fast_callback(option_settings={"keep_learning": True})
            versions: set[bytes] = set()

            def compare(_: Spy) -> None:
                banks: list[OptionBank] = [*train_env.get_attr("bank"), *eval_env.get_attr("bank")]
                states = [content(bank) for bank in banks]
                assert all(state == states[0] for state in states)
                versions.add(states[0])

            model.learn(2000, callback=[evaluation, discovery, Spy(compare)])
            assert len(discovery.discoveries) == 1
            assert len(versions) > 2  # none, the first, one that has learned further


def content(bank: OptionBank) -> bytes:
    """What the discovered options of a bank are made of."""
    parts = [repr(bank.filled).encode()]
    for slot in bank.filled:
        option = bank[slot]
        assert isinstance(option, SubgoalOption)
        parts += [option.subgoal.points.tobytes(), option.initiation_set.points.tobytes()]
        parts += [array.tobytes() for array in option.option_policy.arrays().values()]
    return b"".join(parts)
