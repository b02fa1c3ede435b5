"""`RecordActions`: a checkpoint of an environment that does not tell where its episode is, by repeating the episode.

It holds how the episode began and which actions were taken. That an environment takes the same course again is seen
from its observations, its rewards and what it has drawn from its ``np_random``.
"""

from __future__ import annotations

import hashlib
from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

State = dict[str, Any]

MAX_ACTIONS = 100_000
"""An episode with more actions is not repeated. In MiniGrid so many take some ten seconds, and 4 MB until then."""

UNKNOWN = "it was under way before training started"
OTHERWISE = "it took another course the second time"
"""Why an episode does not go on."""


class RecordActions(gym.Wrapper[Any, Any, Any, Any]):
    """Notes how an episode began and its actions, and changes nothing.

    Attributes that others set, as ``VecEnv.set_attr`` does, are those of the environment.

    Args:
        env: Any.
        just_reset: Whether it has been reset and no step was taken; if not, its first episode is the one that begins
            with the next ``reset``.
    """

    def __init__(self, env: gym.Env[Any, Any], *, just_reset: bool = False) -> None:
        super().__init__(env)
        self._episode = _Episode(None)
        self._why: str | None = UNKNOWN
        seed = env.unwrapped._np_random_seed
        if just_reset and isinstance(seed, int) and seed >= 0:  # if it was reset again since, that will be seen
            self._episode, self._why = _Episode({"seed": seed, "options": None}), None

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # a property in gym.Wrapper, too
        """That of the environment: recording is no part of what ``gym.make`` makes again."""
        return self.env.spec

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "env" or name.startswith("_"):
            object.__setattr__(self, name, value)
        else:
            setattr(self.env, name, value)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset, and begin to note."""
        if seed is None:
            began = {"np_random": _random_state(self.env.unwrapped), "options": options}
        else:
            began = {"seed": int(seed), "options": options}
        self._why = None if _is_plain(options) else "the options of its reset cannot be stored"
        self._episode = _Episode(None if self._why else began)
        result = self.env.reset(seed=seed, options=options)
        self._episode.last = result[:1]
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """One step, which is noted."""
        episode = self._episode
        episode.actions.append(action.copy() if type(action) is np.ndarray else action)
        result = self.env.step(action)
        episode.last = result[:4]
        episode.rewards += result[1]
        return result

    def get_state(self) -> State:
        """For a checkpoint: what it takes to repeat the episode, and where it leads."""
        why, began, actions = self._why, self._episode.began, self._episode.actions
        if len(actions) > MAX_ACTIONS:
            why = f"it has more than {MAX_ACTIONS:,} actions"
        elif not all(type(each) is type(actions[0]) and _is_plain(each) for each in actions):
            why = "its actions cannot be stored"
        spaces = {name: getattr(self.env.unwrapped, name)._np_random for name in ("action_space", "observation_space")}
        return {
            "why": why,
            "began": None if why else began,
            "actions": None if why else np.array(actions),
            "numbers": bool(actions) and type(actions[0]) is int,
            "then": self._there(),
            "np_random": _random_state(self.env.unwrapped),
            "spaces": {name: random and random.bit_generator.state for name, random in spaces.items()},
        }

    def set_state(self, state: State) -> None:
        """Repeat the episode of `get_state`; `failure` says whether that has succeeded."""
        self._why = state["why"] or self._repeat(state)
        unwrapped = self.env.unwrapped
        if state["np_random"] is not None:
            unwrapped.np_random.bit_generator.state = state["np_random"]
        for name, random in state["spaces"].items():
            if random is not None:
                getattr(unwrapped, name).np_random.bit_generator.state = random

    def failure(self) -> str | None:
        """Why the episode cannot go on where it was; None if it can."""
        return self._why

    def _repeat(self, state: State) -> str | None:
        began, actions = dict(state["began"]), state["actions"]
        before = began.pop("np_random", None)
        if before is not None:
            self.env.unwrapped.np_random.bit_generator.state = before
        try:
            self.reset(**began)
            for action in actions.tolist() if state["numbers"] else actions:
                self.step(action)
        except Exception as error:  # whatever the environment raises: it did not raise it the first time
            return f"repeating it raised {type(error).__name__}: {error}"
        same = state["then"] in (self._there(), "") and state["np_random"] == _random_state(self.env.unwrapped)
        return None if same else OTHERWISE

    def _there(self) -> str:
        """A digest of where the episode is; empty where that is not known."""
        episode = self._episode
        return "" if episode.last is None else _digest((*episode.last, episode.rewards))


class _Episode:
    """What is noted of an episode.

    Attributes:
        began: The arguments of ``reset``, and the state of ``np_random`` before it where no seed was given; None where
            that is not known.
        actions: In order; the last of them only if there are more than `MAX_ACTIONS`.
        last: Observation, or observation, reward and flags, that came last; None where that is not known.
        rewards: Their sum.
    """

    __slots__ = ("actions", "began", "last", "rewards")

    def __init__(self, began: State | None) -> None:
        self.began = began
        self.actions: deque[Any] = deque(maxlen=MAX_ACTIONS + 1)
        self.last: tuple[Any, ...] | None = None
        self.rewards: Any = 0.0


def _random_state(env: Any) -> Any:
    """Of its ``np_random``; None where that is something of its own."""
    return getattr(getattr(env.np_random, "bit_generator", None), "state", None)


def _is_plain(value: Any) -> bool:
    """Whether a checkpoint can hold it."""
    if isinstance(value, dict):
        return all(type(key) is str and _is_plain(each) for key, each in value.items())
    if isinstance(value, list):
        return all(map(_is_plain, value))
    if isinstance(value, np.ndarray | np.generic):
        return value.dtype.kind in "biuf"
    return value is None or type(value) in (bool, int, float, str)


def _digest(value: Any) -> str:
    """SHA-256 of an observation, or of anything else, with its types."""
    sha256 = hashlib.sha256()
    _add(sha256, value)
    return sha256.hexdigest()


def _add(sha256: Any, value: Any) -> None:
    sha256.update(type(value).__name__.encode())
    if isinstance(value, dict):
        for key, each in value.items():
            _add(sha256, key)
            _add(sha256, each)
    elif isinstance(value, tuple | list):
        for each in value:
            _add(sha256, each)
    elif isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biufc":
        sha256.update(f"{value.dtype} {value.shape} ".encode() + value.tobytes())
    else:
        sha256.update(repr(value).encode())
