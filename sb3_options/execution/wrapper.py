"""`OptionsWrapper`: an environment whose actions are primitives and options."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, SupportsFloat, TypeAlias

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

from sb3_options.execution import features as feature_maps
from sb3_options.execution.interruption import Interruption
from sb3_options.execution.withholding import Withholding
from sb3_options.experience.observations import (
    BoolArray,
    FeatureMap,
    FloatArray,
    IntArray,
    Observations,
    batch_of_one,
    copy_of,
    stack,
)
from sb3_options.experience.option_run import OptionRun, Termination
from sb3_options.experience.recording import RewardPeaks, SegmentRecorder
from sb3_options.experience.trajectories import EpisodeRecorder, TrajectoryRecorder
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option

EMPTY_SLOT_SEED = 0x0971055
"""Mixed into the seed of ``reset``, so that empty slots draw from a stream apart from the environment's."""

StepReturn: TypeAlias = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]


class OptionsWrapper(gym.Wrapper[Any, int, Any, int], RecordConstructorArgs):
    """Adds ``max_options`` option slots to the actions of an environment with discrete actions.

    ``step(a)`` runs a primitive once, or an option to its end, and returns the last observation, the discounted sum
    Σ γⁱ rᵢ over the k primitive steps taken, the last flags and the last inner info, to which it adds an `OptionRun` as
    a dict::

        info["option"] = {"index": slot or -1, "duration": k, "discount": γᵏ, "gamma": γ, "termination": why it ended}

    where why is one of ``primitive``, ``subgoal``, ``left_initiation``, ``max_duration``, ``interrupted`` (by what
    `set_interruption` said), ``terminated`` and ``truncated``. An option also leaves there what Macro-Q learning needs:
    its primitive steps as stacked arrays ``observations`` (the k observations acted in), ``actions`` and ``rewards``.
    For algorithms that mask, `report_availability` adds ``available`` once the bank has options: for each of the k
    observations arrived in, which slots may start there, shape (k, max_options).

    An empty slot runs one uniformly random primitive, and names it as ``actions``. A filled option chosen outside its
    initiation set runs one step of its own policy. So an algorithm that cannot mask still sees a lawful semi-Markov
    process; ``action_masks()`` gives the strict sets to one that can. With no options it is the environment itself,
    bit for bit.

    With ``max_runs`` no option begins more often than that in an episode; then its slot counts as empty until the
    next one. An option whose subgoal is a dead end draws an untrained agent back again and again: so the agent is rid
    of it after a few runs. It is for algorithms that mask: others go on choosing the slot, and walk at random. How
    often an option has run is not in the observation; what is learned is an average over it.

    Args:
        env: Its action space must be ``Discrete`` and start at 0.
        max_options: Number of slots, at least 0.
        gamma: Discount γ per primitive step, in (0, 1]; must equal the algorithm's.
        feature_map: φ from a batch of observations to concept space, shape (batch, d). By default the environment's
            own ``concept_features``; else a one-hot code for ``Discrete`` observations and the flat observation for
            ``Box``. A ``Dict`` space has no default.
        max_runs: How often one option may run in an episode, at least 1; None for any number. Runs that were
            interrupted count; single steps, where an option was chosen outside its initiation set, do not.
        options_file: Start with the options of this file, which `OptionBank.save` wrote.

    Raises:
        TypeError: The action space is not ``Discrete``, or ``feature_map`` is not callable.
        ValueError: An argument is out of its range, or the file's options do not fit the environment.
        FileNotFoundError: There is no ``options_file``.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        max_options: int = 4,
        *,
        gamma: float = 0.99,
        feature_map: FeatureMap | None = None,
        options_file: str | os.PathLike[str] | None = None,
        max_runs: int | None = None,
    ) -> None:
        # Not copied: a feature map may be a method of the environment, which would be copied with it.
        RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,
            max_options=max_options,
            gamma=gamma,
            feature_map=feature_map,
            options_file=options_file,
            max_runs=max_runs,
        )
        gym.Wrapper.__init__(self, env)
        primitive = env.action_space
        if not isinstance(primitive, spaces.Discrete):
            raise TypeError(
                f"OptionsWrapper needs a Discrete action space, got {primitive}: options choose among numbered "
                "primitive actions. Discretise the actions first."
            )
        if primitive.start != 0:
            raise ValueError(f"OptionsWrapper needs actions that start at 0, got {primitive}.")
        if not 0.0 < gamma <= 1.0:
            raise ValueError(f"gamma must be in (0, 1], got {gamma}.")
        if max_runs is not None and (max_runs < 1 or max_runs % 1):
            raise ValueError(f"max_runs must be a whole number, at least 1, or None for no limit, got {max_runs}.")
        self.gamma = float(gamma)
        self.max_runs = max_runs
        self.n_primitive = int(primitive.n)
        self.features = feature_maps.resolve(env, feature_map)
        self.bank = OptionBank(
            self.n_primitive,
            max_options,
            feature_map=self.features.map if self.features else None,
            observation_size=feature_maps.flat_size(env.observation_space),
            feature_size=self.features.size if self.features else None,
            signature=feature_maps.signature(env.observation_space, self.features),
        )
        if options_file is not None:
            self.bank.load(options_file)
        self.action_space: Any = spaces.Discrete(self.n_primitive + max_options)
        self._random = np.random.default_rng()
        self._primitive_run = OptionRun(-1, 1, self.gamma, self.gamma, "primitive")
        self._primitive_info = self._primitive_run.as_info()
        self._observation: Any = None
        self._runs = np.zeros(max_options, dtype=np.int64)
        self._recorder: TrajectoryRecorder | None = None
        self._recorded_at: RewardPeaks | None = None
        self._reports_availability = False
        self._interruption: Interruption | None = None
        self._withholding: Withholding | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment; ``seed`` also seeds what empty slots draw."""
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self.seed_empty_slots(seed)
        self._observation = observation
        self._runs[:] = 0
        if self.features is not None and self.bank.feature_size is None:
            self.bank.feature_size = feature_maps.checked_size(self.features.map(batch_of_one(observation)))
        if self._recorder is not None:
            self._recorder.begin(observation)
        if self._withholding is not None:
            self._withholding.begin(self.bank.filled)
        return observation, info

    def seed_empty_slots(self, seed: int) -> None:
        """Seed what empty slots draw, and nothing of the environment."""
        self._random = np.random.default_rng([seed, EMPTY_SLOT_SEED])

    def step(self, action: int) -> StepReturn:
        """Run one primitive action once, or one option to its end.

        Args:
            action: 0 … n_primitive − 1 for a primitive, n_primitive + i for slot i.

        Returns:
            Observation, Σ γⁱ rᵢ, terminated, truncated, info as described for the class.

        Raises:
            ValueError: There is no such action.
            gymnasium.error.ResetNeeded: A slot is named before the first ``reset``.
        """
        action = int(action)
        if not 0 <= action < self.n_primitive + self.bank.max_options:
            raise ValueError(
                f"action must be between 0 and {self.n_primitive + self.bank.max_options - 1}, got {action}."
            )
        if self._recorder is not None:
            self._recorder.finished.clear()
        if action < self.n_primitive:
            return self._run_primitive(action)
        slot = action - self.n_primitive
        option = self.bank[slot]
        if option is None or self._has_run_out(slot):
            return self._run_instead(int(self._random.integers(self.n_primitive)))
        if self._withholding is not None:
            if self._withholding.holds(slot):
                return self._run_instead(self._instead_of(option, slot))
            self._withholding.note_use(slot)
        return self._run_option(option, slot)

    def _has_run_out(self, slot: int) -> bool:
        """Whether the option may not run again in this episode."""
        return self.max_runs is not None and bool(self._runs[slot] >= self.max_runs)

    def _run_instead(self, primitive: int) -> StepReturn:
        """Run a primitive in the place of a slot, and name it."""
        return self._run_primitive(primitive, actions=np.array([primitive]))

    def _instead_of(self, option: Option, slot: int) -> int:
        """What the agent would do without an option that is withheld.

        Where the agent's values are known (`set_interruption`), the best primitive in the place of a greedy choice
        and a random one in the place of an exploratory choice; else one step of the option's own policy.
        """
        observation = self._current_observation("step()")
        if self._interruption is None or self._withholding is None:
            return self._action_of(option, observation)
        if self._falls_behind(slot):
            return int(self._withholding.random.choice(np.flatnonzero(self.action_masks()[: self.n_primitive])))
        values = np.where(self.action_masks(), self._interruption.values(observation), -np.inf)
        return int(values[: self.n_primitive].argmax())

    def _run_primitive(self, action: int, actions: IntArray | None = None) -> StepReturn:
        observation, reward, terminated, truncated, info = self._primitive_step(action)
        reports = self._reports_availability and self.bank.filled
        if reports or actions is not None:
            available = self._available_slots(batch_of_one(observation)) if reports else None
            info["option"] = self._primitive_run._replace(actions=actions, available=available).as_info()
        else:
            info["option"] = self._primitive_info.copy()
        return observation, reward, terminated, truncated, info

    def _run_option(self, option: Option, slot: int) -> StepReturn:
        """Run an option until β, I, its longest duration or the episode ends it."""
        total, discount = 0.0, 1.0
        observations: list[Any] = [copy_of(self._current_observation("step()"))]
        actions: list[int] = []
        rewards: list[float] = []
        termination: Termination | None = None
        began_inside = bool(option.initiation(batch_of_one(observations[0]))[0])
        self._runs[slot] += began_inside
        interruptible = began_inside and self._is_interruptible(slot)
        while termination is None:
            action = self._action_of(option, observations[-1])
            observation, reward, terminated, truncated, info = self._primitive_step(action)
            observations.append(copy_of(observation))
            actions.append(action)
            rewards.append(float(reward))
            total += discount * float(reward)
            discount *= self.gamma
            if terminated:
                termination = "terminated"
            elif truncated:
                termination = "truncated"
            else:
                termination = self._why_ended(option, observation, len(actions), may_go_on=began_inside)
                if termination is None and interruptible and self._falls_behind(slot):
                    termination = "interrupted"
        info["option"] = OptionRun(
            slot,
            len(actions),
            discount,
            self.gamma,
            termination,
            stack(observations[:-1]),
            np.array(actions),
            np.array(rewards),
            self._available_slots(stack(observations[1:])) if self._reports_availability else None,
        ).as_info()
        return observation, total, terminated, truncated, info

    def _available_slots(self, arrived_in: Observations) -> BoolArray:
        """Which slots may start in each observation; in the last, where the agent is, `max_runs` counts."""
        available: BoolArray = self.bank.available_slots(arrived_in)
        if self.max_runs is not None:
            available[-1, self._runs >= self.max_runs] = False
        return available

    def _is_interruptible(self, slot: int) -> bool:
        """Whether the option about to begin ends where something else becomes the better choice."""
        rule = self._interruption
        return rule is not None and (rule.every_choice or not self._falls_behind(slot))

    def _falls_behind(self, slot: int) -> bool:
        """Whether the option is not the best choice in the current state."""
        assert self._interruption is not None  # only asked of an option that may be interrupted
        return self._interruption.falls_behind(self.n_primitive + slot, self._observation, self.action_masks)

    def _action_of(self, option: Option, observation: Any) -> int:
        action = int(option.policy(batch_of_one(observation))[0])
        if not 0 <= action < self.n_primitive:
            raise ValueError(
                f"The policy of option {option.name!r} chose {action}; primitive actions are 0 to "
                f"{self.n_primitive - 1}."
            )
        return action

    def _why_ended(self, option: Option, observation: Any, duration: int, *, may_go_on: bool) -> Termination | None:
        batch = batch_of_one(observation)
        probability = float(option.termination(batch)[0])
        if probability >= 1.0 or (probability > 0.0 and self._random.random() < probability):
            return "subgoal"
        if not (may_go_on and option.initiation(batch)[0]):
            return "left_initiation"
        return "max_duration" if duration >= option.max_duration else None

    def _primitive_step(self, action: int) -> StepReturn:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._observation = observation
        info = dict(info)  # an environment may hand out one and the same dictionary every time
        if self._recorder is not None:
            self._recorder.record(action, float(reward), observation)
            if terminated or truncated:
                success = info.get("is_success")
                self._recorder.end(
                    terminated=terminated,
                    truncated=truncated,
                    is_success=None if success is None else bool(success),
                )
            if self._recorder.finished:
                # All that was finished since `step` was called: of an option's infos only the last goes out.
                info |= self._recorder.report()
        if self._withholding is not None:
            self._withholding.note_reward(float(reward), self.gamma)
            report = self._withholding.report() if terminated or truncated else None
            if report is not None:
                info["option_trial"] = report
        return observation, reward, terminated, truncated, info

    def action_masks(self) -> BoolArray:
        """Which augmented actions may start now, shape (n_primitive + max_options,).

        An environment that masks its own actions goes on doing so; what an option does inside is not masked. An option
        that this episode does without, or that has run ``max_runs`` times in it, may not start.

        Raises:
            gymnasium.error.ResetNeeded: Before the first ``reset``.
        """
        mask: BoolArray = self.bank.available(batch_of_one(self._current_observation("action_masks()")))[0]
        if self.env.has_wrapper_attr("action_masks"):
            mask[: self.n_primitive] &= np.asarray(self.env.get_wrapper_attr("action_masks")(), dtype=bool)
        if self.max_runs is not None:
            mask[self.n_primitive :][self._runs >= self.max_runs] = False
        if self._withholding is not None:
            mask[[self.n_primitive + slot for slot in self._withholding.withheld()]] = False
        return mask

    def _current_observation(self, needed_by: str) -> Any:
        if self._observation is None:
            raise gym.error.ResetNeeded(f"{needed_by} needs a current observation: call reset() first.")
        return self._observation

    def available(self, observations: Observations) -> BoolArray:
        """Which augmented actions may start in each observation, shape (batch, n_primitive + max_options).

        Initiation sets alone: what an episode has used up, or does without, is nothing an observation tells.
        """
        return self.bank.available(observations)

    def concept_features(self, observations: Observations) -> FloatArray:
        """φ of a batch of observations, shape (batch, d).

        Raises:
            ValueError: There is no feature map.
        """
        if self.features is None:
            raise ValueError(
                f"There is no default feature map for {self.observation_space}: pass "
                "OptionsWrapper(env, feature_map=...) a function from a batch of observations to features (batch, d)."
            )
        return self.features.map(observations)

    def seen_observation_space(self) -> spaces.Space[Any]:
        """The space of the observations that options act on, whatever stands above."""
        return self.observation_space

    def feature_kind(self) -> feature_maps.FeatureKind | None:
        """Where the feature map comes from; None where there is none."""
        return self.features.kind if self.features else None

    def set_option(self, slot: int, option: Option | None) -> None:
        """Fill slot ``slot`` with ``option``, or empty it with None; used across process borders."""
        if option is not None:
            self.bank.add(option, slot)
        elif slot in self.bank.filled:
            self.bank.remove(slot)
        if option is None:
            self._runs[slot] = 0  # the next one begins to count anew; one that has grown does not

    def set_interruption(self, interruption: Interruption | None) -> None:
        """Interrupt options by these values from now on; None lets every option run to its end."""
        self._interruption = interruption

    def end_trials(self) -> None:
        """Withhold nothing any more, in the current episode either."""
        self._withholding = None

    def withhold_options(self, shares: dict[int, float], seed: Sequence[int]) -> None:
        """Try options: let each episode from the next one on do without a slot with a probability of ``shares[slot]``.

        The info that ends an episode then holds a `TrialReport` as ``info["option_trial"]``. A slot that is withheld
        is masked; chosen all the same, it runs what the agent would do without it, and names that as ``actions``.

        Args:
            shares: By slot; those that are not named are not tried.
            seed: Of the generator that draws; used the first time.
        """
        if self._withholding is None:
            self._withholding = Withholding(seed)
        self._withholding.shares = dict(shares)

    def report_availability(self, report: bool) -> None:
        """Whether ``info["option"]["available"]`` says which slots may start in each observation arrived in."""
        self._reports_availability = report

    def record_trajectories(self, record: bool, peaks: RewardPeaks | None = None) -> None:
        """Whether infos hold what was lived through.

        Args:
            record: Whether they do.
            peaks: Without it, the info that ends an episode holds it as ``info["trajectory"]``, a `Trajectory`. With
                it, ``info["segments"]`` is a list of those segments, cut at peaks of reward, that were finished during
                the call of ``step``; several may be while one option runs.
        """
        if record and (self._recorder is None or peaks != self._recorded_at):
            self._recorder = EpisodeRecorder() if peaks is None else SegmentRecorder(peaks)
            if self._observation is not None:
                self._recorder.begin(self._observation)
        elif not record:
            self._recorder = None
        self._recorded_at = peaks

    def __setstate__(self, state: dict[str, Any]) -> None:
        # A copied or unpickled bank has no feature map (see `OptionBank.__getstate__`); this wrapper does.
        self.__dict__.update(state)
        self.bank.bind(self.features.map if self.features else None)
