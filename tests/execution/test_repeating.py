"""Environments that do not tell their state go on in mid-episode, because the episode is repeated."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces, wrappers
from stable_baselines3.common.monitor import Monitor

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import OptionsWrapper
from sb3_options.envs.minigrid import make as make_minigrid
from sb3_options.execution import layers, repeating
from sb3_options.execution.repeating import OTHERWISE, UNKNOWN, RecordActions
from tests.support.sb3_helpers import TAXI, small_rooms

Env = gym.Env[Any, Any]

MAKERS: dict[str, Callable[[], Env]] = {
    "CartPole": lambda: gym.make("CartPole-v1"),
    "Taxi": lambda: gym.make(TAXI),
    "MiniGrid": lambda: make_minigrid("MiniGrid-DoorKey-5x5-v0", max_steps=60),
    "frames": lambda: wrappers.FrameStackObservation(gym.make("CartPole-v1"), 3),
    "averages": lambda: wrappers.NormalizeReward(wrappers.NormalizeObservation(gym.make("CartPole-v1"))),
    "rooms": small_rooms,
    "Pendulum": lambda: gym.make("Pendulum-v1"),
}


def advanced(env: Env, steps: int, random: np.random.Generator) -> list[Any]:
    """Random steps, on from one episode into the next; returns what came."""
    seen: list[Any] = []
    for _ in range(steps):
        if isinstance(env.action_space, spaces.Discrete):
            action: Any = int(random.integers(env.action_space.n))
        else:
            action = random.uniform(-2, 2, env.action_space.shape or ()).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append((np.array(observation).tobytes(), float(reward), terminated, truncated))
        if terminated or truncated:
            seen.append(np.array(env.reset()[0]).tobytes())
    return seen


def begun(env: Env, steps: int = 0, seed: int = 0) -> Any:
    """The environment, whose episode can be repeated, after some random steps."""
    env = layers.prepare(env)
    env.reset(seed=seed)
    advanced(env, steps, np.random.default_rng(0))
    return env


def another(make: Callable[[], Env], states: list[layers.State]) -> tuple[Env, str | None]:
    """Another environment, which goes on with a state."""
    env = begun(make(), seed=123)
    return env, layers.set_states(env, states)


@pytest.mark.parametrize("steps", [0, 1, 37, 150])
@pytest.mark.parametrize("name", MAKERS)
def test_goes_on_in_mid_episode(name: str, steps: int) -> None:
    env = begun(MAKERS[name](), seed=3)
    random = np.random.default_rng(steps)
    advanced(env, steps, random)
    states, drawn = layers.states_of(env), random.bit_generator.state
    there = advanced(env, 100, random)
    copy, failure = another(MAKERS[name], states)
    random.bit_generator.state = drawn
    assert failure is None
    assert advanced(copy, 100, random) == there


def test_is_put_around_the_outermost_that_does_not_tell() -> None:
    class Own(gym.Wrapper[Any, Any, Any, Any]):
        pass

    def chain(env: Any) -> list[str]:
        return [type(layer).__name__ for layer in layers._layers(env)]

    env = OptionsWrapper(Monitor(Own(gym.make("CartPole-v1"))), 2)
    for _ in range(2):  # a second time changes nothing
        assert layers.prepare(env) is env
        assert chain(env)[:4] == ["OptionsWrapper", "Monitor", "RecordActions", "Own"]
    assert chain(layers.prepare(Own(small_rooms())))[:2] == ["RecordActions", "Own"]
    assert chain(layers.prepare(gym.make("CartPole-v1"))) == [
        *("TimeLimit", "OrderEnforcing", "PassiveEnvChecker", "RecordActions", "CartPoleEnv")
    ]
    assert "RecordActions" not in chain(layers.prepare(OptionsWrapper(small_rooms(), 2)))
    text = r"^Checkpoints of Own are not supported above OptionsWrapper: put the wrapper"
    with pytest.raises(ValueError, match=text):
        layers.prepare(Own(OptionsWrapper(small_rooms(), 2)))


class Growing(gym.Env[Any, Any]):
    """Its observations grow from episode to episode: what it remembers is not in its ``np_random``."""

    observation_space = spaces.Box(0, np.inf, (1,))
    action_space = spaces.Discrete(2)

    def __init__(self, *, by_reward: bool = False, fails: bool = False) -> None:
        self.resets = -1
        self.by_reward, self.fails = by_reward, fails

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.resets += 1
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.fails and self.resets == 1:
            raise RuntimeError("a bug")
        return self._observation(), float(self.by_reward * self.resets), False, False, {}

    def _observation(self) -> Any:
        return np.array([0.0 if self.by_reward else self.resets], dtype=np.float32)


@pytest.mark.parametrize(
    ("how", "why"),
    [({}, OTHERWISE), ({"by_reward": True}, OTHERWISE), ({"fails": True}, "repeating it raised RuntimeError: a bug")],
)
def test_what_survives_a_reset_is_seen(how: dict[str, bool], why: str) -> None:
    env = begun(Growing(**how), 3)
    assert another(lambda: Growing(**how), layers.states_of(env))[1] == why


def test_an_episode_without_end_takes_no_more_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(repeating, "MAX_ACTIONS", 20)
    env = begun(Growing(), 20)
    assert another(Growing, layers.states_of(env))[1] != "it has more than 20 actions"
    advanced(env, 100, np.random.default_rng(0))
    assert len(env._actions) == 21
    state = layers.states_of(env)
    assert state[0]["own"]["actions"] is None
    assert another(Growing, state)[1] == "it has more than 20 actions"


def test_an_episode_that_was_under_way_is_not_repeated() -> None:
    env = gym.make("CartPole-v1")
    env.reset(seed=0)
    layers.prepare(env)
    env.step(0)
    assert another(MAKERS["CartPole"], layers.states_of(env))[1] == UNKNOWN
    env.reset()
    assert another(MAKERS["CartPole"], layers.states_of(env))[1] is None


@pytest.mark.parametrize("steps", [0, 5])
def test_an_episode_that_has_just_begun_is_repeated_by_its_seed(steps: int) -> None:
    env = gym.make("CartPole-v1")
    env.reset(seed=5)
    layers.prepare(env, just_reset=True)
    assert len(advanced(env, steps, np.random.default_rng(0))) == steps
    copy, failure = another(MAKERS["CartPole"], layers.states_of(env))
    assert failure is None
    assert advanced(copy, 5, np.random.default_rng(1)) == advanced(env, 5, np.random.default_rng(1))


class Asked(gym.Env[Any, Any]):
    """Remembers how it was reset, and with what it was stepped."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self) -> None:
        self.asked: list[Any] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.asked.append((seed, options))
        return {"a": np.zeros(1), "b": (1, "two")}, {"random": len(self.asked)}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.asked.append(type(action))
        return {"a": np.zeros(1), "b": (1, "two")}, 1.0, False, False, {"random": len(self.asked)}


