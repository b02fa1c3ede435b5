"""MacroQ against episodes computed by hand, against value iteration, and against itself elsewhere."""

from collections.abc import Sequence
from inspect import signature
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import DummyVecEnv

from experiments.pioneer.tiles import TileCoding
from sb3_options import MacroQ, OptionsWrapper
from sb3_options.callbacks import PrimitiveStepsCallback
from sb3_options.envs import GridWorld
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning.macro_q import LONGEST_ROLLOUT, LinearPolicy, OneHot
from tests.support.helpers import CountingEnv, numbered, steady_option, table_option
from tests.support.sb3_helpers import optioned_rooms, small_rooms

ALPHA, GAMMA = 0.5, 0.9


def line(**flags: Any) -> gym.Env[Any, Any]:
    """`CountingEnv` with states 0, 1, 2, … of a line of 6 for observations."""
    return numbered(CountingEnv(**flags), 6)


class Recorder(BaseCallback):
    """Keeps the table as it is after every call of ``step``, and notes when rollouts end."""

    def __init__(self) -> None:
        super().__init__()
        self.tables: list[npt.NDArray[np.float64]] = []
        self.ended: list[int] = []

    def _on_step(self) -> bool:
        self.tables.append(table_of(self.model).copy())
        return True

    def _on_rollout_end(self) -> None:
        self.ended.append(self.num_timesteps)


def table_of(model: Any) -> npt.NDArray[np.float64]:
    table: npt.NDArray[np.float64] = model.policy.table()
    return table


def scripted(env: gym.Env[Any, Any], actions: Sequence[int], monkeypatch: pytest.MonkeyPatch) -> tuple[MacroQ, Any]:
    """A model that takes these actions, from a table of Q(s, a) = s + a/10; and its table after every call."""
    model = MacroQ(env, learning_rate=ALPHA, gamma=GAMMA, seed=0)
    table = table_of(model)
    table[:] = np.arange(len(table))[:, None] + np.arange(table.shape[1]) / 10
    script = iter(actions)

    def scripted_choice(values: list[float], choices: list[int]) -> int:
        action = next(script)
        assert action in choices
        return action

    monkeypatch.setattr(model, "_explore", scripted_choice)
    recorder = Recorder()
    model.learn(len(actions), callback=recorder)
    return model, recorder.tables


def test_one_step_of_q_learning(monkeypatch: pytest.MonkeyPatch) -> None:
    _, tables = scripted(line(terminate_at=2), [1, 0], monkeypatch)
    # Q(0, 1) = 0.1 → halfway to 1 + 0.9 · max(1.0, 1.1) = 1.99.
    assert tables[0][0].tolist() == pytest.approx([0.0, (0.1 + 1.99) / 2], rel=1e-14)
    # Nothing follows the end: Q(1, 0) = 1.0 → halfway to 2.
    assert tables[1][1].tolist() == pytest.approx([1.5, 1.1])


@pytest.mark.parametrize(
    ("ended", "available", "best"), [(True, None, 0.0), (False, None, 3.1), (False, [0, 0, 1], 3.3)]
)
def test_what_was_reported_of_an_option_is_what_it_teaches(ended: bool, available: Any, best: float) -> None:
    """An environment that reports options of its own need not say what may start."""
    model = MacroQ(optioned([True] * 6, duration=3), learning_rate=ALPHA, gamma=GAMMA, seed=0).learn(0)
    table = table_of(model)
    table[:] = np.arange(6)[:, None] + np.arange(4) / 10
    may_start = None if available is None else np.array([[0, each] for each in available], dtype=bool)
    places, actions, rewards = np.arange(3), np.ones(3, dtype=np.int64), np.array([1.0, 2.0, 3.0])
    run = OptionRun(1, 3, GAMMA**3, GAMMA, "subgoal", places, actions, rewards, may_start)
    model._learn_from([0], 3, 1 + GAMMA * 2 + GAMMA**2 * 3, [3], ended, run)
    inside = [(1 + GAMMA * 1.1 + 0.1) / 2, (2 + GAMMA * 2.1 + 1.1) / 2, (3 + GAMMA * best + 2.1) / 2]
    assert table[:3, 1].tolist() == pytest.approx(inside, rel=1e-14)
    assert table[0, 3] == pytest.approx((1 + GAMMA * 2 + GAMMA**2 * 3 + GAMMA**3 * best + 0.3) / 2, rel=1e-14)
    before = table.copy()
    instead = OptionRun(-1, 1, GAMMA, GAMMA, "primitive", actions=np.array([1]))  # of the first slot, which is empty
    model._learn_from([5], 2, 1.0, [5], True, instead)
    before[5, 1] = (5.1 + 1) / 2
    assert table.tolist() == before.tolist()


