"""The interface of discovery methods: experience in, proposals out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.diary import Diary
from sb3_options.discovery.filters import Filters
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory, TrajectoryDatabase

if TYPE_CHECKING:
    from sb3_options.discovery.settings import DiscoverySettings


@dataclass(eq=False)
class Experience:
    """The newest trajectory, and the database it is in, as methods see them.

    Args:
        labelled: The trajectory.
        may_be_subgoals: Computes which of its states may be subgoals, (m,), when that is first asked for.
        scale: Factor for every feature that makes one unit one step, (d,).
        radius: Of a subgoal, in scaled units.
        taken: Subgoals that have an option.
        avoided: Subgoals that a search of the database leaves out: those taken, and those for which no option could be
            learned.
        database: The last trajectories.

    Attributes:
        trajectory: The trajectory, with its actions, rewards and observations.
        features: φ of its distinct observations, in order of first visit, (m, d), read-only.
        visits: Row of ``features`` at every time t = 0 … T, (T + 1,), read-only.
        success: Whether it was successful.
    """

    labelled: LabelledTrajectory
    may_be_subgoals: Callable[[], BoolArray]
    scale: FloatArray
    radius: float
    taken: Sequence[Region] = ()
    avoided: Sequence[Region] = ()
    database: TrajectoryDatabase = field(default_factory=lambda: TrajectoryDatabase(1))

    def __post_init__(self) -> None:
        """Show the trajectory, read-only."""
        self.trajectory: Trajectory = self.labelled.trajectory
        self.features = self.labelled.features.view()
        self.visits = self.trajectory.visits.view()
        self.features.flags.writeable = self.visits.flags.writeable = False
        self.success = self.labelled.success

    @cached_property
    def allowed(self) -> BoolArray:
        """Which of its states may be subgoals, (m,): the static filter allows them, and no subgoal is near."""
        return self.may_be_subgoals()

    @cached_property
    def places(self) -> Places:
        """Its states, binned at one unit of concept space: states that differ by less are one place."""
        bins = np.rint(self.features * self.scale) + 0.0  # -0.0 and 0.0 are one bin, but not the same bytes
        _, first, which = np.unique(bins, axis=0, return_index=True, return_inverse=True)
        which = which.ravel()
        allowed = np.ones(len(first), dtype=bool)
        allowed[which[~self.allowed]] = False
        return Places(self.features[first], bins[first], which[self.visits], allowed)

    def region(self, point: ArrayLike) -> Region:
        """The region around a place, (d,)."""
        return Region(np.array(point, dtype=np.float64)[None], self.scale, self.radius)


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

    Any object with this method may be passed as ``SubgoalDiscoveryCallback(method=…)``. For a checkpoint it must be a
    dataclass, or have ``get_state()``, which gives a dictionary of arrays and plain values, and ``set_state(state)``.
    The budget also needs ``seconds(experience)``: how long an update takes, estimated by sizes and not by the clock.
    Without it updates are measured, and two trainings with one seed may differ. ``needs_success = True`` says that a
    method proposes nothing before a success; where none succeeds, that is the reason that users read.
    """

    def update(self, experience: Experience) -> Sequence[Region]:
        """Take note of one more trajectory.

        Args:
            experience: The trajectory.

        Returns:
            Regions to reach, best first. The first that is far enough from other subgoals is taken. What is proposed
            again after the next trajectory is considered again.
        """
        ...


