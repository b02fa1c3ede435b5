"""Options ⟨I, π, β⟩ (Sutton, Precup & Singh 1999), hand-made or with a subgoal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, InitVar, dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from sb3_options.checked import is_number
from sb3_options.density.regions import Region
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.experience import observations as obs_batch
from sb3_options.experience.observations import BoolArray, FeatureMap, FloatArray, IntArray, Observations
from sb3_options.options.policies import OptionPolicy, PolicyInput
from sb3_options.state import storable

CACHE_BYTES = 4 << 20  # memory of each cache of a `SubgoalOption`, observations included; approximate
CACHE_ENTRY_BYTES = 200  # memory of one cached result besides its numbers and its observation; measured, rounded up
CACHE_BATCH = 128  # largest batch that is looked up: a larger one is computed as quickly

Result = TypeVar("Result", bound=np.generic)


class KnownResults(Generic[Result]):
    """Caches a function's results by observation. Small environments repeat theirs.

    If, when the memory is used up, most observations were new, it caches nothing any more.

    The function is passed with every call. If an option's caches held its own methods, only the garbage collector could
    free the option. Its table and all results would linger each time a later version replaces it.
    """

    def __init__(self) -> None:
        self._rows: dict[bytes, int] = {}
        self._results: npt.NDArray[Any] = np.empty(0)  # one in each row, with room for later ones
        self._n = 0  # rows in use
        self._bytes = 0  # without the results
        self._hits = 0
        self._gave_up = False

    def __call__(
        self, compute: Callable[[Observations], npt.NDArray[Result]], observations: Observations
    ) -> npt.NDArray[Result]:
        """Return the result of ``compute``, always the same function, (batch, ...). Only copies may be changed."""
        if self._gave_up or not 1 <= obs_batch.batch_size(observations) <= CACHE_BATCH:
            return compute(observations)
        keys = obs_batch.keys_of(observations)
        rows: list[Any] = list(map(self._rows.get, keys))
        if None not in rows:
            self._hits += len(rows)
            return self._results[rows]
        new = [i for i, row in enumerate(rows) if row is None]
        self._hits += len(rows) - len(new)
        if len(new) == len(rows):
            results = compute(observations)
        else:
            results = self._results[[row or 0 for row in rows]]
            results[new] = compute(obs_batch.take(observations, np.array(new)))
        self._keep([keys[i] for i in new], results[new])
        return results

    def _keep(self, keys: list[bytes], results: npt.NDArray[Result]) -> None:
        if self._bytes + self._results.nbytes > CACHE_BYTES:
            self._gave_up = self._hits < len(self._rows)
            self._rows = {}
            self._n = self._bytes = self._hits = 0
        begin, self._n = self._n, self._n + len(keys)
        if begin == 0:
            self._results = results[:0]
        if self._n > len(self._results):
            grown = np.empty((self._n + self._n // 4, *results.shape[1:]), dtype=results.dtype)
            grown[:begin] = self._results[:begin]
            self._results = grown
        self._results[begin : self._n] = results
        self._rows.update(zip(keys, range(begin, self._n), strict=True))
        self._bytes += sum(map(len, keys)) + CACHE_ENTRY_BYTES * len(keys)


class KnownFeatures:
    """A feature map φ that caches features, which all options of a bank need, until the map is learned anew."""

    def __init__(self, of: FeatureMap) -> None:
        self.of = of
        self._learned = of if isinstance(of, LearnedMap) else None
        self._forget()

    def _forget(self) -> None:
        self._known: KnownResults[np.float64] = KnownResults()
        self._known_at = self.scale

    @property
    def scale(self) -> FloatArray | None:
        """Scale of a learned map, another array each time that it changes; None for other maps."""
        return None if self._learned is None else self._learned.scale

    def __call__(self, observations: Observations) -> FloatArray:
        """Return φ of a batch of observations, (batch, d). Not to be changed."""
        if self.scale is not self._known_at:
            self._forget()
        return self._known(self.computed, observations)

    def computed(self, observations: Observations) -> FloatArray:
        """Return φ of a batch of observations, (batch, d), without looking them up."""
        features = np.array(self.of(observations), dtype=np.float64)  # a copy: φ may return a view of the observations
        n = obs_batch.batch_size(observations)
        if features.ndim != 2 or len(features) != n:
            raise ValueError(
                f"feature_map must return a row of features for each observation, shape ({n}, d), got {features.shape}"
            )
        return features


class Option:
    """A temporally extended action: where it may start, what it does, and where it ends.

    All three are functions of a batch of the observations that `OptionsWrapper` sees. The wrapper ends an option after
    at least one step: when ``termination`` says so, outside the initiation set, or after ``max_duration`` steps. So
    ``initiation`` must hold in every state where the option may go on. In worker processes (``SubprocVecEnv``) all
    three must be functions of a module: lambdas and closures cannot travel.

    Args:
        initiation: I. Observations → bool, shape (batch,).
        policy: π. Observations → primitive actions, shape (batch,).
        termination: β inside I. Observations → probability of ending (or bool), shape (batch,).
        max_duration: Longest run, in primitive steps, at least 1.
        name: Name in logs and figures.

    Raises:
        ValueError: ``max_duration`` < 1.
        TypeError: One of the three is not callable.
    """

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name!r}, of at most {self.max_duration} steps>"

    def __init__(
        self,
        # Functions of what this environment observes, so of arrays alone, of numbers, or of a Dict.
        initiation: Callable[[Any], npt.ArrayLike],
        policy: Callable[[Any], npt.ArrayLike],
        termination: Callable[[Any], npt.ArrayLike],
        *,
        max_duration: int = 100,
        name: str = "option",
    ) -> None:
        self._initiation = initiation
        self._policy = policy
        self._termination = termination
        self.max_duration = checked_duration(max_duration)
        self.name = name

    def initiation(self, observations: Observations) -> BoolArray:
        """Return whether each observation lies in I, shape (batch,)."""
        return self._checked("initiation", self._initiation(observations), observations).astype(bool)

    def policy(self, observations: Observations) -> IntArray:
        """Return the primitive action of π in each observation, shape (batch,)."""
        actions = self._checked("policy", self._policy(observations), observations)
        if not np.array_equal(actions, np.round(actions)):
            raise ValueError(f"policy of option {self.name!r} must return whole numbers, got {actions}.")
        return actions.astype(np.int64)

    def termination(self, observations: Observations) -> FloatArray:
        """Return β inside I: the probability of ending in each observation, shape (batch,)."""
        return self._checked("termination", self._termination(observations), observations).astype(np.float64)

    def membership(self, observations: Observations) -> tuple[BoolArray, FloatArray]:
        """Return `initiation` and `termination` of each observation, (batch,) each."""
        termination = self.termination(observations)
        return self.initiation(observations), termination

    def _checked(self, what: str, value: npt.ArrayLike, observations: Observations) -> npt.NDArray[Any]:
        array = np.asarray(value)
        expected = (obs_batch.batch_size(observations),)
        if array.shape != expected:
            raise ValueError(
                f"{what} of option {self.name!r} must return one value per observation, shape {expected}, "
                f"got shape {array.shape}."
            )
        return array


def checked_duration(max_duration: int) -> int:
    """Return ``max_duration`` if it is a whole number of at least 1."""
    if not (is_number(max_duration) and max_duration >= 1 and max_duration % 1 == 0):
        raise ValueError(f"max_duration must be a whole number of primitive steps, at least 1, got {max_duration!r}.")
    return int(max_duration)


@storable
@dataclass(eq=False, repr=False)
class SubgoalOption(Option):
    """An option that is made only of data, and reaches a region of concept space from within an initiation set.

    Args:
        subgoal: β = 1 inside this region.
        initiation_set: I is this region without the subgoal: at the subgoal there is nothing left to reach.
        option_policy: π.
        policy_input: Whether π acts on the observation or on its features φ. Of these it sees only the group of the
            initiation set, if that has one.
        feature_map: φ; None until `bind` sets it, because functions do not travel in files or between processes.
        max_duration: Longest run, in primitive steps, at least 1.
        name: Name in logs and figures.

    Raises:
        ValueError: ``max_duration`` < 1.
    """

    subgoal: Region
    initiation_set: Region
    option_policy: OptionPolicy
    _: KW_ONLY
    policy_input: PolicyInput = "observation"
    feature_map: InitVar[FeatureMap | None] = None
    max_duration: int = 100
    name: str = "subgoal"

    def __post_init__(self, feature_map: FeatureMap | None) -> None:
        """Bind the option to φ, if there is one."""
        self.max_duration = checked_duration(self.max_duration)
        if feature_map is not None and not isinstance(feature_map, KnownFeatures):
            feature_map = KnownFeatures(feature_map)
        self.known_features = feature_map
        self._forget_results()

    def _forget_results(self) -> None:
        # By features, and by what π acts on. Copies that are bound to the φ of other environments share both.
        self._membership: KnownResults[np.bool_] = KnownResults()
        self._members: dict[bytes, tuple[bool, bool]] = {}
        self._greedy: KnownResults[np.integer[Any]] = KnownResults()

    def bind(self, feature_map: FeatureMap | None) -> SubgoalOption:
        """Return the same option with φ set."""
        bound = replace(self, feature_map=feature_map)
        bound._membership, bound._members, bound._greedy = self._membership, self._members, self._greedy
        return bound

    def initiation(self, observations: Observations) -> BoolArray:
        """Return whether each observation lies in I, shape (batch,)."""
        return self.membership_at(self.features(observations))[:, 0].copy()

    def policy(self, observations: Observations) -> IntArray:
        """Return the greedy action of the option's value function, shape (batch,)."""
        if self.policy_input == "features":
            return self.policy_at(self.features(observations))
        return self._greedy(self.option_policy.actions, observations).copy()

    def policy_at(self, features: FloatArray) -> IntArray:
        """Return `policy` from φ, (batch, d), if that is what it sees."""
        return self._greedy(self.option_policy.actions, self.initiation_set.own(features)).copy()

    def termination(self, observations: Observations) -> FloatArray:
        """Return 1 at the subgoal, else 0, shape (batch,)."""
        return self.membership_at(self.features(observations))[:, 1].astype(np.float64)

    def membership(self, observations: Observations) -> tuple[BoolArray, FloatArray]:
        """Return `initiation` and `termination` at once."""
        membership = self.membership_at(self.features(observations))
        return membership[:, 0].copy(), membership[:, 1].astype(np.float64)

    def membership_at(self, features: FloatArray) -> BoolArray:
        """Return whether each row of φ (batch, d) lies in I, and in the subgoal, (batch, 2). Not to be changed."""
        return self._membership(self._membership_of, features)

    def member(self, features: FloatArray, key: bytes) -> tuple[bool, bool]:
        """Return `membership_at` of one row of φ, (1, d), looked up by its bytes."""
        known = self._members.get(key)
        if known is None:
            if len(self._members) * (len(key) + CACHE_ENTRY_BYTES) > CACHE_BYTES:
                self._members.clear()
            row = features[0].tolist()
            arrived = self.subgoal.contains_one(row)
            known = self._members[key] = not arrived and self.initiation_set.contains_one(row), arrived
        return known

    def _membership_of(self, features: Any) -> BoolArray:
        membership = np.empty((len(features), 2), dtype=bool)
        membership[:, 1] = self.subgoal.contains(features)
        membership[:, 0] = self.initiation_set.contains(features) & ~membership[:, 1]
        return membership

    def features(self, observations: Observations) -> FloatArray:
        """Return φ of a batch of observations, (batch, d). Not to be changed."""
        if self.known_features is None:
            raise ValueError(
                f"Option {self.name!r} has no feature map: add it to the bank of an OptionsWrapper that has one, "
                "or call option.bind(feature_map)."
            )
        return self.known_features(observations)

    def __getstate__(self) -> dict[str, Any]:
        kept = {k: v for k, v in self.__dict__.items() if k not in ("_membership", "_members", "_greedy")}
        return {**kept, "known_features": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state
        self._forget_results()