def test_a_time_limit_is_no_end(monkeypatch: pytest.MonkeyPatch) -> None:
    _, tables = scripted(line(truncate_at=1), [0], monkeypatch)
    assert tables[0][0, 0] == pytest.approx(0.5 * (1 + GAMMA * 1.1))


def optioned(initiation: Sequence[bool], *, duration: int, **flags: int) -> OptionsWrapper:
    """`line` with two slots; the second holds an option that takes action 1."""
    env = OptionsWrapper(line(**flags), 2, gamma=GAMMA)
    env.bank.add(table_option(initiation, [1] * 6, [0.0] * 6, max_duration=duration), 1)
    return env


def test_an_option_teaches_its_steps_in_order_and_then_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two steps 0 → 1 → 2; action 3 is the option; it may start everywhere but in 2, where only 2.1 counts."""
    env = optioned([True, True, False, True, True, True], duration=2)
    _, tables = scripted(env, [3], monkeypatch)
    q01 = (0.1 + 1 + GAMMA * 1.3) / 2  # in state 1 the option is worth 1.3; the empty slot's 1.2 never counts
    q11 = (1.1 + 2 + GAMMA * 2.1) / 2  # in state 2 it may not start, so that its 2.3 does not count
    q03 = (0.3 + 1 + GAMMA * 2 + GAMMA**2 * 2.1) / 2  # γ² at the end of two steps
    assert tables[0][0].tolist() == pytest.approx([0.0, q01, 0.2, q03])
    assert tables[0][1].tolist() == pytest.approx([1.0, q11, 1.2, 1.3])


def test_a_primitive_step_counts_options_that_may_start_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    _, tables = scripted(optioned([False, True, False, False, False, False], duration=2), [0, 0], monkeypatch)
    assert tables[0][0, 0] == pytest.approx((0.0 + 1 + GAMMA * 1.3) / 2)
    assert tables[1][1, 0] == pytest.approx((1.0 + 2 + GAMMA * 2.1) / 2)  # in 2 none may start


def test_an_option_sees_what_its_own_steps_have_just_taught(monkeypatch: pytest.MonkeyPatch) -> None:
    """Order: a self-loop is updated before the option that ended there is."""
    env = OptionsWrapper(CountingEnv(1, step=lambda env, _: (np.zeros(1), 10.0, False, False, {})), 1, gamma=GAMMA)
    env.bank.add(steady_option(0, max_duration=2))
    features = OneHot(2, coded=False)
    model = MacroQ(env, features=features, learning_rate=ALPHA, gamma=GAMMA, epsilon=0.0, seed=0)
    monkeypatch.setattr(model, "_explore", lambda values, choices: 1)
    model.learn(1)
    first = 0.5 * 10
    second = first + 0.5 * (10 + GAMMA * first - first)
    option = 0.5 * (10 + GAMMA * 10 + GAMMA**2 * second)
    assert table_of(model)[0].tolist() == pytest.approx([second, option])


@pytest.mark.parametrize(("script", "follows"), [({"terminate_at": 2}, 0.0), ({"truncate_at": 2}, 2.3)])
def test_an_episode_that_ends_inside_an_option(
    script: dict[str, int], follows: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, tables = scripted(optioned([True] * 6, duration=5, **script), [3], monkeypatch)
    assert tables[0][0, 3] == pytest.approx((0.3 + 1 + GAMMA * 2 + GAMMA**2 * follows) / 2)
    assert tables[0][1, 1] == pytest.approx((1.1 + 2 + GAMMA * follows) / 2)
    assert tables[0][2:].tolist() == pytest.approx(np.arange(2, 6)[:, None] + np.arange(4) / 10)


def test_what_may_start_is_chosen_among_step_by_step(monkeypatch: pytest.MonkeyPatch) -> None:
    model = MacroQ(optioned([False, True, False, True, False, False], duration=1, terminate_at=5), gamma=GAMMA, seed=0)
    offered: list[list[int]] = []

    def first_of(values: list[float], choices: list[int]) -> int:
        offered.append(choices)
        return 0

    monkeypatch.setattr(model, "_explore", first_of)
    model.learn(6)
    assert offered == [[0, 1], [0, 1, 3], [0, 1], [0, 1, 3], [0, 1], [0, 1]]


def test_a_slot_that_has_run_out_is_not_chosen() -> None:
    env = OptionsWrapper(small_rooms(), 1, gamma=GAMMA, max_runs=1)
    env.bank.add(steady_option(1))
    model = MacroQ(env, gamma=GAMMA, epsilon=0.5, seed=0)
    chosen: list[tuple[int, int]] = []

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            chosen.append((int(self.locals["actions"][0]), self.locals["infos"][0]["option"]["index"]))
            return True

    model.learn(2000, callback=Watch())
    slots = [slot for action, slot in chosen if action >= env.n_primitive]
    assert len(slots) >= 5
    assert set(slots) == {0}


def test_greedy_ties_are_broken_evenly_and_epsilon_explores_all() -> None:
    model = MacroQ(line(), epsilon=0.0, seed=1)
    chosen = [model._explore([1.0, 2.0, 2.0, 5.0], [0, 1, 2]) for _ in range(4000)]
    assert np.bincount(chosen).tolist() == pytest.approx([0, 2000, 2000], abs=150)
    model.epsilon = 0.5
    chosen = [model._explore([1.0, 2.0, 0.0, 5.0], [0, 1, 2]) for _ in range(6000)]
    assert np.bincount(chosen).tolist() == pytest.approx([1000, 4000, 1000], abs=150)


def value_iteration(world: GridWorld) -> npt.NDArray[np.float64]:
    """Q* of a gridworld whose moves always succeed, shape (cells, 4)."""
    n = world.walls.size
    goal = world.goal[1] * world.width + world.goal[0]
    q = np.zeros((n, 4))
    led, free = np.zeros((n, 4), dtype=np.int64), ~world.walls
    for y, x in np.argwhere(free):
        for a, (dx, dy) in enumerate([(0, -1), (0, 1), (-1, 0), (1, 0)]):
            inside = 0 <= x + dx < world.width and 0 <= y + dy < world.height and free[y + dy, x + dx]
            led[y * world.width + x, a] = (y + dy) * world.width + x + dx if inside else y * world.width + x
    for _ in range(100):
        value = q.max(axis=1)
        q = np.where(led == goal, 1.0, GAMMA * value[led])
    return q


@pytest.mark.parametrize("features", [None, TileCoding([0, 0], [4, 3], [5, 4], n_tilings=2)])
def test_q_learning_converges_to_the_policy_of_value_iteration(features: TileCoding | None) -> None:
    world = GridWorld("SSSS.\nSS#S.\nSS#S.\nSSSSG", success_probability=1.0)
    seen = GridWorld("SSSS.\nSS#S.\nSS#S.\nSSSSG", success_probability=1.0, observation="xy")
    best = value_iteration(world)
    model = MacroQ(world if features is None else seen, features=features, learning_rate=0.5, epsilon=0.5, seed=0)
    model.learn(15_000)
    for x, y in world.start_cells:
        observation = np.eye(20, dtype=np.float32)[5 * y + x] if features is None else np.array([x, y], np.float32)
        action = int(model.predict(observation, deterministic=True)[0])
        row = best[5 * y + x]
        assert row[action] == row.max()
    some = np.array([[0.0, 0.0], [4.0, 3.0]]) if features else np.eye(20)[[0, 19]]
    assert [model._values(active) for active in model._active(some)] == model.policy.values(some).tolist()
    if features is None:
        acted = [5 * y + x for x, y in world.start_cells]
        assert table_of(model)[acted] == pytest.approx(best[acted], abs=1e-3)


def test_save_and_load(tmp_path: Path) -> None:
    env = optioned_rooms(1)
    model = MacroQ(env, seed=0, epsilon=0.2).learn(4000)
    model.save(tmp_path / "model")
    loaded = MacroQ.load(tmp_path / "model", env=optioned_rooms(1))
    assert (table_of(loaded) == table_of(model)).all()
    assert (loaded.epsilon, loaded.gamma, loaded._n_slots) == (0.2, 0.9, 1)
    loaded.learn(500, reset_num_timesteps=False)
    assert loaded.num_timesteps == 4500

    bare = MacroQ.load(tmp_path / "model")
    observations = np.eye(45, dtype=np.float32)
    expected = model.predict(observations, deterministic=True)[0]
    masks = np.ones((45, 5), dtype=bool)
    masks[:, 4] = False
    assert (bare.predict(observations, deterministic=True, action_masks=masks)[0] == expected).all()
    bare.set_env(DummyVecEnv([lambda: optioned_rooms(1)]))
    assert (bare.predict(observations, deterministic=True)[0] == expected).all()


def test_predict_respects_initiation_sets_and_epsilon() -> None:
    env = optioned([False, True, True, True, True, True], duration=2)
    model = MacroQ(env, epsilon=1.0, gamma=GAMMA, seed=0)
    table_of(model)[:, 2:] = 5.0
    assert model.predict(np.array([0, 1]), deterministic=True)[0].tolist() == [0, 3]
    single, state = model.predict(np.array(1), deterministic=True)
    assert int(single) == 3
    assert state is None
    drawn = model.predict(np.zeros(200, dtype=np.int64))[0]
    assert set(drawn.tolist()) == {0, 1}


def test_arguments_are_kept_and_have_defaults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)  # it is not asked

    defaults: dict[str, Any] = {"learning_rate": 0.05, "gamma": 0.9, "epsilon": 0.1, "tensorboard_log": None}
    defaults |= {"verbose": 0, "seed": None}
    given: dict[str, Any] = {"learning_rate": 1e-3, "gamma": 1.0, "epsilon": 0.0, "tensorboard_log": str(tmp_path)}
    given |= {"verbose": 2, "seed": 7, "features": OneHot(9, coded=False)}
    of_defaults, of_given = MacroQ(line(), device="meta"), MacroQ(DummyVecEnv([line] * 3), **given)
    for model, expected in ((of_defaults, defaults), (of_given, given)):
        assert {name: getattr(model, name) for name in expected} == expected
        assert (str(model.device), model.policy_class, model.policy.features) == ("cpu", LinearPolicy, model.features)
    assert (of_given.n_envs, table_of(of_given).shape, table_of(of_defaults).shape) == (3, (9, 2), (6, 2))
    assert MacroQ(None, _init_setup_model=False).env is None
    MacroQ(line(), gamma=0.0, epsilon=1.0)


def test_one_seed_is_one_training() -> None:
    models = [MacroQ(small_rooms(), seed=seed, epsilon=0.5).learn(1000) for seed in (3, 3, 4)]
    one, same, other = (table_of(model) for model in models)
    assert (one == same).all()
    assert (one != other).any()


@pytest.mark.parametrize("k", [8, 2.5, 0.5])
def test_an_action_s_own_duration_discounts(k: float) -> None:
    """A leg of k steps and no reward, then one of a step and a reward of 1 (docs/guide/your-environment.md)."""

    def step(env: CountingEnv, _: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        duration, over = (k, False) if env.time == 1 else (1, True)
        info = {"option": {"index": -1, "duration": duration, "discount": GAMMA**duration}}
        return np.ones(1), float(over), over, False, info

    model = MacroQ(numbered(CountingEnv(step=step), 2), gamma=GAMMA, learning_rate=0.5, epsilon=1.0, seed=0)
    model.learn(1_000, callback=PrimitiveStepsCallback())
    assert table_of(model).tolist() == [pytest.approx([GAMMA**k] * 2), pytest.approx([1.0] * 2)]


@pytest.mark.parametrize("force_reset", [None, True, False])
def test_another_environment_is_reset_unless_told_otherwise_and_its_slots_count(force_reset: bool | None) -> None:
    model = MacroQ(optioned([True] * 6, duration=2), gamma=GAMMA, seed=0).learn(2)
    bare: Any = line()
    bare.action_space = spaces.Discrete(4)
    for env, slots in ((bare, 0), (optioned([True] * 6, duration=2), 2)):
        model._last_obs = np.array([3])
        model.set_env(env, **({} if force_reset is None else {"force_reset": force_reset}))
        assert (model._last_obs is None) == (force_reset is not False)
        assert (model._n_slots, model._n_primitive, model._primitives) == (slots, 4 - slots, list(range(4 - slots)))
    assert env.slot_state.report_availability


@pytest.mark.parametrize("tells", [True, False])
def test_the_log_has_the_names_of_sb3(tells: bool) -> None:
    def step(env: CountingEnv, _: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        over = env.time == 2
        return np.array([env.time]), float(env.time), over, False, {"is_success": over} if tells else {}

    written: list[tuple[int, dict[str, Any], dict[str, Any]]] = []
    writer = MagicMock(spec=KVWriter)
    writer.write.side_effect = lambda values, excluded, step: written.append((step, {**values}, {**excluded}))
    model = MacroQ(line(step=step), seed=0)
    model.set_logger(Logger(None, [writer]))
    model.learn(8, log_interval=2)
    expected = {"rollout/ep_rew_mean": 3.0, "rollout/ep_len_mean": 2.0}
    expected |= {"rollout/success_rate": 1.0} if tells else {}
    expected |= {"time/episodes": 2, "time/total_timesteps": 4}
    excluded = {name: ("tensorboard",) if name.startswith("time/") else ("",) for name in expected}
    later = expected | {"time/episodes": 4, "time/total_timesteps": 8}
    assert written == [(4, expected, excluded), (8, later, excluded)]
    model.learn(8, log_interval=None)
    assert len(written) == 2


def test_arguments_of_learn_are_those_of_sb3() -> None:
    ours, theirs = ({p.name: p.default for p in signature(cls.learn).parameters.values()} for cls in (MacroQ, DQN))
    assert ours == {**theirs, "log_interval": 100, "tb_log_name": "MacroQ"}


@pytest.mark.parametrize(
    "value", [{"gamma": -0.1}, {"gamma": 1.1}, {"epsilon": -0.1}, {"epsilon": 1.1}, {"learning_rate": 0.0}]
)
def test_refuses_values_out_of_range(value: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"gamma and epsilon must be in \[0, 1\] and learning_rate positive, got"):
        MacroQ(line(), **value)


def test_refuses_what_it_cannot_learn() -> None:
    with pytest.raises(ValueError, match="There are no default features for Box"):
        MacroQ(CountingEnv())
    env = CountingEnv()
    env.action_space = spaces.Box(-1.0, 1.0, (1,))
    with pytest.raises(TypeError, match="MacroQ needs a Discrete action space, got Box"):
        MacroQ(env)


class Ring(CountingEnv):
    """A task without episodes, in which the last action is forbidden."""

    def __init__(self) -> None:
        super().__init__(3, step=lambda env, _: (np.array([env.time % 6]), float(env.time % 6 == 0), False, False, {}))

    def action_masks(self) -> npt.NDArray[np.bool_]:
        return np.array([True, True, False])


def test_where_no_episode_ends_rollouts_do() -> None:
    """Between two of them options are installed and closed, and checkpoints are written."""
    recorder = Recorder()
    MacroQ(OptionsWrapper(numbered(Ring(), 6), 1, gamma=0.9), gamma=0.9, seed=0).learn(3500, callback=recorder)
    assert recorder.ended == [LONGEST_ROLLOUT, 2 * LONGEST_ROLLOUT, 3 * LONGEST_ROLLOUT, 3500]


def test_actions_that_the_environment_forbids_are_never_taken() -> None:
    env = Ring()
    MacroQ(OptionsWrapper(numbered(env, 6), 1, gamma=0.9), gamma=0.9, epsilon=0.5, seed=0).learn(500)
    assert set(env.actions) == {0, 1}