class Method(DiscoveryMethod):
    """A `DiscoveryMethod` of the library, with what ``Discovery`` asks besides.

    Attributes:
        needs_success: Whether it proposes nothing before a success.
        searches: Whether it searches the database now and then (`is_due`), with filters of its own; otherwise it takes
            note of every trajectory.
        again_after: A subgoal that no option could be learned for may come again after so many times as many
            trajectories.
        learns_from_failures: Whether a failure may lead to a proposal.
        min_successes: Successful trajectories that it waits for.
    """

    STATE: ClassVar[tuple[str, ...]] = ()

    needs_success: bool = False
    searches: bool = False
    again_after: float = 2.0
    learns_from_failures: bool = True
    min_successes: int = 0
    _cost: float = 0.0

    def begin(self, settings: DiscoverySettings, filters: Filters, groups: Sequence[FeatureGroup]) -> None:
        """Get what discovery was made with, before the first trajectory."""
        if groups:
            raise ValueError(
                f"{self.name} works on all features together, and the feature map has groups: use diverse density, or, "
                "in a script, pass ConceptSettings(groups=()) as concepts."
            )

    def note(self, labelled: LabelledTrajectory) -> None:
        """Note a trajectory when it ends, before any search."""

    def is_due(self, database: TrajectoryDatabase) -> bool:
        """Whether a method that searches has enough new trajectories."""
        return True

    def seconds(self, experience: Experience) -> float:
        """Nominal seconds of the last update."""
        return self._cost

    def accept(self, goal: Region) -> float:
        """Note that a proposed subgoal is taken, and say the best log diverse density of its search, NaN without."""
        return float("nan")

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
        if diary.successes < self.min_successes:
            return (
                f"{self.name} waits for {self.min_successes} successful {diary.unit}s (min_successes), and "
                f"{diary.successes} have ended."
            )
        return f"{self.name} proposed none that the filters leave."

    @property
    def name(self) -> str:
        """Of its class."""
        return type(self).__name__


class OwnMethod(Method):
    """A user's own method, whose proposals are checked and copied, so that it cannot change them later."""

    STATE = ("method",)

    def __init__(self, method: DiscoveryMethod) -> None:
        self.method = method
        self.needs_success = bool(getattr(method, "needs_success", False))
        self.min_successes = int(getattr(method, "min_successes", 0))

    def update(self, experience: Experience) -> list[Region]:
        """Ask the user's method, and check its proposals."""
        began = time.process_time()
        try:
            proposals = self.method.update(experience)
        except ValueError as error:
            raise RuntimeError(f"{self.name}.update failed: {error}") from error
        self._cost = time.process_time() - began
        if not (isinstance(proposals, Sequence) and all(isinstance(each, Region) for each in proposals)):
            raise TypeError(f"{self.name}.update must return a list of Region, got {proposals!r:.200}.")
        return [self._checked(each, experience.features.shape[1]) for each in proposals]

    def _checked(self, region: Region, size: int) -> Region:
        """A proposal with arrays of its own."""
        points, scale = np.array(region.points, dtype=np.float64), np.array(region.scale, dtype=np.float64)
        fits = points.ndim == 2 and points.shape[1:] == scale.shape == (size,) and len(points) > 0
        if not (fits and np.isfinite(points).all() and np.isfinite(scale).all() and 0 <= region.radius < np.inf):
            raise ValueError(
                f"{self.name} proposed a region with points of shape {points.shape}, a scale of shape {scale.shape} "
                f"and radius {region.radius!r}; expected finite numbers of shapes (n, {size}) and ({size},), n ≥ 1, "
                f"and a radius of at least 0: φ has {size} features."
            )
        return replace(region, points=points, scale=scale)

    def seconds(self, experience: Experience) -> float:
        """Nominal seconds of the last update: the user's estimate, or as measured."""
        if not hasattr(self.method, "seconds"):
            return self._cost
        return float(self.method.seconds(experience))

    @property
    def name(self) -> str:
        """Of the user's class."""
        return type(self.method).__name__


def checked_method(method: Any) -> DiscoveryMethod | None:
    """A method that is no name; None for a name, or for nothing."""
    if method is None or isinstance(method, str):
        return None
    if isinstance(method, type) or not callable(getattr(method, "update", None)):
        raise TypeError(f"method must be a name, or an object with update(experience), got {method!r}.")
    return cast("DiscoveryMethod", method)
