"""`OptionsWrapper`: an environment whose actions are primitives and options."""

from __future__ import annotations

import os
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_options.embedding.settings import MapName
from sb3_options.execution.features import checked_size
from sb3_options.execution.finite import check_finite
from sb3_options.execution.option_step import StepReturn, run_option
from sb3_options.execution.slots import TERMINATION_SEED, OptionSlots
from sb3_options.experience.observations import BoolArray, FeatureMap, Observations, batch_of_one
from sb3_options.experience.option_run import OptionRun
from sb3_options.options.option import Option


class OptionsWrapper(OptionSlots):
    """Adds ``max_options`` option slots to the actions of an environment with discrete actions.

    ``step(a)`` runs a primitive once, or an option to its end, and returns the last observation, the discounted sum
    Σ γⁱ rᵢ over the k primitive steps taken, the last flags and the last inner info, to which it adds what ran, as a
    dict of the fields of `OptionRun`::

        info["option"] = {"index": slot or -1, "duration": k, "discount": γᵏ, "gamma": γ, "termination": why it ended}

    An option also leaves its primitive steps there, which Macro-Q learning needs.

    An empty slot i runs primitive i mod n_primitive, and names it as ``actions``. An option that is chosen outside its
    initiation set runs one step of its own policy. So an algorithm that cannot mask still faces a semi-Markov decision
    process; ``action_masks()`` gives the initiation sets to one that can. Without options it is the environment itself,
    bit for bit.

    With ``max_runs`` no option begins more often than that in an episode; then its slot counts as empty until the
    next one. Without a limit an option whose subgoal is a dead end leads an untrained agent there again and again. It
    is for algorithms that mask: others go on choosing the slot, and take single steps. How often an option has run is
    not in the observation; what is learned is an average over it.

    Args:
        env: Its action space must be ``Discrete`` and start at 0.
        max_options: Number of slots, at least 0.
        gamma: Discount γ per primitive step, in (0, 1]; must equal the algorithm's.
        feature_map: φ from a batch of observations to concept space, shape (batch, d). By default the environment's
            own ``concept_features``; else a one-hot code for ``Discrete`` observations and the flat observation for
            ``Box``. A ``Dict`` space has no default. ``"temporal-distance"`` and ``"laplacian"`` are learned by
            `SubgoalDiscoveryCallback` while the model trains, from images too.
        options_file: Start with the options of this file, which `OptionBank.save` wrote, or of this ``model.zip``.
        max_runs: How often one option may run in an episode, at least 1; None for any number. Runs that were
            interrupted count; single steps, where an option was chosen outside its initiation set, do not.
        check_finite: Whether to refuse observations and rewards that are NaN, infinite, or too large for single
            precision, instead of learning from them.

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
        feature_map: FeatureMap | MapName | None = None,
        options_file: str | os.PathLike[str] | None = None,
        max_runs: int | None = None,
        check_finite: bool = False,
    ) -> None:
        super().__init__(env, max_options, gamma, feature_map, options_file, max_runs, check_finite)
        self._primitive = OptionRun(-1, 1, self.gamma, self.gamma, "primitive").as_info()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment; ``seed`` also seeds whether options with 0 < β < 1 end."""
        observation, info = self.env.reset(seed=seed, options=options)
        if self.check_finite:
            check_finite(self.env, observation)
        if seed is not None:
            self._random = np.random.default_rng([seed, TERMINATION_SEED])
        self._observation = observation
        self._limit.runs[:] = 0
        self._running = None  # an error may have ended the last episode within an option
        if self.features is not None and self.bank.feature_size is None:
            self.bank.feature_size = checked_size(self.features.map, batch_of_one(observation))
        return observation, info

    def step(self, action: int) -> StepReturn:
        """Run one primitive action once, or one option to its end.

        Args:
            action: 0 … n_primitive − 1 for a primitive, n_primitive + i for slot i.

        Returns:
            Observation, Σ γⁱ rᵢ, terminated, truncated, info as described for the class.

        Raises:
            ValueError: There is no such action, the environment's info uses a name that is needed here, or
                ``check_finite`` refuses what it gave.
            gymnasium.error.ResetNeeded: A slot is named before the first ``reset``.
        """
        action = int(action)
        slot = action - self.n_primitive
        if 0 <= action < self.n_primitive:
            return self._run_primitive(action)
        if not 0 <= slot < self.bank.max_options:
            last = self.n_primitive + self.bank.max_options - 1
            raise ValueError(f"action must be between 0 and {last}, got {action}.")
        option = self.bank[slot]
        if option is None:
            self._chose_empty(slot)
        if option is None or self._limit.is_reached(slot):
            return self._run_primitive(slot % self.n_primitive, instead=True)
        observation = self._current_observation("step()")
        return self._run_option(option, slot, observation)

    def lost_step(self, observation: Any) -> dict[str, Any]:
        """The info of a step whose outcome is lost, with its environment: one primitive step that was cut off.

        Args:
            observation: In which it was taken, and the last that is known.
        """
        option = {**self._primitive, "termination": "truncated"}
        if self._reports_availability and self.bank.filled:
            option["available"] = self._available_slots(batch_of_one(observation))
        return {"option": option}

    def _run_primitive(self, action: int, *, instead: bool = False) -> StepReturn:
        """Run a primitive action that was chosen, or that runs ``instead`` of a slot."""
        result = self._primitive_step(action)
        option = self._primitive.copy()
        if instead:
            option["actions"] = np.array([action])
        if self._reports_availability and self.bank.filled:
            option["available"] = self._available_slots(batch_of_one(result[0]))
        return self._reported(result, option)

    def _run_option(self, option: Option, slot: int, observation: Any) -> StepReturn:
        """Run an option to its end."""
        inside = bool(option.initiation(batch_of_one(observation))[0])
        self._limit.runs[slot] += inside
        interrupted = None
        if inside and self._interruption is not None:
            interrupted = self._interruption.watch(self.n_primitive + slot, observation, self.action_masks)
        self._running = slot
        result, run = run_option(
            option,
            slot,
            observation,
            self._primitive_step,
            inside=inside,
            interrupted=interrupted,
            available=self._available_slots if self._reports_availability else None,
            n_primitive=self.n_primitive,
            gamma=self.gamma,
            random=self._random,
        )
        self._running = None
        return self._reported(result, run.as_info())

    def _primitive_step(self, action: int) -> StepReturn:
        result = self.env.step(action)
        self._observation = result[0]
        if self.check_finite:
            check_finite(self.env, result[0], result[1])
        return result

    def _reported(self, result: StepReturn, option: dict[str, Any]) -> StepReturn:
        """What the last primitive step returned, with all that ``info`` is to say."""
        observation, reward, terminated, truncated, info = result
        if "option" in info:
            raise ValueError(
                'The environment has an info["option"] of its own, where OptionsWrapper reports what ran: give it '
                "another name there, and wrap in OptionsWrapper once only."
            )
        info = dict(info)  # an environment may hand out one and the same dictionary every time
        info["option"] = option
        if self._recording is not None and self._recording.finished:
            info.update(self._recording.take())
        return observation, reward, terminated, truncated, info

    def _available_slots(self, arrived_in: Observations) -> BoolArray:
        """Which slots may start in each observation; in the last, where the agent is, `max_runs` counts."""
        available: BoolArray = self.bank.available_slots(arrived_in)
        if self.max_runs is not None:
            self._limit.forbid(available[-1])
        return available

    def _current_observation(self, needed_by: str) -> Any:
        if self._observation is None:
            raise gym.error.ResetNeeded(f"{needed_by} needs a current observation: call reset() first.")
        return self._observation

    def masks_primitives(self) -> bool:
        """Whether the environment says which of its own actions may be taken."""
        return bool(self.env.has_wrapper_attr("action_masks"))

    def action_masks(self) -> BoolArray:
        """Which augmented actions may start now, shape (n_primitive + max_options,).

        An environment that masks its own actions goes on doing so; what an option does inside is not masked. An option
        that has run ``max_runs`` times in this episode may not start.

        Raises:
            gymnasium.error.ResetNeeded: Before the first ``reset``.
        """
        if not (self.bank.filled or self._expects_empty or self._warned):
            self._warn_of_no_options()
        mask: BoolArray = self.bank.available(batch_of_one(self._current_observation("action_masks()")))[0]
        primitives, slots = mask[: self.n_primitive], mask[self.n_primitive :]
        if self.masks_primitives():
            own = np.asarray(self.env.get_wrapper_attr("action_masks")(), dtype=bool)
            if own.shape != primitives.shape:
                raise ValueError(
                    f"action_masks() of the environment must have an entry for each of its {self.n_primitive} actions, "
                    f"got shape {own.shape}."
                )
            primitives &= own
        self._limit.forbid(slots)
        return mask
