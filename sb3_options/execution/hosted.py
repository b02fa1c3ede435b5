"""Several environments in one process, as `RayVecEnv` has them in each of its actors."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.vec_env.patch_gym import _patch_env
from stable_baselines3.common.vec_env.subproc_vec_env import _stack_obs

from sb3_options.execution.above import Outermost
from sb3_options.execution.slots import SlotState

Infos = list[dict[str, Any]]


Settings = tuple[SlotState | None, Mapping[str, Any]]
"""What was set in one environment, slots and attributes, to be set again in one that takes its place."""


class Steps(NamedTuple):
    """What one step of several environments returned, as ``SubprocVecEnv`` has it of one."""

    observations: Any
    rewards: list[Any]
    dones: list[bool]
    infos: Infos
    reset_infos: Infos


class HostedEnvironments:
    """Some environments of a ``VecEnv``, stepped one after the other. Behaves as the worker of ``SubprocVecEnv``.

    Args:
        env_fns: Each makes an environment, when `make` is called: an error in one is not one of starting the process.
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env[Any, Any]]]) -> None:
        self._env_fns = list(env_fns)
        self.envs: list[Any] = []
        self._reset_infos: Infos = [{} for _ in env_fns]
        self._known: list[SlotState | None] = []

    def make(self) -> tuple[Any, Any]:
        """Make them, once; returns observation space and action space of the first."""
        if not self.envs:
            self.envs = [_patch_env(make()) for make in self._env_fns]
            self._known = [_slots_of(env) for env in self.envs]
        return self.envs[0].observation_space, self.envs[0].action_space

    def begin(self, settings: Sequence[Settings], seeds: Sequence[int | None]) -> None:
        """Make them in the place of others that are lost; ``seeds`` are for the action spaces."""
        self.make()
        for env, (slots, attributes), seed in zip(self.envs, copy.deepcopy(list(settings)), seeds, strict=True):
            if seed is not None:
                env.action_space.seed(seed)
            for name, value in attributes.items():
                setattr(env, name, value)
            if slots is not None and is_wrapped(env, Outermost):  # type: ignore[arg-type]  # it is asked of each
                env.get_wrapper_attr("set_slots")(**vars(slots))
        self._known = [_slots_of(env) for env in self.envs]

    def reset(self, seeds: Sequence[int | None], options: Sequence[dict[str, Any]]) -> tuple[Any, Infos]:
        """Reset all of them."""
        observations = []
        for i, (env, seed, option) in enumerate(zip(self.envs, seeds, options, strict=True)):
            observation, self._reset_infos[i] = env.reset(seed=seed, **({"options": option} if option else {}))
            observations.append(observation)
        return _stack_obs(observations, self.envs[0].observation_space), list(self._reset_infos)

    def step(self, actions: Any) -> Steps:
        """A step of each; one whose episode ends is reset."""
        observations, rewards, dones, infos = [], [], [], []
        for i, (env, action) in enumerate(zip(self.envs, actions, strict=True)):
            observation, reward, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            info["TimeLimit.truncated"] = truncated and not terminated
            if done:
                info["terminal_observation"] = observation
                observation, self._reset_infos[i] = env.reset()
            observations.append(observation)
            rewards.append(reward)
            dones.append(done)
            infos.append(info)
        stacked = _stack_obs(observations, self.envs[0].observation_space)
        return Steps(stacked, rewards, dones, infos, list(self._reset_infos))

    def lost_infos(self, observations: Sequence[Any]) -> Infos:
        """Infos of a step whose outcome is lost, given the last observation that is known of each environment."""
        return [
            env.get_wrapper_attr("lost_step")(seen) if env.has_wrapper_attr("lost_step") else {}
            for env, seen in zip(self.envs, observations, strict=True)
        ]

    def call(
        self, kind: str, indices: Sequence[int], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> tuple[list[Any], dict[int, SlotState]]:
        """What others ask of some of them, ``env_method``, ``get_attr`` and so on, and which slots this has changed.

        Each gets arguments of its own: they share nothing, and what Ray hands out cannot be written to.
        """
        answers, changed = [], {}
        for i in indices:
            answers.append(_HOW[kind](self.envs[i], *copy.deepcopy(args), **copy.deepcopy(kwargs)))
            now = _slots_of(self.envs[i])
            if now is not None and now is not self._known[i]:
                self._known[i] = changed[i] = now
        return answers, changed

    def close(self) -> None:
        """Close all of them."""
        for env in self.envs:
            env.close()


def _slots_of(env: Any) -> SlotState | None:
    return env.get_wrapper_attr("slot_state") if env.has_wrapper_attr("slot_state") else None


def _method(env: Any, name: str, *args: Any, **kwargs: Any) -> Any:
    return env.get_wrapper_attr(name)(*args, **kwargs)


_HOW: dict[str, Callable[..., Any]] = {
    "env_method": _method,
    "get_attr": lambda env, name: env.get_wrapper_attr(name),
    "has_attr": lambda env, name: env.has_wrapper_attr(name),
    "set_attr": setattr,
    "is_wrapped": is_wrapped,
    "render": lambda env: env.render(),
}
