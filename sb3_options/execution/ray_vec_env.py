"""`RayVecEnv`: environments on many machines, which survive the loss of one."""

from __future__ import annotations

import copy
import logging
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import ModuleType
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.vec_env import SubprocVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnv
from stable_baselines3.common.vec_env.patch_gym import _patch_env

from sb3_options.execution.above import Outermost
from sb3_options.execution.workers import PATIENCE, WorkerLostError
from sb3_options.extras import how_to_install

logger = logging.getLogger("sb3_options")

EnvFns: TypeAlias = Sequence[Callable[[], gym.Env[Any, Any]]]

Message: TypeAlias = tuple[int, str, Any]
"""Number of an environment in its actor, and what ``SubprocVecEnv`` sends to a worker: command and data."""

MOST_LOSSES = 8  # losses of the same environments, with no step between them, after which the fault is theirs

FIRST_WAIT = 0.25
"""Seconds before a second start: the cluster may not have noticed yet which machine is gone. Doubles each time."""

LEAST_WAIT = 1.0  # seconds in which an answer that is there can be fetched, though another one has used up the time


OBJECT_STORE = 200 * 2**20
"""Bytes of shared memory of a cluster that is started here. Ray's default is 30 % of the machine's memory; what
environments and studies send is small and passes it by, but for images."""


def require_ray() -> ModuleType:
    """Ray, imported."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read on import; by default Ray reports to its makers
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # without it Ray warns that this will be so
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"Ray is not installed: {how_to_install('cluster')}, on every machine.", name=error.name
        ) from error
    return ray


def connect(address: str | None = None) -> Any:
    """Ray, connected to a cluster as ``ray.init`` takes its address; what is connected already stays so.

    None is the cluster that the variable ``RAY_ADDRESS`` names, else a new one of this machine alone, which ends with
    the process.
    """
    ray = require_ray()
    if ray.is_initialized():
        return ray
    address = address or os.environ.get("RAY_ADDRESS")
    if address is None:
        ray.init(address="local", include_dashboard=False, object_store_memory=OBJECT_STORE)
    else:
        ray.init(address=address)
    return ray


class HostedEnvironments:
    """The environments of an actor, one after the other. Behaves as the workers of ``SubprocVecEnv``."""

    def __init__(self, env_fns: EnvFns) -> None:
        self._env_fns = env_fns
        self.envs: list[Any] = []  # made later: an error in one is not one of starting the process
        self._reset_infos: list[Any] = [{} for _ in env_fns]

    def answer(self, messages: Sequence[Message]) -> list[Any]:
        """The answers to messages."""
        self.envs = self.envs or [_patch_env(make()) for make in self._env_fns]
        # They share nothing, and what Ray hands out cannot be written to.
        return [self._answer(i, command, copy.deepcopy(data)) for i, command, data in messages]

    def _answer(self, i: int, command: str, data: Any) -> Any:
        env = self.envs[i]
        if command == "step":
            observation, reward, terminated, truncated, info = env.step(data)
            done = terminated or truncated
            info["TimeLimit.truncated"] = truncated and not terminated
            if done:
                info["terminal_observation"] = observation
                observation, self._reset_infos[i] = env.reset()
            return observation, reward, done, info, self._reset_infos[i]
        if command == "reset":
            seed, options = data
            observation, self._reset_infos[i] = env.reset(seed=seed, **({"options": options} if options else {}))
            return observation, self._reset_infos[i]
        return _HOW[command](env, data)

    def close(self) -> None:
        """Close all of them."""
        for env in self.envs:
            env.close()


def _lost_step(env: Any, last: Any) -> dict[str, Any]:
    """The info of a step from the last known observation that is lost with its environment."""
    info = env.get_wrapper_attr("lost_step")(last) if env.has_wrapper_attr("lost_step") else {}
    return info | {"TimeLimit.truncated": True, "terminal_observation": last, "lost": True}


_HOW: dict[str, Callable[[Any, Any], Any]] = {
    "get_spaces": lambda env, _: (env.observation_space, env.action_space),
    "env_method": lambda env, data: env.get_wrapper_attr(data[0])(*data[1], **data[2]),
    "get_attr": lambda env, name: env.get_wrapper_attr(name),
    "has_attr": lambda env, name: env.has_wrapper_attr(name),
    "set_attr": lambda env, data: setattr(env, *data),
    "is_wrapped": is_wrapped,
    "lost_step": _lost_step,
    "render": lambda env, _: env.render(),
}


class _Pipe:
    """Stands for ``SubprocVecEnv``'s pipe to a worker. Messages wait until the first answer is asked for."""

    def __init__(self, venv: RayVecEnv, actor: int, index: int) -> None:
        self._venv = venv
        self._actor = actor
        self._index = index
        self.inbox: deque[Any] = deque()

    def send(self, message: tuple[str, Any]) -> None:
        self._venv._outboxes[self._actor].append((self._index, *message))

    def recv(self) -> Any:
        if not self.inbox:
            self._venv._exchange()
        return self.inbox.popleft()


