"""The interface of discovery methods: experience in, proposals out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

from sb3_options.checked import is_number
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.diary import Diary
from sb3_options.discovery.filters import Filters
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory, TrajectoryDatabase
from sb3_options.options.proposals import IntrinsicReward, Passage, Proposal, bins_of, everywhere

if TYPE_CHECKING:
    from sb3_options.discovery.settings import DiscoverySettings

__all__ = ["DiscoveryMethod", "Experience", "IntrinsicReward", "Method", "Passage", "Places", "Proposal", "Region"]

PROPOSALS = (Region, Passage, IntrinsicReward)
"""What an option may be made for."""

Array = TypeVar("Array", bound=npt.NDArray[Any])
Placed = TypeVar("Placed", bound=Region | IntrinsicReward)


class Experience:
    """The newest trajectory, and the database it is in, as methods see them.

    Args:
        features: φ of its distinct observations, in order of first visit, (m, d); methods may not write to it.
        visits: Row of ``features`` at every time t = 0 … T, (T + 1,); read-only as well.
        success: Whether it was successful.
        allowed: Which of its states may be subgoals, (m,): the static filter allows them, and no subgoal is near; or
            what computes that when it is first asked for.
        scale: Factor for every feature that makes one unit one step, (d,).
        radius: Of a subgoal, in scaled units.
        taken: Subgoals that there are options for.
        avoided: Subgoals that a search of the database leaves out: those taken, and those that no option could be
            learned for.
        trajectory: Itself, with actions, rewards and observations; may be left out.
        database: The last trajectories.
    """

    def __init__(
        self,
        features: FloatArray,
        visits: IntArray,
        *,
        success: bool,
        allowed: BoolArray | Callable[[], BoolArray],
        scale: FloatArray,
        radius: float,
        taken: Sequence[Region] = (),
        avoided: Sequence[Region] = (),
        trajectory: Trajectory | None = None,
        database: TrajectoryDatabase | None = None,
    ) -> None:
        self.features = _read_only(features)
        self.visits = _read_only(visits)
        self.success = success
        self.scale = scale
        self.radius = radius
        self.taken = tuple(taken)
        self.avoided = tuple(avoided)
        self.database = TrajectoryDatabase(1) if database is None else database
        self._allowed = allowed
        self._trajectory = trajectory

    @cached_property
    def allowed(self) -> BoolArray:
        """Which of its states may be subgoals, (m,)."""
        return self._allowed() if callable(self._allowed) else self._allowed

    @cached_property
    def trajectory(self) -> Trajectory:
        """Itself: ``actions`` and ``rewards`` of every step, and the observation behind each row of ``features``."""
        known = self._trajectory
        if known is None:
            raise AttributeError("this experience was made of features and visits alone: it has no trajectory.")
        states = known.states
        return replace(
            known,
            states={key: _read_only(of) for key, of in states.items()}
            if isinstance(states, Mapping)
            else _read_only(np.asarray(states)),
            visits=self.visits,
            actions=_read_only(known.actions),
            rewards=_read_only(known.rewards),
        )

    @cached_property
    def places(self) -> Places:
        """Its states, binned at one unit of concept space, so that states that differ by less are one."""
        bins = bins_of(self.features, self.scale)
        _, first, which = np.unique(bins + 0.0, axis=0, return_index=True, return_inverse=True)
        which = which.ravel()
        allowed = np.ones(len(first), dtype=bool)
        allowed[which[~self.allowed]] = False
        return Places(self.features[first], bins[first], which[self.visits], allowed)

    def region(self, point: ArrayLike) -> Region:
        """The region around a place, (d,)."""
        return Region(np.array(point, dtype=np.float64)[None], self.scale, self.radius)

    @property
    def everywhere(self) -> Region:
        """The region of all states: a `Passage` from there starts wherever saved steps lead to its subgoal."""
        return everywhere(len(self.scale))


def _read_only(array: Array) -> Array:
    """A view that cannot be written to: the database holds the same numbers."""
    seen = array.view()
    seen.flags.writeable = False
    return seen


class Places(NamedTuple):
    """The distinct places of a trajectory.

    Attributes:
        points: One state of each, (k, d).
        bins: Which place it is, whole numbers, (k, d).
        visits: Row of ``points`` at every time, (T + 1,).
        allowed: Whether all its states may be subgoals, (k,).
    """

    points: FloatArray
    bins: FloatArray
    visits: IntArray
    allowed: BoolArray


class DiscoveryMethod(Protocol):
    """Proposes subgoals from the agent's experience, and from nothing else.

    Any object with this method may be passed as ``SubgoalDiscoveryCallback(method=…)``. A checkpoint also needs
    ``get_state()``, which gives a dictionary of arrays and plain values, and ``set_state(state)``. The budget also
    needs ``seconds(experience)``: how long an update takes, estimated by sizes and not by the clock. Without it
    updates are measured, and two trainings with one seed may differ. ``needs_success = True`` says that a method
    proposes nothing before a success; where none succeeds, that is the reason that users read.
    """

    def update(self, experience: Experience) -> Sequence[Proposal]:
        """Take note of one more trajectory.

        Args:
            experience: The trajectory.

        Returns:
            Regions to reach, passages or intrinsic rewards to make options for, best first. The first that leads far
            enough from other subgoals is taken. What is proposed again after the next trajectory is considered again.
        """
        ...


class Method:
    """A `DiscoveryMethod` of the library, with what ``Discovery`` asks besides.

    Attributes:
        needs_success: Whether it proposes nothing before a success.
        searches: Whether it searches the database now and then (`is_due`), with filters of its own; otherwise it takes
            note of every trajectory.
        again_after: A subgoal that no option could be learned for may come again after so many times as many
            trajectories.
        leads: What a saved trajectory must do for an option, in words.
        learns_from_failures: Whether a failure may lead to a proposal.
    """

    STATE: ClassVar[tuple[str, ...]] = ()

    needs_success: bool = False
    searches: bool = False
    again_after: float = 2.0
    leads: str = "leads"
    learns_from_failures: bool = True

    def begin(self, settings: DiscoverySettings, filters: Filters, groups: Sequence[FeatureGroup]) -> None:
        """Get what discovery was made with, before the first trajectory."""
        if groups:
            raise ValueError(
                f"{self.name} works on all features together, and the feature map has groups: use diverse density, or "
                "the control 'random'; or, in a script, pass ConceptSettings(groups=()) as concepts."
            )

    def note(self, labelled: LabelledTrajectory) -> None:
        """Note a trajectory when it ends, before any search."""

    def is_due(self, database: TrajectoryDatabase) -> bool:
        """Whether a method that searches has enough new trajectories."""
        return True

    def update(self, experience: Experience) -> Sequence[Proposal]:
        """Propose; as `DiscoveryMethod.update`."""
        raise NotImplementedError

    def seconds(self, experience: Experience) -> float:
        """Nominal seconds of the last update."""
        return 0.0

    def accept(self, goal: Region) -> float:
        """Note that a proposed subgoal is taken, and say the best log diverse density of its search, NaN without."""
        return float("nan")

    def states(self, database: TrajectoryDatabase, filters: Filters) -> list[FloatArray]:
        """States that may be subgoals, of each trajectory that counts, in scaled units."""
        return [filters.known_scale * each.features[filters.may_be_subgoals(each, [])] for each in database]

    def remembered(self) -> FloatArray:
        """Points of concept space that it remembers, (n, d)."""
        return np.zeros((0, 0))

    def embed_again(self, points: FloatArray, database: TrajectoryDatabase) -> None:
        """Go on in another space, in which the `remembered` points are these, and the database has other features."""

    def log_density(self, points: FloatArray) -> FloatArray | None:
        """Log diverse density of points (n, d) in the bags of the last search; None where there is none."""
        return None

    def values(self) -> dict[str, float]:
        """What is logged of it, by tag."""
        return {}

    def n_successes(self, diary: Diary) -> int:
        """Trajectories that count as successes."""
        return diary.successes

    def why_nothing(self, diary: Diary) -> str:
        """Why it proposed nothing, where it might have."""
        for waits_for, n, what in (
            ("min_trajectories", diary.n, ""),
            ("min_successes", diary.successes, "successful "),
        ):
            if n < (least := self._least(waits_for)):
                return f"{self.name} waits for {least} {what}{diary.unit}s ({waits_for}), and {n} have ended."
        return f"{self.name} proposed none that the filters leave."

    def _least(self, waits_for: str) -> int:
        return int(getattr(self, waits_for, 0))

    @property
    def name(self) -> str:
        """Of its class."""
        return type(self).__name__


class OwnMethod(Method):
    """A user's own method, whose proposals are checked.

    Args:
        method: The user's.
    """

    def __init__(self, method: DiscoveryMethod) -> None:
        self.method = method
        self.needs_success = bool(getattr(method, "needs_success", False))
        self._seconds = 0.0

    def update(self, experience: Experience) -> list[Proposal]:
        """Ask the user's method, and check its proposals."""
        began = time.process_time()
        try:
            proposals = self.method.update(experience)
        except ValueError as error:
            raise RuntimeError(f"{self.name}.update failed: {error}") from error
        self._seconds = time.process_time() - began
        if not isinstance(proposals, Sequence) or not all(isinstance(each, PROPOSALS) for each in proposals):
            names = ", ".join(kind.__name__ for kind in PROPOSALS)
            raise TypeError(f"{self.name}.update must return a list of {names}, got {proposals!r:.200}.")
        size = experience.features.shape[1]
        for each in proposals:
            for region in _regions_of(each):
                points, scale = np.shape(region.points), np.shape(region.scale)
                if (len(points), *points[1:], *scale) != (2, size, size) or not points[0]:
                    raise ValueError(
                        f"{self.name} proposed a {type(each).__name__} whose points have shape {points} and whose "
                        f"scale has {scale}; they must be (n, {size}) and ({size},), n ≥ 1, for φ has {size} features."
                    )
        return list(proposals)

    def seconds(self, experience: Experience) -> float:
        """Nominal seconds of the last update: the user's estimate, or as measured."""
        if not hasattr(self.method, "seconds"):
            return self._seconds
        seconds = self.method.seconds(experience)
        if not (is_number(seconds) and 0.0 <= seconds < np.inf):
            raise ValueError(f"{self.name}.seconds must return a finite number of at least 0, got {seconds!r:.200}.")
        return float(seconds)

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        if not (hasattr(self.method, "get_state") and hasattr(self.method, "set_state")):
            raise ValueError(
                f"Checkpoints of discovery by {self.name} are not supported: give it get_state() and set_state(state)."
            )
        state: dict[str, Any] = self.method.get_state()
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self.method.set_state(state)  # type: ignore[attr-defined]  # `get_state` has asked for it

    def _least(self, waits_for: str) -> int:
        return int(getattr(self.method, waits_for, 0))

    @property
    def name(self) -> str:
        """Of the user's class."""
        return type(self.method).__name__


