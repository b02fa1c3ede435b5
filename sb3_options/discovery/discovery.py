"""Discovery: trajectories in, subgoals out (McGovern & Barto 2001, Table 1)."""

import logging
import time
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.budget import nominal_seconds
from sb3_options.discovery.diary import Diary
from sb3_options.discovery.filters import Filters
from sb3_options.discovery.methods import DiscoveryMethod, Experience, Method, method_with
from sb3_options.discovery.salience import OutcomeDatabase, Salience
from sb3_options.discovery.settings import DiscoverySettings, described
from sb3_options.discovery.static_filter import StaticFilter
from sb3_options.embedding.learner import FeatureLearner
from sb3_options.experience.observations import FeatureMap, FloatArray, Observations, batch_size, concatenate, take
from sb3_options.experience.success import SuccessRule, reported_success
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory, TrajectoryDatabase
from sb3_options.state import storable

logger = logging.getLogger("sb3_options")

MAX_BYTES = 1 << 30  # of a database: with large observations it keeps fewer than `capacity` trajectories


@storable
class FoundSubgoal(NamedTuple):
    """A discovered subgoal.

    Attributes:
        subgoal: Its region in concept space.
        log_density: Best log diverse density of the search that completed it; NaN if another method found it.
        observation: The nearest observation, a batch of one; None for a feature group, or without a place.
    """

    subgoal: Region
    log_density: float
    observation: Observations | None = None

    @property
    def centre(self) -> FloatArray:
        """The centre of the subgoal in its own features, (d,)."""
        return np.asarray(self.subgoal.points[0])

    def where(self, kind: str | None) -> str:
        """Describe the subgoal for people; ``kind`` says where φ comes from."""
        return described(self.centre, kind, self.subgoal.group)


