"""`OptionSlots`: what an environment with options holds, and what others read and set, also from another process."""

from __future__ import annotations

import logging
import os
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.monitor import Monitor

from sb3_options.checked import is_number
from sb3_options.density.groups import FeatureGroup
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.embedding.settings import MapName
from sb3_options.execution import features as feature_maps
from sb3_options.execution import layers, monitoring
from sb3_options.execution.interruption import Interruption
from sb3_options.execution.recording import RecordTrajectories
from sb3_options.execution.run_limit import RunLimit
from sb3_options.experience.observations import BoolArray, FeatureMap, FloatArray, Observations
from sb3_options.experience.recording import RewardPeaks
from sb3_options.options.archive import Source
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import Option

logger = logging.getLogger("sb3_options")

TERMINATION_SEED = 0x0971055
"""Mixed into the seed of ``reset``: β draws from a stream apart from the environment's."""


class OptionSlots(gym.Wrapper[Any, int, Any, int], RecordConstructorArgs):
    """A bank of options, their feature map, and how they are to be run; arguments and errors of `OptionsWrapper`.

    `OptionsWrapper` runs the options. ``VecEnv.env_method`` calls what is public here.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        max_options: int,
        gamma: float,
        feature_map: FeatureMap | MapName | None,
        options_file: str | os.PathLike[str] | None,
        max_runs: int | None,
        check_finite: bool,
    ) -> None:
        if not isinstance(env, gym.Env):
            raise TypeError(
                f"OptionsWrapper needs one environment, as gymnasium.make(...) gives it, got {env!r}. For several: "
                "make_vec_env(..., wrapper_class=OptionsWrapper, wrapper_kwargs={...})."
            )
        # Not copied: a feature map may be a method of the environment, which would be copied with it.
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
        primitive = env.action_space
        if not isinstance(primitive, spaces.Discrete):
            raise TypeError(
                f"OptionsWrapper needs a Discrete action space, got {primitive}: options choose among numbered "
                "primitive actions. Discretise the actions first."
            )
        if primitive.start != 0:
            raise ValueError(f"OptionsWrapper needs actions that start at 0, got {primitive}.")
        if not (is_number(gamma) and 0.0 < gamma <= 1.0):
            raise ValueError(f"gamma must be in (0, 1], got {gamma!r}.")
        if not isinstance(options_file, str | bytes | os.PathLike | None):
            raise TypeError(f"options_file must be a path or None, got {type(options_file).__name__}.")
        self.gamma, self.max_runs, self.check_finite = float(gamma), max_runs, check_finite
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
        self._observation: Any = None
        self._random = np.random.default_rng(TERMINATION_SEED)  # until a reset is given a seed
        self._limit = RunLimit(max_options, max_runs)
        self._reports_availability = False
        self._recording: RecordTrajectories | None = None
        self._interruption: Interruption | None = None
        self._expects_empty = self._warned = False
        self._running: int | None = None
        self._outermost: gym.Env[Any, Any] = self

    def available(self, observations: Observations) -> BoolArray:
        """Which augmented actions may start in each observation, shape (batch, n_primitive + max_options).

        By initiation sets alone: an observation does not tell what may not run again.
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
                "OptionsWrapper(env, feature_map=...) a function from a batch of observations to features (batch, d), "
                "or the name of one that is learned, 'temporal-distance' or 'laplacian'."
            )
        return self.features.map(observations)

    def learned_map(self) -> LearnedMap | None:
        """The feature map, if it is one that is learned."""
        learned = self.features.map if self.features else None
        return learned if isinstance(learned, LearnedMap) else None

    def set_learned_map(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Let the learned feature map be what `LearnedMap.arrays` gave."""
        learned = self.learned_map()
        if learned is None:
            raise ValueError(f"The feature map of {self} is not learned: there is nothing to set.")
        learned.load(arrays)

    def feature_kind(self) -> feature_maps.FeatureKind | None:
        """Where the feature map comes from; None where there is none."""
        return self.features.kind if self.features else None

    def feature_groups(self) -> tuple[FeatureGroup, ...]:
        """Which features make a concept together; empty where all do, or where there is no feature map."""
        return self.features.groups if self.features else ()

    def concept_size(self) -> int | None:
        """Dimensions of concept space; None without a feature map, or before the first reset where φ does not tell."""
        return self.bank.feature_size

    def running_option(self) -> str:
        """What runs at this moment, for people: an option and its slot, or "primitive action"."""
        option = None if self._running is None else self.bank[self._running]
        return "primitive action" if option is None else f"option {self._running}: {option.name}"

    def seen_observation_space(self) -> spaces.Space[Any]:
        """The space of the observations that options act on, also where a wrapper above has another."""
        return self.observation_space

    def set_option(self, slot: int, option: Option | None) -> None:
        """Fill slot ``slot`` with ``option``, or empty it with None.

        Raises:
            TypeError: It is no option.
            ValueError: There is no such slot.
        """
        self.bank.check_slot(slot)
        if option is not None:
            self.bank.add(option, slot)
        elif slot in self.bank.filled:
            self.bank.remove(slot)
        if option is None:
            self._limit.runs[slot] = 0  # the next one begins to count anew; one that has grown does not

    def load_options(self, source: Source) -> None:
        """Fill slots with the options of a file; as `OptionBank.load`."""
        self.bank.load(source)

    def expect_empty(self, expect: bool) -> None:
        """Whether a callback knows which slots are empty, so that choosing one is exploration and no mistake."""
        self._expects_empty = expect

    def _chose_empty(self, slot: int) -> None:
        if not (self._expects_empty or self._warned):
            self._warned = True
            logger.warning(
                "Slot %d was chosen, and it is empty: a primitive action takes its place. To train, give "
                "learn() a SubgoalDiscoveryCallback, or a PrimitiveStepsCallback where nothing is to be discovered: "
                "they close empty slots, which harm learning otherwise. A trained model needs its options in the "
                'environment it acts in: sb3_options.load_model(DQN, "model.zip", env) or '
                'sb3_options.load_options("model.zip", env). This is said once.',
                slot,
            )

    def _warn_of_no_options(self) -> None:
        if self.bank.max_options:
            self._warned = True
            logger.warning(
                "No slot holds an option, so that masks allow primitive actions alone. If options were discovered, the "
                'model needs them here: sb3_options.load_model(MaskablePPO, "model.zip", env) or '
                'sb3_options.load_options("model.zip", env). To train, give learn() a SubgoalDiscoveryCallback or a '
                "PrimitiveStepsCallback. This is said once."
            )

    def set_interruption(self, interruption: Interruption | None) -> None:
        """Interrupt options by these values from now on; None lets every option run to its end."""
        self._interruption = interruption

    def report_availability(self, report: bool) -> None:
        """Whether ``info["option"]["available"]`` says which slots may start in each observation arrived in."""
        self._reports_availability = report

    def record_trajectories(self, record: bool, peaks: RewardPeaks | None = None) -> None:
        """Whether infos hold the primitive steps that were taken, which are recorded beneath this wrapper.

        Args:
            record: Whether they do.
            peaks: Without it, the info that ends an episode holds it as ``info["trajectory"]``, a `Trajectory`. With
                it, ``info["segments"]`` is a list of those segments, cut at peaks of reward, that were finished during
                the call of ``step``; several may be while one option runs.
        """
        if record and self._recording is None:
            # Beneath a Monitor, which others expect right beneath this wrapper.
            above: gym.Wrapper[Any, Any, Any, Any] = self.env if isinstance(self.env, Monitor) else self
            above.env = self._recording = RecordTrajectories(above.env)
        if self._recording is not None:
            self._recording.set(record, peaks, self._observation)

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint, without the options, which whoever installed them puts back."""
        return {
            "observation": self._observation,
            "random": self._random.bit_generator.state,
            "runs": self._limit.runs,
            "reports_availability": self._reports_availability,
            "warned": self._warned,
            "feature_size": self.bank.feature_size,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._observation, self._running = state["observation"], None
        self._random.bit_generator.state = state["random"]
        self._limit.runs[:] = state["runs"]
        self._reports_availability, self._warned = state["reports_availability"], state["warned"]
        self.bank.feature_size = state["feature_size"]

    def count_primitive_steps(self) -> None:
        """Let each ``Monitor`` above this wrapper count primitive steps (`PrimitiveMonitor`), in its own process."""
        monitoring.count_primitive_steps(self._outermost, self)

    def prepare_layers(self, just_reset: bool) -> str | None:
        """`layers.prepare` this environment, in its own process; returns why it cannot: an error would end it."""
        try:
            layers.prepare(self._outermost, just_reset=just_reset)
        except ValueError as error:
            return str(error)
        return None

    def layer_states(self) -> list[layers.State]:
        """`layers.states_of` this environment, in its own process."""
        return layers.states_of(self._outermost)

    def set_layer_states(self, states: list[dict[str, Any]]) -> tuple[str | None, str | None]:
        """`layers.set_states` of this environment, in its own process: what it returns, and the text of its error."""
        try:
            return layers.set_states(self._outermost, states), None
        except ValueError as error:
            return None, str(error)

    def __setstate__(self, state: dict[str, Any]) -> None:
        # A copied or unpickled bank has no feature map (see `OptionBank.__getstate__`); this wrapper does.
        self.__dict__.update(state)
        self.bank.bind(self.features.map if self.features else None)


class _Kind(type):
    def __instancecheck__(cls, env: Any) -> bool:
        inner = env
        while not isinstance(inner, OptionSlots):
            inner = inner.env
        inner._outermost = env
        return True


class Outermost(metaclass=_Kind):
    """For ``VecEnv.env_is_wrapped``, which asks the outermost wrapper first: `OptionSlots` knows it then."""