def checked_method(method: Any) -> DiscoveryMethod | None:
    """A method that is no name; None for a name, or for nothing."""
    if method is None or isinstance(method, str):
        return None
    container = isinstance(method, (Mapping, Set))  # which have an update of their own
    if container or isinstance(method, type) or not callable(getattr(method, "update", None)):
        what = f"the class {method.__name__}, which is not made yet" if isinstance(method, type) else repr(method)
        raise TypeError(f"method must be a name, or an object with update(experience), got {what}.")
    made: DiscoveryMethod = method
    return made


def kept(proposal: Proposal, name: str) -> Proposal:
    """A proposal that is taken, of arrays that its method cannot change later on.

    Args:
        proposal: What was proposed.
        name: Of the method.
    """
    for region in _regions_of(proposal):
        if not (np.isfinite(region.points).all() and np.isfinite(region.scale).all() and 0 <= region.radius < np.inf):
            raise ValueError(
                f"{name} proposed a {type(proposal).__name__} with points, scale or radius that are not finite, or a "
                "radius below 0."
            )
    if isinstance(proposal, Passage):
        return Passage(_copied(proposal.subgoal), _copied(proposal.initiation))
    return _copied(proposal)


def _copied(region: Placed) -> Placed:
    """The same with arrays of its own."""
    points, scale = np.array(region.points, dtype=np.float64), np.array(region.scale, dtype=np.float64)
    return replace(region, points=points, scale=scale)


def _regions_of(proposal: Proposal) -> tuple[Region | IntrinsicReward, ...]:
    """What has points in concept space."""
    return (proposal.subgoal, proposal.initiation) if isinstance(proposal, Passage) else (proposal,)
