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
from sb3_options.execution.slots import SlotState
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
        self._env_fns = list(env_fns)
        self.envs: list[Any] = []  # made later: an error in one is not one of starting the process
        self._reset_infos: list[Any] = [{} for _ in env_fns]
        self._known: list[SlotState | None] = []

    def _make(self) -> None:
        if not self.envs:
            self.envs = [_patch_env(make()) for make in self._env_fns]
            self._known = [_slots_of(env) for env in self.envs]

    def answer(self, messages: Sequence[Message]) -> tuple[list[Any], dict[int, SlotState]]:
        """Answers to messages, and the slots that they have changed."""
        self._make()
        answers, changed = [], {}
        for i, command, data in messages:
            # They share nothing, and what Ray hands out cannot be written to.
            answers.append(self._answer(i, command, copy.deepcopy(data)))
            now = None if command in ("step", "reset") else _slots_of(self.envs[i])
            if now is not None and now is not self._known[i]:
                self._known[i] = changed[i] = now
        return answers, changed

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

    def begin(
        self,
        slots: Sequence[SlotState | None],
        seeds: Sequence[int | None],
        last: Sequence[Any] | None,
    ) -> list[Any]:
        """Take the place of environments that are lost, with their slots, and answer a step that is lost with them.

        ``last`` are their last known observations; None where they were not yet reset.
        """
        self._make()
        answers = []
        for i, (env, seed, state) in enumerate(zip(self.envs, seeds, copy.deepcopy(slots), strict=True)):
            if seed is not None:
                env.action_space.seed(seed)
            if state is not None and is_wrapped(env, Outermost):  # type: ignore[arg-type]  # it is asked of each
                env.get_wrapper_attr("set_slots")(**vars(state))
            self._known[i] = _slots_of(env)
            if last is not None:
                observation, self._reset_infos[i] = env.reset(seed=seed)
                info = env.get_wrapper_attr("lost_step")(last[i]) if env.has_wrapper_attr("lost_step") else {}
                info |= {"TimeLimit.truncated": True, "terminal_observation": last[i], "lost": True}
                answers.append((observation, 0.0, True, info, self._reset_infos[i]))
        return answers

    def close(self) -> None:
        """Close all of them."""
        for env in self.envs:
            env.close()


