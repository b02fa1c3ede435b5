"""`RayVecEnv`: environments on many machines, which survive the loss of one."""

from __future__ import annotations

import copy
import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_options.execution.hosted import HostedEnvironments, Infos, Steps
from sb3_options.execution.ray_cluster import connect
from sb3_options.execution.slots import SlotState
from sb3_options.execution.workers import PATIENCE, WorkerLostError
from sb3_options.experience.observations import concatenate, copy_of, one_of

logger = logging.getLogger("sb3_options")

EnvFns: TypeAlias = Sequence[Callable[[], gym.Env[Any, Any]]]

MOST_LOSSES = 8
"""Losses of the same environments, with no step between them, after which the fault is theirs."""

FIRST_WAIT = 0.25
"""Seconds before a second start: the cluster may not have noticed yet which machine is gone. Doubles each time."""

LEAST_WAIT = 1.0
"""Seconds in which an answer that is there can be fetched, though another one has used up the time."""


class RayVecEnv(VecEnv):
    """A ``VecEnv`` whose environments live in Ray actors, several to an actor, on all machines of a cluster.

    It behaves as ``SubprocVecEnv``, and gives the same trajectories for the same seeds. Actions go out and results come
    back as one array an actor, with one ``ray.get`` a step. So it is for environments that cost: a step takes a
    millisecond more than theirs.

    The loss of a machine, or of a process, ends no training. The environments of its actors start anew elsewhere, with
    what their slots held (`SlotState`) and the attributes that ``set_attr`` has set. The episodes that were in flight
    end as truncated: reward 0, ``info["TimeLimit.truncated"]``, the last observation that is known as
    ``terminal_observation``, and ``info["lost"]``. There is one warning a loss; `lost_actors` counts them, and
    callbacks of this library log it as ``time/lost_actors``. The new environments draw from seeds of their own. What is
    lost before the first reset starts anew and is not counted.

    Ray notices that a process or a machine has ended, and after a minute that a machine hangs. It never notices that a
    single process hangs; ``step_timeout`` does.

    Every machine needs the same Python, the same packages, and the files that the environments read.

    Args:
        env_fns: Each makes an environment.
        n_actors: Actors, at most one an environment; by default one a core of the cluster. Ray spreads them.
        address: As `connect` takes it.
        num_cpus: Cores that an actor reserves. By default it reserves none, so that the environments of a lost machine
            always find a place.
        step_timeout: Seconds that an actor may take for a step, a reset or another call, of all its environments.
            Whoever takes longer hangs, and is lost. None waits for ever. To start an actor may take any time.

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
        self.step_timeout = step_timeout
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
        self._attributes: list[dict[str, Any]] = [{} for _ in env_fns]
        self._first_seeds: list[int | None] = [None] * n_envs
        self._losses_in_a_row = [0] * n_actors
        self.lost_actors = 0
        self.closed = False
        self._seen: Any = None
        self._anew: dict[int, tuple[Any, Infos, Infos]] = {}
        self._steps: list[Any] = []
        self._actors = [self._start(a) for a in range(n_actors)]
        (observation_space, action_space), *_ = self._gather(
            dict.fromkeys(range(n_actors), ("make", ())), started=False
        )
        super().__init__(n_envs, observation_space, action_space)

    def _start(self, actor: int) -> Any:
        return self._class.remote([self._env_fns[i] for i in self._groups[actor]])

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Send an action to every environment; one that started anew since the last step gets none."""
        self._steps = [
            None if a in self._anew else self._actors[a].step.remote(actions[group[0] : group[-1] + 1])
            for a, group in enumerate(self._groups)
        ]

    def step_wait(self) -> VecEnvStepReturn:
        """What the step returned."""
        steps, self._steps = self._steps, []
        sent = [a for a, step in enumerate(steps) if step is not None]
        results, lost = self._collect({a: steps[a] for a in sent}, self._deadline())
        for a, error in lost.items():
            self._start_anew(a, error)
        for a in results:
            self._losses_in_a_row[a] = 0
        parts = [results[a] if a in results else self._cut_off(a) for a in range(len(self._actors))]
        self._seen = concatenate([part.observations for part in parts])
        self.reset_infos = [copy.deepcopy(info) for part in parts for info in part.reset_infos]
        rewards = np.stack([reward for part in parts for reward in part.rewards])
        dones = np.stack([done for part in parts for done in part.dones])
        return self._seen, rewards, dones, [copy.deepcopy(info) for part in parts for info in part.infos]

    def reset(self) -> VecEnvObs:
        """Reset all environments."""
        for i, seed in enumerate(self._seeds):
            self._first_seeds[i] = self._first_seeds[i] if seed is None else seed
        results = self._gather(
            {
                a: ("reset", ([self._seeds[i] for i in group], [self._options[i] for i in group]))
                for a, group in enumerate(self._groups)
            }
        )
        self._anew.clear()
        self._losses_in_a_row = [0] * len(self._actors)
        self._seen = concatenate([observations for observations, _ in results])
        self.reset_infos = [copy.deepcopy(info) for _, infos in results for info in infos]
        self._reset_seeds()
        self._reset_options()
        return self._seen  # type: ignore[no-any-return]  # a batch

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

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """A picture of each environment."""
        return self._call("render", None)

    def has_attr(self, attr_name: str) -> bool:
        """Whether every environment has an attribute."""
        return all(self._call("has_attr", None, attr_name))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Copies of an attribute of some environments."""
        return self._call("get_attr", indices, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of some environments."""
        self._call("set_attr", indices, attr_name, value)
        for i in self._get_indices(indices):
            self._attributes[i][attr_name] = value

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """What a method of some environments returns."""
        return self._call("env_method", indices, method_name, *args, **kwargs)

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Whether some environments are in a wrapper."""
        return self._call("is_wrapped", indices, wrapper_class)

    def _call(self, kind: str, indices: VecEnvIndices, *args: Any, **kwargs: Any) -> list[Any]:
        """What some environments answer, in the order of ``indices``."""
        asked = list(self._get_indices(indices))
        by_actor = {a: mine for a, group in enumerate(self._groups) if (mine := [i for i in group if i in asked])}
        calls: dict[int, tuple[str, tuple[Any, ...]]] = {
            a: ("call", (kind, [i - self._groups[a][0] for i in mine], args, kwargs)) for a, mine in by_actor.items()
        }
        answers: dict[int, Any] = {}
        for (a, mine), (results, slots) in zip(by_actor.items(), self._gather(calls), strict=True):
            answers |= dict(zip(mine, copy.deepcopy(results), strict=True))  # what Ray hands out cannot be written to
            for i, state in slots.items():
                self._slots[self._groups[a][0] + i] = state
        return [answers[i] for i in asked]

    def _gather(self, calls: dict[int, tuple[str, tuple[Any, ...]]], *, started: bool = True) -> list[Any]:
        """Results of methods of actors; one that is lost starts anew and is called again."""
        results: dict[int, Any] = {}
        until = self._deadline() if started else None
        pending = calls
        while pending:
            sent = {a: getattr(self._actors[a], method).remote(*args) for a, (method, args) in pending.items()}
            done, lost = self._collect(sent, until)
            results |= done
            for a, error in lost.items():
                self._start_anew(a, error)
            pending = {a: pending[a] for a in lost}
            until = self._deadline()
        return [results[a] for a in calls]

    def _collect(self, references: dict[int, Any], until: float | None) -> tuple[dict[int, Any], dict[int, Exception]]:
        """What actors answer, and why those that are lost do not."""
        with suppress(*self._lost_errors()):
            return dict(zip(references, self._get(list(references.values()), until), strict=True)), {}
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
        if self._seen is not None:
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
        group, anew = self._groups[actor], self._actors[actor]
        seeds = [self._later_seed(i) for i in group]
        self._get(anew.begin.remote([(self._slots[i], self._attributes[i]) for i in group], seeds))
        if self._seen is not None:
            observations, reset_infos = self._get(anew.reset.remote(seeds, [{}] * len(group)))
            last = [copy_of(one_of(self._seen, i)) for i in group]
            self._anew[actor] = observations, reset_infos, self._get(anew.lost_infos.remote(last))

    def _later_seed(self, env: int) -> int | None:
        """A seed that no environment has had; None where none was seeded."""
        first = self._first_seeds[env]
        if first is None:
            return None
        return int(np.random.SeedSequence([first, self.lost_actors]).generate_state(1)[0])

    def _cut_off(self, actor: int) -> Steps:
        """What a step is said to have returned of environments that were lost."""
        observations, reset_infos, infos = self._anew.pop(actor)
        group = self._groups[actor]
        told = [
            {**info, "TimeLimit.truncated": True, "terminal_observation": copy_of(one_of(self._seen, i)), "lost": True}
            for i, info in zip(group, infos, strict=True)
        ]
        return Steps(observations, [0.0] * len(group), [True] * len(group), told, reset_infos)