class RayVecEnv(SubprocVecEnv):
    """A ``SubprocVecEnv`` whose environments live in Ray actors, several to an actor, on all machines of a cluster.

    It gives the same trajectories for the same seeds. A step is one message to each actor and takes a millisecond more
    than the environments, so it is for environments that cost. Every machine needs the same Python and packages.

    The loss of a machine, or of a process, ends no training. The environments of its actors start anew elsewhere, with
    seeds of their own and what was put into their slots (`OptionsWrapper.set_slots`). Episodes in flight end as
    truncated: reward 0, ``info["TimeLimit.truncated"]``, the last known observation as ``terminal_observation``, and
    ``info["lost"]``. There is one warning a loss. What is lost before the first reset starts anew and is not counted.

    Args:
        env_fns: Each makes an environment.
        n_actors: Actors, at most one an environment; by default one a core of the cluster. Ray spreads them.
        step_timeout: Seconds that an actor may take for an answer before it is lost; None waits for ever. Ray itself
            notices a process that ended, and after a minute a machine that hangs, but no process that hangs.

    Attributes:
        lost_actors: How often an actor was lost.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        ConnectionError: There is no cluster where the variable ``RAY_ADDRESS`` says.
        WorkerLostError: The same environments were lost time and again.
    """

    def __init__(self, env_fns: EnvFns, n_actors: int | None = None, *, step_timeout: float | None = 600.0) -> None:
        self._ray = connect()
        # No reserved cores, so that environments always find another place. To note every step for Ray's dashboard
        # takes a sixth of the time of a call.
        self._class = self._ray.remote(HostedEnvironments).options(
            num_cpus=0, scheduling_strategy="SPREAD", enable_task_events=False
        )
        of = self._ray.exceptions
        gone = of.RayActorError, of.NodeDiedError, of.WorkerCrashedError, of.ObjectLostError, of.OutOfMemoryError
        self._gone: tuple[type[Exception], ...] = (*gone, of.GetTimeoutError)
        n_envs = len(env_fns)
        n_actors = min(n_envs, n_actors or max(1, int(self._ray.cluster_resources().get("CPU", 1))))
        self._groups = [group.tolist() for group in np.array_split(np.arange(n_envs), n_actors)]
        self._env_fns = list(env_fns)
        self._slots: list[dict[str, Any]] = [{} for _ in env_fns]  # by environment, what `set_slots` was given
        self._first_seeds: list[int | None] = [None] * n_envs
        self._seen: list[Any] = [None] * n_envs  # the last observations
        self._losses_in_a_row = [0] * n_actors
        self._anew: dict[int, list[Any]] = {}  # by actor, answers to the next step of environments that started anew
        self._outboxes: list[list[Message]] = [[] for _ in range(n_actors)]
        self.lost_actors = 0
        self.waiting = False
        self.closed = False
        self.processes = []
        self.remotes: Any = [_Pipe(self, a, i) for a, group in enumerate(self._groups) for i in range(len(group))]
        self._actors = [self._start(a) for a in range(n_actors)]
        self.step_timeout: float | None = None  # to make an environment may take longer than a step
        firsts = [self.remotes[group[0]] for group in self._groups]
        for first in firsts:
            first.send(("get_spaces", None))
        spaces = [first.recv() for first in firsts]
        self.step_timeout = step_timeout
        VecEnv.__init__(self, n_envs, *spaces[0])

    def _start(self, actor: int) -> Any:
        return self._class.remote([self._env_fns[i] for i in self._groups[actor]])

    def close(self) -> None:
        """Close the environments and end their actors; the cluster goes on."""
        if self.closed:
            return
        self.closed = True
        if self._ray.is_initialized():
            closing = [actor.close.remote() for actor in self._actors]
            self._ray.wait(closing, num_returns=len(closing), timeout=PATIENCE)
            for actor in range(len(self._actors)):
                self._kill(actor)

    def _kill(self, actor: int) -> None:
        with suppress(self._ray.exceptions.RayError):
            self._ray.kill(self._actors[actor])

    def _exchange(self) -> None:
        """Send the messages that wait. An actor that is lost starts anew and gets them again, but not a step."""
        outgoing = {a: messages for a, messages in enumerate(self._outboxes) if messages}
        self._outboxes = [[] for _ in self._actors]
        for remote in self.remotes:
            remote.inbox.clear()  # an error may have left something
        while outgoing:
            for a in [a for a, messages in outgoing.items() if messages[0][1] == "step" and a in self._anew]:
                self._deliver(a, outgoing.pop(a), self._anew.pop(a))
            until = None if self.step_timeout is None else time.monotonic() + self.step_timeout
            sent = {a: self._actors[a].answer.remote(messages) for a, messages in outgoing.items()}
            lost: dict[int, Exception] = {}
            for a, reference in sent.items():
                try:
                    answers = self._get(reference, until)
                except self._gone as error:
                    lost[a] = error
                else:
                    if outgoing[a][0][1] in ("step", "reset"):
                        self._losses_in_a_row[a] = 0
                    self._deliver(a, outgoing.pop(a), answers)
            for a, why in lost.items():
                self._start_anew(a, why)

    def _deliver(self, actor: int, messages: Sequence[Message], answers: Sequence[Any]) -> None:
        """Put answers where they are waited for, and note what environments that start anew will need."""
        for (i, command, data), answer in zip(messages, answers, strict=True):
            env = self._groups[actor][i]
            if command in ("step", "reset"):
                self._seen[env] = answer[0]
            if command == "reset":
                self._anew.pop(actor, None)
                self._first_seeds[env] = self._first_seeds[env] if data[0] is None else data[0]
            if command == "env_method" and data[0] in ("set_slots", "set_option"):
                changes = data[2] if data[0] == "set_slots" else {"options": dict([data[1]])}
                options = {**self._slots[env].get("options", {}), **changes.get("options", {})}
                self._slots[env] = {**self._slots[env], **changes, "options": options}
            self.remotes[env].inbox.append(answer)

    def _get(self, reference: Any, until: float | None = None) -> list[Any]:
        """The answers of an actor. An error in an environment is that error."""
        limit = None if until is None else max(LEAST_WAIT, until - time.monotonic())
        try:
            answers: list[Any] = copy.deepcopy(self._ray.get(reference, timeout=limit))  # it cannot be written to
        except self._ray.exceptions.RayTaskError as error:
            raise error.cause if isinstance(error.cause, Exception) else error from error
        return answers

    def _start_anew(self, actor: int, why: Exception) -> None:
        """Start the environments of a lost actor elsewhere, with what was set in them."""
        which = f"Environments {self._groups[actor]} of {len(self._env_fns)}"
        reason = type(why).__name__
        if self._seen[self._groups[actor][0]] is not None:
            self.lost_actors += 1
            logger.warning(
                "%s: the machine or the process is gone (%s). They start anew elsewhere; their episodes end as "
                "truncated.",
                which,
                reason,
            )
        while self._losses_in_a_row[actor] < MOST_LOSSES:
            if self._losses_in_a_row[actor]:
                time.sleep(FIRST_WAIT * 2.0 ** (self._losses_in_a_row[actor] - 1))
            self._losses_in_a_row[actor] += 1
            self._kill(actor)
            self._actors[actor] = self._start(actor)
            with suppress(*self._gone):
                self._begin(actor)
                return
        raise WorkerLostError(
            f"{which}: lost {MOST_LOSSES + 1} times without a step between. {reason}",
            "If memory is short, train with fewer of them or more machines; `ray status` shows these.",
            killed=True,
        ) from why

    def _begin(self, actor: int) -> None:
        """Put options into environments that start anew, reset them, and keep the answers to the step that is lost."""
        envs = list(enumerate(self._groups[actor]))
        seen = [self._seen[env] for _, env in envs]
        set_again = [(i, "env_method", ("set_slots", (), self._slots[env])) for i, env in envs if self._slots[env]]
        outermost = [(i, "is_wrapped", Outermost) for i, *_ in set_again]  # what is asked of each at first
        ask = self._actors[actor].answer.remote
        self._get(ask([*outermost, *set_again]))
        if seen[0] is None:
            return
        resets = self._get(ask([(i, "reset", (self._later_seed(env), {})) for i, env in envs]))
        infos = self._get(ask([(i, "lost_step", seen[i]) for i, _ in envs]))
        self._anew[actor] = [
            (observation, 0.0, True, info, reset_info)
            for (observation, reset_info), info in zip(resets, infos, strict=True)
        ]

    def _later_seed(self, env: int) -> int | None:
        """A seed that no environment has had; None where none was seeded."""
        first = self._first_seeds[env]
        if first is None:
            return None
        return int(np.random.SeedSequence([first, self.lost_actors]).generate_state(1)[0])
