"""`OptionsVecEnv`: options in a vectorised environment that cannot step one of its environments alone."""

import os
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from stable_baselines3.common import vec_env

from sb3_options.embedding.settings import MapName
from sb3_options.execution.above import Outermost
from sb3_options.execution.option_step import RunUnderWay, advance_all, choose_all
from sb3_options.execution.recording import recorder_for, refuse_own
from sb3_options.execution.slots import WithSlots
from sb3_options.execution.wrapper import TERMINATION_SEED, OptionsWrapper
from sb3_options.experience.observations import (
    BoolArray,
    FeatureMap,
    IntArray,
    Observations,
    keys_of,
    replaced,
    singles,
    stack,
    take,
)
from sb3_options.experience.option_run import OptionRun, RunInfo, Termination
from sb3_options.experience.recording import TrajectoryRecorder
from sb3_options.experience.success import success_in
from sb3_options.experience.trajectories import Trajectory

Infos: TypeAlias = list[dict[str, Any]]

# What callbacks and algorithms ask of each environment, and what they call there.
ATTRIBUTES = ("above", "bank", "slot_state", "traits")
METHODS = ("action_masks", "available", "concept_features", "random_trajectories", "set_slots")


class OptionsVecEnv(WithSlots, vec_env.VecEnvWrapper):
    """Adds ``max_options`` option slots to the actions of any ``VecEnv``, whose environments all step at once.

    It is `OptionsWrapper` for environments that are no Gymnasium environments, such as those of EnvPool or JAX. φ,
    initiation sets, policies and terminations are computed for all environments in one call each.

    While an option runs, its environment waits: each ``step_wait`` takes one primitive step everywhere and returns, for
    a waiting environment, the observation in which the option was chosen, a reward of 0 and a duration of 0. Its mask
    allows that option alone, and its action is ignored. The step that ends the option returns the same as
    `OptionsWrapper.step`; its ``info["option"]`` also holds the ``chosen`` action.
    Replay and rollout buffers leave waiting rows out, so that algorithms learn from the same decisions. PPO, A2C and
    TRPO learn from an option in the rollout in which it ends. ``num_timesteps`` counts its steps then.

    Options must be functions of the observation alone, because all environments share them. A ``VecMonitor`` belongs
    beneath. Where the environment masks actions of its own, use `OptionsWrapper`.

    Args:
        venv: Its action space must be ``Discrete`` and start at 0. At an episode's end ``infos`` hold
            ``terminal_observation`` and, where time ran out, ``TimeLimit.truncated``, as SB3 demands.
        max_options: Number of slots, at least 0.
        gamma: Discount γ per primitive step, in (0, 1]; must equal the algorithm's.
        feature_map: As for `OptionsWrapper`; by default ``venv.concept_features``, if there is one.
        options_file: As for `OptionsWrapper`.
        max_runs: As for `OptionsWrapper`.

    Raises:
        TypeError: The actions are not ``Discrete`` from 0 on, or ``feature_map`` cannot be called.
        ValueError: An argument is out of its range, the file's options do not fit the environment, or ``venv`` is in a
            ``VecNormalize``, ``VecFrameStack`` or ``VecTransposeImage``.
        FileNotFoundError: There is no ``options_file``.
    """

    above: tuple[str, ...] = ()  # wrappers above each environment that may change its steps: there can be none

    def __init__(
        self,
        venv: vec_env.VecEnv,
        max_options: int = 4,
        *,
        gamma: float = 0.99,
        feature_map: FeatureMap | MapName | None = None,
        options_file: str | os.PathLike[str] | None = None,
        max_runs: int | None = None,
    ) -> None:
        for changes in (vec_env.VecFrameStack, vec_env.VecNormalize, vec_env.VecTransposeImage):
            if vec_env.is_vecenv_wrapped(venv, changes):
                raise ValueError(
                    f"{changes.__name__} beneath OptionsVecEnv would be undone where options act: put "
                    "VecNormalize and VecTransposeImage above, and stack frames in the environment itself."
                )
        own_map = getattr(venv, "concept_features", None)
        actions = self._make_slots(venv, own_map, max_options, gamma, feature_map, options_file, max_runs)
        self._n_actions = self.n_primitive + max_options
        self._possible = frozenset(range(self._n_actions))
        vec_env.VecEnvWrapper.__init__(self, venv, action_space=actions)
        self._observations: Any = None  # of the environments
        self._shown: Any = None  # the same, but of a waiting one the observation in which its option was chosen
        self._running: dict[int, RunUnderWay] = {}  # by environment
        self._closed: set[int] = set()  # environments whose option was taken out of its slot while it runs
        self._runs = np.zeros((self.num_envs, max_options), dtype=np.int64)
        self._actions = np.zeros(self.num_envs, dtype=np.int64)  # primitive ones, of the present step
        self._instead: BoolArray = np.zeros(self.num_envs, dtype=bool)  # whether they run in the place of a slot
        self._recorders: list[TrajectoryRecorder] = []
        self._waits = OptionRun(-1, 0, 1.0, self.gamma, "running").as_info()
        self._reseed(None)

    def set_slots(self, **changes: Any) -> None:
        """Replace fields of the `SlotState` of all environments; ``options`` are added to those that it names.

        A running option continues to its end. If its slot was emptied, nothing is learned from it.
        """
        before = self.slot_state
        self._change_slots(changes)
        now = self.slot_state
        emptied = [slot for slot, option in changes.get("options", {}).items() if option is None]
        self._runs[:, emptied] = 0
        self._closed |= {env for env, run in self._running.items() if run.slot in emptied}
        if (now.record, now.max_segment) != (before.record, before.max_segment):
            self._recorders = [recorder_for(now.max_segment) for _ in range(self.num_envs if now.record else 0)]
            if self._observations is not None:
                self._begin_recording(range(self.num_envs))

    def action_masks(self) -> BoolArray:
        """Which actions may be chosen now, (n_envs, n_primitive + max_options); where an option runs, it alone."""
        masks = np.ones((self.num_envs, self._n_actions), dtype=bool)
        masks[:, self.n_primitive :] = self._available_slots(self._observations)
        if self._running:
            envs, slots = list(self._running), [run.slot for run in self._running.values()]
            masks[envs] = False
            masks[envs, self.n_primitive + np.array(slots)] = True
        return masks

    def _available_slots(self, observations: Observations) -> BoolArray:
        """Which slots may start and have not run ``max_runs`` times, (n_envs, max_options)."""
        available = self.bank.available_slots(observations)
        return available if self.max_runs is None else available & (self._runs < self.max_runs)

    def reset(self) -> Any:
        """Begin an episode in every environment; no option runs."""
        self._observations = self._shown = self.venv.reset()
        self._measure_features(take(self._observations, 0))
        self._running.clear()
        self._closed.clear()
        self._runs[:] = 0
        self._begin_recording(range(self.num_envs))
        return self._shown

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the environments, and whether options with 0 < β < 1 end."""
        seeds = self.venv.seed(seed)
        self._reseed(seed)
        return seeds

    def _reseed(self, seed: int | None) -> None:
        seeds = [[] if seed is None else [seed + env] for env in range(self.num_envs)]
        self._random = [np.random.default_rng([*each, TERMINATION_SEED]) for each in seeds]

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Begin one primitive step everywhere: a chosen one, or that of an option which begins or goes on."""
        actions = np.asarray(actions, dtype=np.int64).reshape(self.num_envs)
        if not set(actions.tolist()) <= self._possible:
            raise ValueError(f"actions must be between 0 and {self._n_actions - 1}, got {actions}.")
        slots = actions - self.n_primitive
        slots[list(self._running)] = -1
        self._instead = slots >= 0
        if self._instead.any():
            chosen = set(slots[self._instead].tolist())
            for slot in filter(chosen.__contains__, self.bank.filled):
                self._begin(slot, np.flatnonzero(slots == slot))
            actions = np.where(self._instead, slots % self.n_primitive, actions)
        self._actions = actions.copy()
        if self._running:
            self._actions[list(self._running)] = choose_all(self.bank, self._running.values())
        self.venv.step_async(self._actions)

    def _begin(self, slot: int, envs: IntArray) -> None:
        option = self.bank[slot]
        if self.max_runs is not None:
            envs = envs[self._runs[envs, slot] < self.max_runs]
        if option is None or not len(envs):
            return
        self._instead[envs] = False
        observations = take(self._observations, envs)
        if self.bank.looks_up(slot, option, len(envs)):
            initiation = [self.bank.may_start(slot, observation) for observation in singles(observations)]
        else:
            initiation = option.initiation(observations).tolist()
        self._runs[envs, slot] += initiation
        for env, observation, inside in zip(envs.tolist(), singles(observations), initiation, strict=True):
            run = RunUnderWay(slot, option, observation, self.gamma, self._random[env], inside=inside)
            self._running[env] = run

    def step_wait(self) -> Any:
        """Observations, rewards, whether episodes ended, and infos, as the class describes."""
        observations: Any
        observations, given, dones, infos = self.venv.step_wait()
        # Copies, because an environment may hand out one and the same dictionary every time.
        reserved = ("option", "trajectory", "segments") if self._recorders else ("option",)
        for info in filter(None, infos):
            refuse_own(info, *reserved)
        infos = [{**info, "option": self._primitive} for info in infos]
        ended: list[int] = np.flatnonzero(dones).tolist()
        led = observations
        if ended:
            led = replaced(observations, ended, stack([infos[env]["terminal_observation"] for env in ended]))
        self._record(given, led, dones, infos)
        self._observations = observations
        rewards = np.array(given, dtype=np.result_type(np.asarray(given), np.float32))  # sums of whole ones are none
        self._go_on(given, led, dones, infos)
        for env, run in self._running.items():
            rewards[env] = 0.0 if run.termination is None else run.total
        self._report(led, infos)
        for env in [env for env, run in self._running.items() if run.termination is not None]:
            del self._running[env]
            self._closed.discard(env)
        waiting = list(self._running)
        self._shown = replaced(observations, waiting, take(self._shown, waiting)) if waiting else observations
        if ended:
            self._runs[ended] = 0
            self._begin_recording(ended)
        return self._shown, rewards, dones, infos

    def _go_on(self, rewards: npt.NDArray[Any], led: Observations, dones: npt.NDArray[Any], infos: Infos) -> None:
        """Add the present step to the options that run."""
        if self._running:
            envs = list(self._running)
            ended = [_end_of_episode(infos[env]) if done else None for env, done in zip(envs, dones[envs], strict=True)]
            advance_all(
                self.bank, list(self._running.values()), rewards[envs].tolist(), singles(take(led, envs)), ended
            )

    def _report(self, led: Observations, infos: Infos) -> None:
        """Put what ran into ``info["option"]``, where it was no chosen primitive."""
        for env in np.flatnonzero(self._instead).tolist() if self._instead.any() else ():
            infos[env]["option"] = RunInfo(self._primitive, actions=self._actions[env : env + 1].copy())
        reports = self.slot_state.report_availability and bool(self.bank.filled)
        arrived = self._available_slots(led) if reports else None
        for row, info in zip(arrived if arrived is not None else (), infos, strict=False):
            info["option"] = RunInfo(info["option"], available=row[None])
        for env, run in self._running.items():
            last = None if arrived is None else arrived[env]
            infos[env]["option"] = self._waits if run.termination is None else self._ended(env, run, last)

    def _ended(self, env: int, run: RunUnderWay, last: BoolArray | None) -> RunInfo:
        """The info of a run that ended, with the slots available in the ``last`` observation."""
        available = None
        if last is not None:
            available = self.bank.available_slots(stack(run.observations[1:]))
            available[-1] = last
        ended = run.ended(available)
        if env in self._closed:  # no one may learn of it, nor of the slot's next option by it
            return OptionRun(-1, ended.duration, ended.discount, ended.gamma, "running").as_info()
        return ended._replace(chosen=self.n_primitive + run.slot).as_info()

    def _record(self, rewards: npt.NDArray[Any], led: Observations, dones: npt.NDArray[Any], infos: Infos) -> None:
        if not self._recorders:
            return
        steps = zip(self._actions.tolist(), rewards.tolist(), singles(led), keys_of(led), strict=True)
        for recorder, step, done, info in zip(self._recorders, steps, dones.tolist(), infos, strict=True):
            recorder.record(*step)
            if done:
                truncated = _end_of_episode(info) == "truncated"
                recorder.end(terminated=not truncated, truncated=truncated, is_success=success_in(info))
            if recorder.finished:
                info.update(recorder.report())
                recorder.finished.clear()

    def _begin_recording(self, envs: Iterable[int]) -> None:
        for env in envs if self._recorders else ():
            self._recorders[env].begin(take(self._observations, env))

    def random_trajectories(self, episodes: int, max_steps: int, seed: int) -> list[Trajectory]:
        """Return episodes of random primitive actions, truncated after ``max_steps``; reset afterwards.

        All environments provide equally many: the first to end would be short.
        """
        before = self.slot_state
        self.seed(seed)
        self.set_slots(record=True, max_segment=None)
        random = np.random.default_rng(seed)
        trajectories: list[Trajectory] = []
        while len(trajectories) < episodes:
            self.reset()
            first: dict[int, Trajectory] = {}
            steps = 0
            while len(first) < self.num_envs and steps < max_steps:
                steps += 1
                *_, infos = self.step(random.integers(self.n_primitive, size=self.num_envs))
                first = {env: info["trajectory"] for env, info in enumerate(infos) if "trajectory" in info} | first
            for env in set(range(self.num_envs)) - set(first):
                self._recorders[env].end(terminated=False, truncated=True, is_success=None)
                first[env] = self._recorders[env].finished[0]
            trajectories += [first[env] for env in range(self.num_envs)]
        self.set_slots(record=before.record, max_segment=before.max_segment)
        return trajectories[:episodes]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Whether each environment is in a wrapper; in `OptionsWrapper` all are, as far as anybody need know."""
        if wrapper_class in (OptionsWrapper, Outermost):
            return [True] * len(list(self._get_indices(indices)))
        return self.venv.env_is_wrapped(wrapper_class, indices)

    def has_attr(self, attr_name: str) -> bool:
        """Whether each environment has an attribute or method."""
        return attr_name in (*ATTRIBUTES, *METHODS) or self.venv.has_attr(attr_name)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of each environment."""
        if attr_name in ATTRIBUTES:
            return [getattr(self, attr_name) for _ in self._get_indices(indices)]
        return self.venv.get_attr(attr_name, indices)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method in each environment; those of options are called once for all of them."""
        if method_name not in METHODS:
            return self.venv.env_method(method_name, *method_args, indices=indices, **method_kwargs)
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        envs = self._get_indices(indices)
        return [result[env] for env in envs] if method_name == "action_masks" else [result for _ in envs]


def _end_of_episode(info: dict[str, Any]) -> Termination:
    return "truncated" if info.get("TimeLimit.truncated") else "terminated"
