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
# Number of an environment in its actor, then command and data as ``SubprocVecEnv`` sends them to a worker.
Message: TypeAlias = tuple[int, str, Any]

MOST_LOSSES = 8  # losses of the same environments without a step between, after which they are to blame
FIRST_WAIT = 0.25  # seconds before a second start, then doubled: the cluster may not yet know which machine is gone
LEAST_WAIT = 1.0  # seconds to fetch an answer that is ready, although another one has used up the time

# Bytes of shared memory of a cluster that is started here. Ray's default is 30 % of the machine's memory. Messages of
# environments and studies are small and bypass it, except for images.
OBJECT_STORE = 200 * 2**20


def require_ray() -> ModuleType:
    """Import and return Ray."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read on import; by default Ray sends usage reports
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # else Ray warns that this will be the default
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"Ray is not installed: {how_to_install('cluster')}, on every machine.", name=error.name
        ) from error
    return ray


def connect(address: str | None = None) -> Any:
    """Return Ray, connected to a cluster at an address of ``ray.init``. An existing connection is kept.

    None is the cluster named in the variable ``RAY_ADDRESS``, else a new one of this machine alone, which ends with the
    process.
    """
    ray = require_ray()
    if ray.is_initialized():
        return ray
    address = address or os.environ.get("RAY_ADDRESS")
    new = {"include_dashboard": False, "object_store_memory": OBJECT_STORE} if address is None else {}
    ray.init(address=address or "local", **new)
    return ray


class HostedEnvironments:
    """The environments of an actor, which run one after the other. Behaves as the workers of ``SubprocVecEnv``."""

    def __init__(self, env_fns: EnvFns) -> None:
        self._env_fns = env_fns
        self.envs: list[Any] = []  # made later: an error in one must not look like a failed process start
        self._reset_infos: list[Any] = [{} for _ in env_fns]

    def answer(self, messages: Sequence[Message]) -> list[Any]:
        """Return the answers to messages."""
        self.envs = self.envs or [_patch_env(make()) for make in self._env_fns]
        # Environments must share nothing, and Ray's objects are read-only.
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
        if command == "restart":
            return self._restarted(i, *data)
        return _HOW[command](env, data)

    def _restarted(self, i: int, slots: dict[str, Any], seed: int | None, last: Any) -> Any:
        """Fill the slots of an environment that was lost, and answer its lost step from the last observation."""
        env = self.envs[i]
        if slots:
            is_wrapped(env, Outermost)  # type: ignore[arg-type]  # it asks the outermost wrapper first
            env.get_wrapper_attr("set_slots")(**slots)
        if last is None:  # it was lost before the first reset
            return None
        observation, self._reset_infos[i] = env.reset(seed=seed)
        info = env.get_wrapper_attr("lost_step")(last) if env.has_wrapper_attr("lost_step") else {}
        info |= {"TimeLimit.truncated": True, "terminal_observation": last, "lost": True}
        return observation, 0.0, True, info, self._reset_infos[i]

    def close(self) -> None:
        """Close all environments."""
        for env in self.envs:
            env.close()


_HOW: dict[str, Callable[[Any, Any], Any]] = {
    "get_spaces": lambda env, _: (env.observation_space, env.action_space),
    "env_method": lambda env, data: env.get_wrapper_attr(data[0])(*data[1], **data[2]),
    "get_attr": lambda env, name: env.get_wrapper_attr(name),
    "has_attr": lambda env, name: env.has_wrapper_attr(name),
    "set_attr": lambda env, data: setattr(env, *data),
    "is_wrapped": is_wrapped,
    "render": lambda env, _: env.render(),
}


class _Pipe:
    """Stands in for ``SubprocVecEnv``'s pipe to a worker. Messages wait until the first answer is requested."""

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
    """A ``SubprocVecEnv`` whose environments live in Ray actors on all machines of a cluster, several to an actor.

    It gives the same trajectories for the same seeds. A step is one message to each actor and adds about a millisecond,
    so the class is for slow environments. Every machine needs the same Python and packages.

    Training survives the loss of a machine or a process. The environments of its actors restart elsewhere, with new
    seeds and the present content of their slots (`OptionsWrapper.set_slots`). Episodes in flight end as truncated:
    reward 0, ``info["TimeLimit.truncated"]``, the last known observation as ``terminal_observation``, and
    ``info["lost"]``. Each loss gives one warning. Environments that are lost before the first reset restart without
    being counted.

    Args:
        env_fns: Functions that make one environment each.
        n_actors: Number of actors, at most one per environment; by default one per core of the cluster. Ray spreads
            them.
        step_timeout: Seconds that an actor may take for an answer before it counts as lost; None waits for ever. Ray
            itself notices a process that ended and, after a minute, a machine that hangs, but not a process that hangs.

    Attributes:
        lost_actors: Number of losses of an actor.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        ConnectionError: There is no cluster at the address in ``RAY_ADDRESS``.
        WorkerLostError: The same environments were lost repeatedly.
    """

    def __init__(self, env_fns: EnvFns, n_actors: int | None = None, *, step_timeout: float | None = 600.0) -> None:
        self._ray = connect()
        # Reserve no cores, so that environments always find another place. Recording every step for Ray's dashboard
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
        self._slots: list[dict[str, Any]] = [{} for _ in env_fns]  # by environment: arguments of `set_slots`
        self._first_seeds: list[int | None] = [None] * n_envs
        self._seen: list[Any] = [None] * n_envs  # the last observations
        self._losses_in_a_row = [0] * n_actors
        self._anew: dict[int, list[Any]] = {}  # by actor: answers to the next step of restarted environments
        self._outboxes: list[list[Message]] = [[] for _ in range(n_actors)]
        self.lost_actors = 0
        self.waiting = False
        self.closed = False
        self.processes = []
        self.remotes: Any = [_Pipe(self, a, i) for a, group in enumerate(self._groups) for i in range(len(group))]
        self._actors = [self._start(a) for a in range(n_actors)]
        self.step_timeout: float | None = None  # making an environment may take longer than a step
        for remote in self.remotes:
            remote.send(("get_spaces", None))
        spaces = [remote.recv() for remote in self.remotes]
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
        """Send the waiting messages. A lost actor restarts and gets them again, except a step."""
        outgoing = {a: messages for a, messages in enumerate(self._outboxes) if messages}
        self._outboxes = [[] for _ in self._actors]
        for remote in self.remotes:
            remote.inbox.clear()  # an error may have left answers there
        while outgoing:
            for a in [a for a, messages in outgoing.items() if messages[0][1] == "step" and a in self._anew]:
                self._deliver(a, outgoing.pop(a), self._anew.pop(a))
            until = None if self.step_timeout is None else time.monotonic() + self.step_timeout
            sent = {a: self._actors[a].answer.remote(messages) for a, messages in outgoing.items()}
            for a, reference in sent.items():
                try:
                    answers = self._get(reference, until)
                except self._gone as error:
                    self._start_anew(a, error)
                    continue
                if outgoing[a][0][1] in ("step", "reset"):
                    self._losses_in_a_row[a] = 0
                self._deliver(a, outgoing.pop(a), answers)

    def _deliver(self, actor: int, messages: Sequence[Message], answers: Sequence[Any]) -> None:
        """Pass answers to the pipes that wait for them, and note what restarted environments will need."""
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
        """Return the answers of an actor. An error in an environment is raised as that error."""
        limit = None if until is None else max(LEAST_WAIT, until - time.monotonic())
        try:
            answers: list[Any] = copy.deepcopy(self._ray.get(reference, timeout=limit))  # Ray's is read-only
        except self._ray.exceptions.RayTaskError as error:
            raise error.cause if isinstance(error.cause, Exception) else error from error
        return answers

    def _start_anew(self, actor: int, why: Exception) -> None:
        """Restart the environments of a lost actor elsewhere, and keep their answers to the lost step."""
        envs = self._groups[actor]
        which = f"Environments {envs} of {len(self._env_fns)}"
        reason = type(why).__name__
        seen = self._seen[envs[0]] is not None
        if seen:
            self.lost_actors += 1
            logger.warning(
                f"{which}: the machine or the process is gone ({reason}). They start anew elsewhere; their episodes "
                "end as truncated."
            )
        told = [(self._slots[env], self._later_seed(env), self._seen[env]) for env in envs]
        while self._losses_in_a_row[actor] < MOST_LOSSES:
            if self._losses_in_a_row[actor]:
                time.sleep(FIRST_WAIT * 2.0 ** (self._losses_in_a_row[actor] - 1))
            self._losses_in_a_row[actor] += 1
            self._kill(actor)
            self._actors[actor] = self._start(actor)
            with suppress(*self._gone):
                messages = [(i, "restart", data) for i, data in enumerate(told)]
                answers = self._get(self._actors[actor].answer.remote(messages))
                if seen:
                    self._anew[actor] = answers
                return
        raise WorkerLostError(
            f"{which}: lost {MOST_LOSSES + 1} times without a step between. {reason}",
            "If memory is short, train with fewer of them or more machines; `ray status` shows these.",
            killed=True,
        ) from why

    def _later_seed(self, env: int) -> int | None:
        """Return a seed that no environment has had, or None if none was seeded."""
        first = self._first_seeds[env]
        if first is None:
            return None
        return int(np.random.SeedSequence([first, self.lost_actors]).generate_state(1)[0])