def test_resets_and_actions_arrive_as_they_were_given() -> None:
    """Infos may differ from one time to the other."""
    env, inner = RecordActions(Asked()), Asked()
    assert env.get_state()["why"] == UNKNOWN
    env.reset(seed=3, options={"there": 1})
    assert env.unwrapped.asked == [(3, {"there": 1})]  # type: ignore[attr-defined]  # of Asked
    assert env.get_state()["why"] == "its reset was given options"
    for first in (2, np.int64(2), np.zeros(1)):
        env.reset(seed=0)
        env.step(first)
        if isinstance(first, np.ndarray):
            first += 1  # it is the caller's, who may write to it
            assert env.get_state()["actions"].tolist() == [[0.0]]
        state = env.get_state()
        assert state["numbers"] is (type(first) is int)
        again = RecordActions(inner)
        again.set_state(state)
        assert again.failure() is None
        again.step(first)
        assert inner.asked[-2:] == [type(first), type(first)]


@pytest.mark.parametrize("seed", [0, 1])
def test_any_seed_repeats_an_episode_but_only_where_it_has_just_begun(seed: int) -> None:
    env = gym.make("CartPole-v1").unwrapped
    env.reset(seed=seed)
    assert RecordActions(env, just_reset=True).get_state()["began"] == {"seed": seed}
    assert RecordActions(env).get_state()["began"] is None


def test_every_part_of_an_observation_tells_courses_apart() -> None:
    def digest(observation: Any, reward: float = 0.0) -> str:
        env = RecordActions(Growing())
        env._last, env._rewards = (observation,), reward
        return env._there()

    there = [
        *(np.zeros(1), np.zeros(2), np.zeros(1, np.float32), np.ones(1), np.float64(0), np.float32(0), 0.0, 0),
        *({"a": 0}, {"b": 0}, {"a": 1}, (0, 1), (1, 0), [0, 1], "a", "b", None, np.array(["a"]), np.array(["b"])),
        *(np.array([0j]), np.array([True]), np.array([1], np.uint8), np.array([None])),
    ]
    digests = [digest(each) for each in there] + [digest(np.zeros(1), reward=1.0)]
    assert len(set(digests)) == len(digests)
    assert digests == [digest(each) for each in there] + [digest(np.zeros(1), reward=1.0)]
    assert RecordActions(Growing())._there() == ""
