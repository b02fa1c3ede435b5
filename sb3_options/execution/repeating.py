"""`RecordActions`: checkpoints an environment of unknown state, by repeating its episode.

It stores how the episode began and which actions were taken. Observations, rewards and the draws from ``np_random``
show whether the environment takes the same course again.
"""

import hashlib
from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

State = dict[str, Any]

MAX_ACTIONS = 100_000  # a longer episode is not repeated; in MiniGrid this many take some ten seconds, and 4 MB
# Why an episode does not go on:
UNKNOWN = "it was under way before training started"
OTHERWISE = "it took another course the second time"


class RecordActions(gym.Wrapper[Any, Any, Any, Any]):
    """Records how an episode began and its actions, and changes nothing.

    Attributes that others set, as ``VecEnv.set_attr`` does, are set on the environment. If it was not ``just_reset``,
    its first recorded episode begins with the next ``reset``.
    """

    def __init__(self, env: gym.Env[Any, Any], *, just_reset: bool = False) -> None:
        super().__init__(env)
        self._note(None, UNKNOWN)
        seed = env.unwrapped._np_random_seed
        if just_reset and isinstance(seed, int) and seed >= 0:  # another reset since then will be noticed
            self._note({"seed": seed}, None)

    def _note(self, began: State | None, why: str | None) -> None:
        """Begin to record an episode."""
        self._began = began  # arguments of reset, or the state of np_random before it if no seed was given
        self._why = why  # reason why it cannot be repeated
        self._actions: deque[Any] = deque(maxlen=MAX_ACTIONS + 1)
        self._last: tuple[Any, ...] | None = None  # what reset or step returned
        self._rewards: Any = 0.0

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # a property in gym.Wrapper, too
        """Spec of the environment: ``gym.make`` must not recreate the recording."""
        return self.env.spec

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "env" or name.startswith("_"):
            object.__setattr__(self, name, value)
        else:
            setattr(self.env, name, value)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, and begin to record."""
        if options:
            self._note(None, "its reset was given options")
        elif seed is None:
            _ = self.env.unwrapped.np_random  # a generator made in reset would draw its seed from the system
            self._note({"before": random_states(self.env.unwrapped)["np_random"]}, None)
        else:
            self._note({"seed": int(seed)}, None)
        result = self.env.reset(seed=seed, options=options)
        self._last = result[:1]
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take one step, and record it."""
        self._actions.append(action.copy() if type(action) is np.ndarray else action)
        result = self.env.step(action)
        self._last = result[:4]
        self._rewards += result[1]
        return result

    def get_state(self) -> State:
        """Return, for a checkpoint, the actions and seeds that repeat the episode, and a digest of where it is."""
        too_long = f"it has more than {MAX_ACTIONS:,} actions" if len(self._actions) > MAX_ACTIONS else None
        why = self._why or too_long
        return {
            "why": why,
            "began": self._began,
            "actions": None if why else np.array(self._actions),
            "numbers": bool(self._actions) and type(self._actions[0]) is int,
            "then": self._there(),
            "random": random_states(self.env.unwrapped),
        }

    def set_state(self, state: State) -> None:
        """Repeat the episode of `get_state`; `failure` says whether that succeeded."""
        self._why = state["why"] or self._repeat(state)
        set_random_states(self.env.unwrapped, state["random"])

    def failure(self) -> str | None:
        """Return why the episode cannot resume where it was, or None if it can."""
        return self._why

    def _repeat(self, state: State) -> str | None:
        began, actions = dict(state["began"]), state["actions"]
        set_random_states(self.env.unwrapped, {"np_random": began.pop("before", None)})
        try:
            self.reset(**began)
            for action in actions.tolist() if state["numbers"] else actions:
                self.step(action)
        except Exception as error:  # any error: there was none the first time
            return f"repeating it raised {type(error).__name__}: {error}"
        drawn = random_states(self.env.unwrapped)["np_random"]
        same = state["then"] in (self._there(), "") and state["random"]["np_random"] == drawn
        return None if same else OTHERWISE

    def _there(self) -> str:
        """Return a digest of where the episode is, or an empty text if that is unknown."""
        if self._last is None:
            return ""
        sha256 = hashlib.sha256()
        _add(sha256, (*self._last, self._rewards))
        return sha256.hexdigest()


def random_states(env: Any) -> State:
    """Return the generators' states of an environment and its spaces; None for a missing or unknown one."""
    spaces = {name: getattr(env, name)._np_random for name in ("action_space", "observation_space")}
    generators = {"np_random": env._np_random, **spaces}  # reading np_random would create one
    return {name: getattr(getattr(each, "bit_generator", None), "state", None) for name, each in generators.items()}


def set_random_states(env: Any, states: State) -> None:
    """Restore the generators from `random_states`."""
    for name, state in states.items():
        if state is not None:
            (env if name == "np_random" else getattr(env, name)).np_random.bit_generator.state = state


def _add(sha256: Any, value: Any) -> None:
    """Add an observation, or anything else, with its types, to a digest."""
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
