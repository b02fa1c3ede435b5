"""`OptionsWrapper`: an environment whose actions are primitives and options."""

import logging
import os
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.monitor import Monitor

from sb3_options.embedding.settings import MapName
from sb3_options.execution.above import count_primitive_steps, names_of_changing
from sb3_options.execution.finite import check_finite
from sb3_options.execution.option_step import RunUnderWay, StepReturn
from sb3_options.execution.recording import RecordTrajectories, refuse_own
from sb3_options.execution.slots import WithSlots
from sb3_options.experience.observations import BoolArray, FeatureMap
from sb3_options.experience.option_run import RunInfo, Termination
from sb3_options.experience.recording import TrajectoryRecorder
from sb3_options.experience.success import success_in
from sb3_options.experience.trajectories import Trajectory
from sb3_options.options.option import Option

logger = logging.getLogger("sb3_options")

TERMINATION_SEED = 0x0971055  # mixed into the seed of ``reset``: β draws from another stream than the environment


class OptionsWrapper(WithSlots, gym.Wrapper[Any, int, Any, int], RecordConstructorArgs):
    """Adds ``max_options`` option slots to the actions of an environment with discrete actions.

    ``step(a)`` runs a primitive once, or an option to its end. It returns the last observation, the discounted sum Σ γⁱ
    rᵢ over the k primitive steps taken, the last flags and the last inner info. To this info it adds a record of the
    run, a dict of the fields of `OptionRun`::

        info["option"] = {"index": slot or -1, "duration": k, "discount": γᵏ, "gamma": γ, "termination": why it ended}

    An option's record also holds its primitive steps, which Macro-Q learning needs.

    An empty slot i runs primitive i mod n_primitive, and names it as ``actions``. An option that is chosen outside its
    initiation set runs one step of its own policy. So an algorithm that cannot mask still faces a semi-Markov decision
    process. ``action_masks()`` gives the initiation sets to an algorithm that can. Without options the wrapper behaves
    as the environment itself, bit for bit.

    If the environment has its own ``action_masks()``, slots respect it. An option ends if its next primitive is masked,
    and may not start if its first one is. If it is chosen nevertheless, slot i acts like an empty slot: it runs the
    first legal primitive from i mod n_primitive on.

    Args:
        env: Its action space must be ``Discrete`` and start at 0.
        max_options: Number of slots, at least 0.
        gamma: Discount γ per primitive step, in (0, 1]; must equal the algorithm's.
        feature_map: φ from a batch of observations to concept space, shape (batch, d). By default the environment's own
            ``concept_features``; else a one-hot code for ``Discrete`` observations and the flat observation for
            ``Box``. A ``Dict`` space has no default. `SubgoalDiscoveryCallback` learns ``"temporal-distance"`` while
            the model trains, also from images.
        options_file: Start with the options of this file: one written by `OptionBank.save`, or a ``model.zip``.
        max_runs: Maximum number of runs of one option in an episode, at least 1, after which its slot counts as empty
            until the next episode; None for no limit. Without a limit an option whose subgoal is a dead end leads an
            untrained agent there again and again. For algorithms that mask.
        check_finite: Whether to refuse observations and rewards that are NaN, infinite, or too large for single
            precision.

    Raises:
        TypeError: ``env`` is not a ``gymnasium.Env``, its actions are not ``Discrete`` from 0 on, or ``feature_map``
            cannot be called.
        ValueError: An argument is out of its range, or the file's options do not fit the environment.
        FileNotFoundError: There is no ``options_file``.
    """

    STATE = ("_observation", "_random", "_runs", "_warned")  # whoever installed the options restores them

    def __init__(
        self,
        env: gym.Env[Any, Any],
        max_options: int = 4,
        *,
        gamma: float = 0.99,
        feature_map: FeatureMap | MapName | None = None,
        options_file: str | os.PathLike[str] | None = None,
        max_runs: int | None = None,
        check_finite: bool = False,
    ) -> None:
        if not isinstance(env, gym.Env):
            raise TypeError(
                f"{type(env).__name__} is no gymnasium.Env. Convert an environment of the old gym, for instance by "
                "shimmy.GymV21CompatibilityV0(env=env)."
            )
        # Not copied: a feature map may be a method of the environment, which would be copied too.
        RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,
            max_options=max_options,
            gamma=gamma,
            feature_map=feature_map,
            options_file=options_file,
            max_runs=max_runs,
            check_finite=check_finite,
        )
        gym.Wrapper.__init__(self, env)
        self.check_finite = check_finite
        own_map = env.get_wrapper_attr("concept_features") if env.has_wrapper_attr("concept_features") else None
        self.action_space: Any = self._make_slots(env, own_map, max_options, gamma, feature_map, options_file, max_runs)
        self.outermost: gym.Env[Any, Any] = self
        self._has_masks = env.has_wrapper_attr("action_masks")
        self._all_primitives = np.ones(self.n_primitive, dtype=bool)
        self._observation: Any = None
        self._random = np.random.default_rng(TERMINATION_SEED)  # until a reset is given a seed
        self._runs = np.zeros(max_options, dtype=np.int64)
        self._recording: RecordTrajectories | None = None
        self._warned = False
        self._running: int | None = None

    @property
    def above(self) -> tuple[str, ...]:
        """Classes of the wrappers above this one that may change steps, for `above.changing_steps`."""
        return names_of_changing(self.outermost, self)

    def set_slots(self, **changes: Any) -> None:
        """Replace fields of this environment's `SlotState`; new ``options`` are added to its present ones."""
        self._change_slots(changes)
        for slot, option in changes.get("options", {}).items():
            if option is None:
                self._runs[slot] = 0  # the next option starts at 0; a relearned one keeps its count
        if "record" in changes:
            self._record()
        if self.slot_state.primitive_monitor:
            count_primitive_steps(self.outermost, self)

    def set_option(self, slot: int, option: Option | None) -> None:
        """Fill a slot, or empty it with None, as ``set_slots(options={slot: option})`` does."""
        self.set_slots(options={slot: option})

    def _record(self) -> None:
        if self.slot_state.record and self._recording is None:
            # Beneath a Monitor, which other code expects right beneath this wrapper.
            outer: gym.Wrapper[Any, Any, Any, Any] = self.env if isinstance(self.env, Monitor) else self
            self._recording = RecordTrajectories(outer.env)
            outer.env = self._recording
        if self._recording is not None:
            self._recording.set(self.slot_state.record, self.slot_state.max_segment, self._observation)

    def random_trajectories(self, episodes: int, max_steps: int, seed: int) -> list[Trajectory]:
        """Return episodes of random primitive actions that the environment allows, truncated after ``max_steps``.

        Reset the environment afterwards.
        """
        random = np.random.default_rng(seed)
        recorder = TrajectoryRecorder()
        trajectories = []
        for episode in range(episodes):
            recorder.begin(self.reset(seed=seed + episode)[0])
            ended = False
            while not ended and len(recorder) < max_steps:
                legal = self._legal()
                action = int(random.choice(self.n_primitive if legal is None else np.flatnonzero(legal)))
                observation, reward, terminated, truncated, info = self.step(action)
                recorder.record(action, float(reward), observation)
                ended = terminated or truncated
            said = success_in(info) if ended else None
            recorder.end(terminated=terminated, truncated=not terminated, is_success=said)
            trajectories += recorder.finished
        return trajectories

    def action_masks(self) -> BoolArray:
        """Return which augmented actions may start now, shape (n_primitive + max_options,).

        An environment's masks of its own actions still apply. An option may not start if its first primitive is masked,
        or if it has run ``max_runs`` times in this episode.
        """
        if self.bank.max_options and not self.bank.filled:
            self._warn_once(
                "No slot holds an option, so masks allow primitive actions alone. If options were discovered, the "
                'model needs them here: sb3_options.load_model(MaskablePPO, "model.zip", env) or '
                'sb3_options.load_options("model.zip", env). To train, give learn() a SubgoalDiscoveryCallback or a '
                "PrimitiveStepsCallback. This warning appears once."
            )
        slots = self._available_slots([self._current_observation("action_masks()")])[0]
        legal = self._legal()
        return np.concatenate([self._all_primitives if legal is None else legal, slots])

    def _legal(self) -> BoolArray | None:
        """Return which primitives the environment allows now, (n_primitive,); None if it masks none."""
        if not self._has_masks:
            return None
        own = self.env.get_wrapper_attr("action_masks")
        return np.asarray(own() if callable(own) else own, dtype=bool)

    def _forbid_now(self, slots: BoolArray) -> None:
        """Clear, in place, the slots that have run ``max_runs`` times, or whose first primitive is masked now."""
        if self.max_runs is not None:
            slots[self._runs >= self.max_runs] = False
        legal = self._legal()
        if legal is not None:
            for slot in np.flatnonzero(slots).tolist():
                slots[slot] = legal[self.bank.action(slot, self._observation)]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment; ``seed`` also seeds the terminations of options with 0 < β < 1."""
        observation, info = self.env.reset(seed=seed, options=options)
        if self.check_finite:
            check_finite(self.env, observation)
        if seed is not None:
            self._random = np.random.default_rng([seed, TERMINATION_SEED])
        self._observation = observation
        self._runs[:] = 0
        self._running = None  # an error may have ended the last episode inside an option
        self._measure_features(observation)
        return observation, info

    def step(self, action: int) -> StepReturn:
        """Run one primitive action once, or one option to its end; the class docstring describes the result.

        Raises:
            ValueError: There is no such action, or ``check_finite`` refuses an observation or a reward.
        """
        action = int(action)
        slot = action - self.n_primitive
        if 0 <= action < self.n_primitive:
            return self._run_primitive(action)
        if not 0 <= slot < self.bank.max_options:
            raise ValueError(f"action must be between 0 and {self.action_space.n - 1}, got {action}.")
        option = self.bank[slot]
        if option is None:
            self._warn_once(
                f"Slot {slot} was chosen, and it is empty: a primitive action takes its place. To train, give "
                "learn() a SubgoalDiscoveryCallback, or a PrimitiveStepsCallback where nothing is to be discovered: "
                "they close empty slots, which harm learning otherwise. A trained model needs its options in the "
                'environment it acts in: sb3_options.load_model(DQN, "model.zip", env) or '
                'sb3_options.load_options("model.zip", env). This warning appears once.'
            )
        if option is None or (self.max_runs is not None and self._runs[slot] >= self.max_runs):
            return self._run_primitive(self._instead_of(slot), instead=True)
        observation = self._current_observation("step()")
        legal = self._legal()
        if legal is not None and not legal[self.bank.action(slot, self._observation)]:
            return self._run_primitive(self._instead_of(slot), instead=True)
        return self._run_option(option, slot, observation)

    def _instead_of(self, slot: int) -> int:
        """Return the first legal primitive from slot mod n_primitive on, or that one if none is legal."""
        candidates = (slot + np.arange(self.n_primitive)) % self.n_primitive
        legal = self._legal()
        return int(candidates[0 if legal is None else legal[candidates].argmax()])

    def running_option(self) -> str:
        """Return a description of the current action: an option and its slot, or "primitive action"."""
        option = None if self._running is None else self.bank[self._running]
        return "primitive action" if option is None else f"option {self._running}: {option.name}"

    def lost_step(self, observation: Any) -> dict[str, Any]:
        """Return the info of a step that is lost with its environment: a primitive step, cut off where it began."""
        return {"option": {**self._primitive_run(observation), "termination": "truncated"}}

    def _primitive_run(self, led: Any) -> RunInfo:
        option = RunInfo(self._primitive)
        if self.slot_state.report_availability and self.bank.filled:
            option["available"] = self._available_slots([led])
        return option

    def _run_primitive(self, action: int, *, instead: bool = False) -> StepReturn:
        """Run a primitive action that was chosen, or that runs ``instead`` of a slot."""
        result = self._primitive_step(action)
        option = self._primitive_run(result[0])
        if instead:
            option["actions"] = np.array([action])
        return self._reported(result, option)

    def _run_option(self, option: Option, slot: int, observation: Any) -> StepReturn:
        """Run an option until the episode, β, I or its longest duration ends it, checked in this order.

        The option also ends, as if it had left I, if the environment masks its next primitive action. Outside I it runs
        for one step.
        """
        inside = self.bank.may_start(slot, observation)
        self._runs[slot] += inside
        self._running = slot
        run = RunUnderWay(slot, option, observation, self.gamma, self._random, inside=inside)
        action = run.choose(self.bank)
        while run.termination is None:
            result = observation, reward, terminated, truncated, _ = self._primitive_step(action)
            ended: Termination | None = "terminated" if terminated else "truncated" if truncated else None
            run.advance(self.bank, reward, observation, ended)
            if run.termination is None:
                action = run.choose(self.bank)
                legal = self._legal()
                if legal is not None and not legal[action]:
                    run.termination = "left_initiation"
        self._running = None
        led = self._available_slots(run.observations[1:]) if self.slot_state.report_availability else None
        return self._reported((observation, run.total, *result[2:]), run.ended(led).as_info())

    def _primitive_step(self, action: int) -> StepReturn:
        result = self.env.step(action)
        self._observation = result[0]
        if self.check_finite:
            check_finite(self.env, result[0], result[1])
        return result

    def _reported(self, result: StepReturn, option: dict[str, Any]) -> StepReturn:
        """Return the result of the last primitive step, with the additions to ``info``."""
        observation, reward, terminated, truncated, info = result
        refuse_own(info, "option")
        info = dict(info)  # an environment may reuse one dictionary
        info["option"] = option
        if self._recording is not None and self._recording.finished:
            info.update(self._recording.take())
        return observation, reward, terminated, truncated, info

    def _available_slots(self, arrived_in: Sequence[Any]) -> BoolArray:
        """Return which slots may start in each observation; in the last, the present one, runs and masks count too."""
        available: BoolArray = self.bank.available_in(arrived_in)
        self._forbid_now(available[-1])
        return available

    def _current_observation(self, needed_by: str) -> Any:
        if self._observation is None:
            raise gym.error.ResetNeeded(f"{needed_by} needs a current observation: call reset() first.")
        return self._observation

    def _warn_once(self, text: str) -> None:
        if not (self.slot_state.expect_empty or self._warned):
            self._warned = True
            logger.warning(text)

    def on_layers(self, function: Callable[..., Any], *args: Any) -> tuple[Any, str | None]:
        """Call a function on this environment in its own process; return result and text of its error; see `layers`."""
        try:
            return function(self.outermost, *args), None
        except ValueError as error:  # it would end the worker process
            return None, str(error)

    def __setstate__(self, state: dict[str, Any]) -> None:
        # A copied or unpickled bank has no feature map (see `OptionBank.__getstate__`); this wrapper has one.
        self.__dict__.update(state)
        self.bank.bind(self.features.map if self.features else None)
