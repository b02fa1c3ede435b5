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
    """The newest trajectory and its database, as methods see them.

    Args:
        labelled: The trajectory.
        may_be_subgoals: Computes, on first use, which of its states may be subgoals, (m,).
        scale: Factor for every feature that makes one unit one step, (d,).
        radius: Radius of a subgoal, in scaled units.
        taken: Subgoals that have an option.
        avoided: Subgoals that a search leaves out: those taken, and those for which no option could be learned.
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
        """Expose the trajectory, read-only."""
        self.trajectory: Trajectory = self.labelled.trajectory
        self.features = self.labelled.features.view()
        self.visits = self.trajectory.visits.view()
        self.features.flags.writeable = self.visits.flags.writeable = False
        self.success = self.labelled.success

    @cached_property
    def allowed(self) -> BoolArray:
        """Which states may be subgoals, (m,): they pass the static filter, and no subgoal is near."""
        return self.may_be_subgoals()

    @cached_property
    def places(self) -> Places:
        """The states binned at one unit of concept space: states in one bin are one place."""
        bins = np.rint(self.features * self.scale) + 0.0  # -0.0 and 0.0 are one bin, but not the same bytes
        _, first, which = np.unique(bins, axis=0, return_index=True, return_inverse=True)
        which = which.ravel()
        allowed = np.ones(len(first), dtype=bool)
        allowed[which[~self.allowed]] = False
        return Places(self.features[first], bins[first], which[self.visits], allowed)

    def region(self, point: ArrayLike) -> Region:
        """Return the region around a place, (d,)."""
        return Region(np.array(point, dtype=np.float64)[None], self.scale, self.radius)


class Places(NamedTuple):
    """The distinct places of a trajectory.

    Attributes:
        points: One state of each place, (k, d).
        bins: Bin of each place, whole numbers, (k, d).
        visits: Row of ``points`` at every time, (T + 1,).
        allowed: Whether all states of a place may be subgoals, (k,).
    """

    points: FloatArray
    bins: FloatArray
    visits: IntArray
    allowed: BoolArray


class DiscoveryMethod(Protocol):
    """Proposes subgoals from the agent's experience only.

    Any object with this method may be passed as ``SubgoalDiscoveryCallback(method=…)``. To be saved in a checkpoint, it
    must be a dataclass, or have ``get_state()`` and ``set_state(state)``. The state is a dictionary of arrays and plain
    values. The budget also needs ``seconds(experience)``, the time of an update, estimated from sizes and not by the
    clock. Without it updates are timed, and two trainings with one seed may differ. ``needs_success = True`` says that
    the method proposes nothing before a success. If nothing succeeds, users are told this reason.
    """

    def update(self, experience: Experience) -> Sequence[Region]:
        """Take note of one more trajectory. Return regions to reach, best first.

        The first one far enough from other subgoals is taken. A region may be proposed again after the next trajectory.
        """
        ...


class Method(DiscoveryMethod):
    """A `DiscoveryMethod` of the library, with the further interface that ``Discovery`` uses.

    Attributes:
        needs_success: Whether it proposes nothing before a success.
        searches: Whether it searches the database now and then (`is_due`), with its own filters; otherwise it notes
            every trajectory.
        again_after: A withdrawn subgoal may come again once the number of trajectories has grown by this factor.
        learns_from_failures: Whether a failure may lead to a proposal.
        min_successes: Number of successful trajectories that it waits for.
    """

    STATE: ClassVar[tuple[str, ...]] = ()

    needs_success: bool = False
    searches: bool = False
    again_after: float = 2.0
    learns_from_failures: bool = True
    min_successes: int = 0
    _cost: float = 0.0

    def begin(self, settings: DiscoverySettings, filters: Filters, groups: Sequence[FeatureGroup]) -> None:
        """Receive the settings of discovery, before the first trajectory."""
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
        """Return the nominal seconds of the last update."""
        return self._cost

    def accept(self, goal: Region) -> float:
        """Note that a proposal is taken. Return the best log diverse density of its search, or NaN."""
        return float("nan")

    def remembered(self) -> FloatArray:
        """Return the remembered points of concept space, (n, d)."""
        return np.zeros((0, 0))

    def embed_again(self, points: FloatArray, database: TrajectoryDatabase) -> None:
        """Continue in another space: ``points`` replace the `remembered` ones, and the database has new features."""

    def log_density(self, points: FloatArray) -> FloatArray | None:
        """Return the log diverse density of points (n, d) in the bags of the last search, or None."""
        return None

    def values(self) -> dict[str, float]:
        """Return the values to log, by tag."""
        return {}

    def n_successes(self, diary: Diary) -> int:
        """Count the trajectories that count as successes."""
        return diary.successes

    def why_nothing(self, diary: Diary) -> str:
        """Say why it proposed nothing."""
        if diary.successes < self.min_successes:
            return (
                f"{self.name} waits for {self.min_successes} successful {diary.unit}s (min_successes), and "
                f"{diary.successes} have ended."
            )
        return f"{self.name} proposed none that the filters leave."

    @property
    def name(self) -> str:
        """Name of the class."""
        return type(self).__name__


class OwnMethod(Method):
    """A user's own method. Its proposals are checked, and copied so that it cannot change them later."""

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
        """Check a proposal, and return it with arrays of its own."""
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
        """Return the seconds of the last update: the user's estimate, or else the measured time."""
        if not hasattr(self.method, "seconds"):
            return self._cost
        return float(self.method.seconds(experience))

    @property
    def name(self) -> str:
        """Name of the user's class."""
        return type(self.method).__name__


def checked_method(method: Any) -> DiscoveryMethod | None:
    """Return a method object after a check; None for a name or for None."""
    if method is None or isinstance(method, str):
        return None
    if isinstance(method, type) or not callable(getattr(method, "update", None)):
        raise TypeError(f"method must be a name, or an object with update(experience), got {method!r}.")
    return cast("DiscoveryMethod", method)