class Discovery:
    """Finds subgoals in a database of trajectories, by one method.

    All methods share the filters, the spacing and the budget. The `diary` says why nothing was found.

    Args:
        settings: Settings of discovery.
        method: Method that proposes subgoals; by default the one named in the settings.
        success: Rule that decides which trajectories succeed; by default the environment reports it.
        static_filter: Which states may be subgoals; by default those far from start and goal.
        kind: Where φ comes from, for `default_scale`.
        groups: Groups of features; empty if all features count together.
        taken: Subgoals that already have an option, besides those `found`.
        seed: Seed of a method that draws at random.

    Attributes:
        database: The last trajectories.
        found: Subgoals found and not withdrawn, oldest first.

    Raises:
        TypeError: ``method`` is not a discovery method.
        ValueError: The method needs all features together, but there are groups.
    """

    STATE = ("database", "filters", "diary", "method", "found", "_n_new", "_proposals", "_withdrawn", "taken")

    def __init__(
        self,
        settings: DiscoverySettings | None = None,
        method: DiscoveryMethod | None = None,
        *,
        success: SuccessRule = reported_success,
        static_filter: StaticFilter | None = None,
        kind: str | None = None,
        groups: Iterable[FeatureGroup] = (),
        taken: Sequence[Region] = (),
        seed: int = 0,
    ) -> None:
        self.settings = s = DiscoverySettings() if settings is None else settings
        self.success = success
        self.groups = tuple(groups)
        self.filters = Filters(s, static_filter, kind)
        self.method: Method = method_with(s.method, method, grouped=bool(self.groups), seed=seed)
        self.method.begin(s, self.filters, self.groups)
        self.taken = [region for region in taken if self.groups or region.group is None]
        self.database: TrajectoryDatabase = TrajectoryDatabase(s.capacity, MAX_BYTES)
        if self.groups:
            salience = Salience(self.groups, s.salient_share, s.min_positive)
            self.database = OutcomeDatabase(s.capacity, MAX_BYTES, salience)
        elif s.salient_share:
            logger.warning(
                "salient_share=%g has no effect: it is for groups of features, and there are none.", s.salient_share
            )
        self.diary = Diary(
            unit="episode" if s.segmentation == "episodes" else "segment",
            max_share=s.max_share,
            needs_success=self.method.needs_success and not (self.groups and s.salient_share),
        )
        self.found: list[FoundSubgoal] = []
        self._n_new = 0  # trajectories not yet shown to a method that notes each one
        self._proposals: list[Region] = []
        self._withdrawn: list[tuple[Region, int]] = []  # with the number of trajectories by then

    @property
    def scale(self) -> FloatArray | None:
        """Factor for every feature, (d,); None before the first search, or if each group has its own."""
        return self.filters.scale

    @property
    def kind(self) -> str | None:
        """Where φ comes from; ``categorical`` once experience shows one-hot codes, which have no distances."""
        return self.filters.kind

    def add(self, trajectory: Trajectory, features: FloatArray, *, success: bool | None = None) -> LabelledTrajectory:
        """Add a trajectory to the database, and return it labelled.

        Args:
            trajectory: One episode.
            features: φ of its distinct observations, shape (m, d).
            success: Its label; by default the success rule decides.

        Raises:
            ValueError: ``features`` do not fit the trajectory; features or rewards are not finite.
        """
        features = np.require(features, np.float64, "O")  # a view would keep its base alive
        n_states = batch_size(trajectory.states)
        if features.ndim != 2 or len(features) != n_states:
            raise ValueError(
                f"features must have shape (m, d), one row for each of the trajectory's {n_states} distinct "
                f"observations, got {features.shape}"
            )
        if not (np.isfinite(features).all() and np.isfinite(trajectory.rewards).all()):
            raise ValueError(
                "a trajectory has rewards, features or observations that are NaN or infinite; OptionsWrapper(..., "
                "check_finite=True) shows where"
            )
        said = self.success(trajectory) if success is None else success
        labelled = LabelledTrajectory(trajectory, features, bool(said))
        self.diary.add(trajectory, success=labelled.success)
        self.database.add(labelled)
        self.method.note(labelled)
        self._n_new += 1
        return labelled

    def search(self) -> Region | None:
        """Let the method propose, if it is due and the budget affords it. Return a new subgoal, now taken, or None."""
        if not (len(self.database) and self.method.is_due(self.database)):
            return None
        affords = self.diary.affords()
        if not (self.method.searches or self._knows_scale()):
            return None
        if not affords:
            self._n_new = 0  # the method never sees trajectories that the budget does not afford
            return None
        began = time.process_time()  # only here: this call costs more than finding nothing to do
        subgoal = self._search()
        self.diary.seconds += time.process_time() - began
        return subgoal

    def _search(self) -> Region | None:
        if self.method.searches:
            self._proposals = self._updated(self.experience([*self.database][-1]))
            return self._take()
        proposals: list[Region] = []
        self._n_new = min(self._n_new, len(self.database))
        while self._n_new:
            experience = self.experience([*self.database][-self._n_new])
            self._n_new -= 1  # a trajectory that the method fails on does not come again
            proposals = [*self._updated(experience), *proposals]
            n_steps, n_numbers = len(experience.visits) - 1, experience.features.size
            self.diary.spent += nominal_seconds(telling=1, step=n_steps, feature=n_numbers)
            self._proposals = proposals
        return self._take()

    def _updated(self, experience: Experience) -> list[Region]:
        proposals = list(self.method.update(experience))
        self.diary.spent += self.method.seconds(experience)
        return proposals

    def _take(self) -> Region | None:
        """Take the best proposal that is far enough from other subgoals."""
        known = [*self.taken, *(found.subgoal for found in self.found)]
        for goal in self._proposals:
            apart = self.method.searches or self.filters.is_apart(goal, known, self.database)
            if apart and not self._waits(goal):
                self._proposals = []
                # A learned φ moves subgoals by their observation, and has no groups, whose points have own features.
                observation = None if goal.group is not None else nearest_observations(goal.points[:1], self.database)
                self.found.append(FoundSubgoal(goal, self.method.accept(goal), observation))
                return goal
        return None

    def withdraw(self) -> None:
        """Withdraw the last subgoal, for which no option can be learned. It may be proposed again later."""
        self.diary.n_withdrawn += 1
        goal = self.found.pop().subgoal
        self._withdrawn = [each for each in self._withdrawn if not np.array_equal(each[0].points, goal.points)]
        self._withdrawn.append((goal, self.diary.n))

    def experience(self, labelled: LabelledTrajectory) -> Experience:
        """Return a trajectory as the method sees it."""
        taken = [*self.taken, *(found.subgoal for found in self.found)]
        avoided = [*taken, *(self._waiting() if self.method.searches else ())]
        scale = self.filters.scale
        return Experience(
            labelled,
            lambda: self.filters.may_be_subgoals(labelled, avoided),
            np.ones(labelled.features.shape[1]) if scale is None else scale,
            self.settings.subgoal_radius,
            taken=taken,
            avoided=avoided,
            database=self.database,
        )

    def _knows_scale(self) -> bool:
        """Whether the scale is known. Setting it from feature ranges takes `min_positive` trajectories."""
        if self.kind != "identity" or self.diary.n >= self.settings.min_positive:
            self.filters.find_scale(self.database)
        return self.scale is not None

    def _waiting(self) -> list[Region]:
        """Return the withdrawn subgoals that may not come again yet."""
        return [region for region, at in self._withdrawn if self.diary.n < self.method.again_after * at]

    def _waits(self, goal: Region) -> bool:
        same_space = (region for region in self._waiting() if region.group == goal.group)
        return any(region.covers(goal.points[:1]).any() for region in same_space)

    def why_nothing(self, n_episodes: int | None = None) -> str:
        """Say why there is no option; if there are some, say how many subgoals have one.

        ``n_episodes`` includes unusable trajectories; by default all were usable.
        """
        return self.diary.why_nothing(self.method, len(self.found), self.diary.n if n_episodes is None else n_episodes)

    def learn_if_due(self, learner: FeatureLearner) -> bool:
        """Train the feature map further if it is due. Return whether it has changed."""
        n, n_steps = self.diary.n, self.diary.steps
        due = not learner.map.fixed and learner.is_due(n, n_steps)
        changed = due and learner.learn([labelled.trajectory for labelled in self.database], n, n_steps)
        if changed:
            self.embed_again(learner.map)
        return changed

    def embed_again(self, feature_map: FeatureMap) -> None:
        """Continue in the space of another feature map, with the same number of features.

        Subgoals stay at their observations, running averages at the observations nearest to their peaks. Earlier
        searches are forgotten, because distances have changed.
        """
        points = self.method.remembered()
        places = feature_map(nearest_observations(points, self.database)) if len(points) else points
        self.database.embed_again(feature_map)
        for i, found in enumerate(self.found):
            if found.observation is not None:
                self.found[i] = found._replace(subgoal=found.subgoal.around(feature_map(found.observation)))
        self.method.embed_again(places, self.database)


def nearest_observations(points: FloatArray, trajectories: Iterable[LabelledTrajectory]) -> Observations:
    """Return for each point of concept space the observation with the nearest features."""
    least = np.full(len(points), np.inf)
    nearest: list[Observations | None] = [None] * len(points)
    for labelled in trajectories:
        distances = cdist(points, labelled.features)
        rows = distances.argmin(axis=1)
        for i in np.flatnonzero(distances.min(axis=1) < least):
            least[i] = distances[i, rows[i]]
            nearest[i] = take(labelled.trajectory.states, rows[i : i + 1])
    return concatenate([each for each in nearest if each is not None])