def _slots_of(env: Any) -> SlotState | None:
    return env.get_wrapper_attr("slot_state") if env.has_wrapper_attr("slot_state") else None


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
    seeds of their own and what their slots held (`SlotState`). The episodes that were in flight end as truncated:
    reward 0, ``info["TimeLimit.truncated"]``, the last observation that is known as ``terminal_observation``, and
    ``info["lost"]``. There is one warning a loss. What is lost before the first reset starts anew and is not counted.

    Args:
        env_fns: Each makes an environment.
        n_actors: Actors, at most one an environment; by default one a core of the cluster. Ray spreads them.
        address: As `connect` takes it.
        num_cpus: Cores that an actor reserves; by default none, so that environments always find another place.
        step_timeout: Seconds that an actor may take for an answer before it is lost; None waits for ever. Ray itself
            notices a process that ended, and after a minute a machine that hangs, but no process that hangs.

    Attributes:
        lost_actors: How often an actor was lost.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        ConnectionError: There is no cluster at ``address``.
        WorkerLostError: The same environments were lost time and again.
    """

    def __init__(
        self,
        env_fns: EnvFns,
        n_actors: int | None = None,
        *,
        address: str | None = None,
        num_cpus: float | None = None,
        step_timeout: float | None = 600.0,
    ) -> None:
        self.step_timeout: float | None = None
        self._ray = connect(address)
        # To note every step for Ray's dashboard takes a sixth of the time of a call.
        self._class = self._ray.remote(HostedEnvironments).options(
            num_cpus=num_cpus or 0.0, scheduling_strategy="SPREAD", enable_task_events=False
        )
        n_envs = len(env_fns)
        n_actors = min(n_envs, n_actors or max(1, int(self._ray.cluster_resources().get("CPU", 1))))
        self._groups = [group.tolist() for group in np.array_split(np.arange(n_envs), n_actors)]
        self._env_fns = list(env_fns)
        self._slots: list[SlotState | None] = [None] * n_envs
        self._first_seeds: list[int | None] = [None] * n_envs
        self._seen: list[Any] = [None] * n_envs
        self._losses_in_a_row = [0] * n_actors
        self._anew: dict[int, list[Any]] = {}
        self._outboxes: list[list[Message]] = [[] for _ in range(n_actors)]
        self.lost_actors = 0
        self.waiting = False
        self.closed = False
        self.processes = []
        self.remotes: Any = [_Pipe(self, a, i) for a, group in enumerate(self._groups) for i in range(len(group))]
        self._actors = [self._start(a) for a in range(n_actors)]
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
            for actor in self._actors:
                with suppress(self._ray.exceptions.RayError):
                    self._ray.kill(actor)

    def _exchange(self) -> None:
        """Send the messages that wait. An actor that is lost starts anew and gets them again, but not a step."""
        outgoing = {a: messages for a, messages in enumerate(self._outboxes) if messages}
        self._outboxes = [[] for _ in self._actors]
        for remote in self.remotes:
            remote.inbox.clear()  # an error may have left something
        while outgoing:
            for a, messages in list(outgoing.items()):
                if messages[0][1] == "reset":
                    self._anew.pop(a, None)
                    for i, _, (seed, _) in messages:
                        if seed is not None:
                            self._first_seeds[self._groups[a][i]] = seed
                elif messages[0][1] == "step" and a in self._anew:
                    self._deliver(a, outgoing.pop(a), self._anew.pop(a))
            sent = {a: self._actors[a].answer.remote(messages) for a, messages in outgoing.items()}
            done, lost = self._collect(sent, self._deadline())
            for a, (answers, slots) in done.items():
                if outgoing[a][0][1] in ("step", "reset"):
                    self._losses_in_a_row[a] = 0
                for i, state in slots.items():
                    self._slots[self._groups[a][i]] = state
                self._deliver(a, outgoing.pop(a), answers)
            for a, error in lost.items():
                self._start_anew(a, error)

    def _deliver(self, actor: int, messages: Sequence[Message], answers: Sequence[Any]) -> None:
        # What Ray hands out cannot be written to.
        for (i, command, _), answer in zip(messages, copy.deepcopy(answers), strict=True):
            env = self._groups[actor][i]
            if command in ("step", "reset"):
                self._seen[env] = answer[0]
            self.remotes[env].inbox.append(answer)

    def _collect(self, references: dict[int, Any], until: float | None) -> tuple[dict[int, Any], dict[int, Exception]]:
        """What actors answer, and why those that are lost do not."""
        results: dict[int, Any] = {}
        lost: dict[int, Exception] = {}
        for a, reference in references.items():
            try:
                results[a] = self._get(reference, until)
            except self._lost_errors() as error:
                lost[a] = error
        return results, lost

    def _deadline(self) -> float | None:
        """When an actor that is asked now counts as lost."""
        return None if self.step_timeout is None else time.monotonic() + self.step_timeout

    def _get(self, references: Any, until: float | None = None) -> Any:
        """``ray.get``, where an error in an environment is that error."""
        limit = None if until is None else max(LEAST_WAIT, until - time.monotonic())
        try:
            return self._ray.get(references, timeout=limit)
        except self._ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, Exception) and not isinstance(error.cause, self._ray.exceptions.RayError):
                raise error.cause from error
            raise

    def _lost_errors(self) -> tuple[type[Exception], ...]:
        of = self._ray.exceptions
        gone = of.RayActorError, of.NodeDiedError, of.WorkerCrashedError, of.ObjectLostError, of.OutOfMemoryError
        return (*gone, of.GetTimeoutError)

    def _start_anew(self, actor: int, why: Exception) -> None:
        """Start the environments of a lost actor elsewhere, with what was set in them."""
        group = self._groups[actor]
        named = f"{group[0]} to {group[-1]}" if len(group) > 1 else f"{group[0]}"
        which = f"Environment{'s' if len(group) > 1 else ''} {named} of {len(self._env_fns)}"
        if self._seen[group[0]] is not None:
            self.lost_actors += 1
            logger.warning(
                "%s: the machine or the process is gone (%s). They start anew elsewhere; their episodes end as "
                "truncated.",
                which,
                type(why).__name__,
            )
        while True:
            self._losses_in_a_row[actor] += 1
            losses = self._losses_in_a_row[actor]
            if losses > MOST_LOSSES:
                raise WorkerLostError(
                    f"{which}: lost {losses} times without a step between. {type(why).__name__}",
                    "If memory is short, train with fewer of them or more machines; `ray status` shows these.",
                    killed=True,
                ) from why
            if losses > 1:
                time.sleep(FIRST_WAIT * 2.0 ** (losses - 2))
            with suppress(self._ray.exceptions.RayError):
                self._ray.kill(self._actors[actor])
            self._actors[actor] = self._start(actor)
            try:
                self._begin(actor)
            except self._lost_errors() as error:
                why = error
            else:
                return

    def _begin(self, actor: int) -> None:
        group = self._groups[actor]
        slots = [self._slots[i] for i in group]
        last = None if self._seen[group[0]] is None else [self._seen[i] for i in group]
        answers = self._get(self._actors[actor].begin.remote(slots, [self._later_seed(i) for i in group], last))
        if answers:
            self._anew[actor] = answers

    def _later_seed(self, env: int) -> int | None:
        """A seed that no environment has had; None where none was seeded."""
        first = self._first_seeds[env]
        if first is None:
            return None
        return int(np.random.SeedSequence([first, self.lost_actors]).generate_state(1)[0])
