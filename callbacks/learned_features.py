"""`LearnedFeatures`: a feature map that is learned while a model trains, and options that move along with it."""

from __future__ import annotations

import copy
import time
from typing import ClassVar

import numpy as np
from scipy.spatial.distance import cdist

from sb3_options.callbacks.installer import OptionInstaller
from sb3_options.discovery.anchors import moved, nearest_observations
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.embedding.learner import FIRST_TRAJECTORIES, FeatureLearner
from sb3_options.embedding.settings import EmbeddingSettings
from sb3_options.experience.observations import FloatArray, Observations, take
from sb3_options.options.option import SubgoalOption
from sb3_options.options.settings import OptionLearningSettings


class GivenFeatures:
    """A feature map that is as it is: nothing is to be done."""

    STATE: ClassVar[tuple[str, ...]] = ()
    ready = True

    def begin(self, options: OptionInstaller) -> None:
        """Training starts."""

    def learn_if_due(self, search: Discovery, options: OptionInstaller) -> bool:
        """Whether the map has changed."""
        del search, options
        return False

    def why_not_ready(self, n: int) -> str | None:
        """Why nothing is searched yet after ``n`` trajectories, in a sentence."""
        del n
        return None

    def values(self) -> dict[str, float]:
        """What is logged of it, by tag."""
        return {}

    def remember(self, slot: int, option: SubgoalOption, search: Discovery) -> None:
        """An option was made."""

    def forget(self, slot: int) -> None:
        """An option is closed."""

    def resume(self, options: OptionInstaller) -> None:
        """Its state was restored."""


class LearnedFeatures(GivenFeatures):
    """Learns the feature map of all environments, and keeps subgoals and initiation sets at their observations.

    The map is learned here, from the trajectories of discovery. Each time it has changed, every environment gets it,
    and the options that were made here get the regions around the same observations in the new space. Their policies
    act on observations, and stay as they are. A map that came with options stays as it is: of those the observations
    are not known.

    Args:
        feature_map: Of the environments, before it is learned.
        settings: How it is learned.
        seed: Of the learner.
    """

    STATE = ("learner", "_anchors")

    def __init__(self, feature_map: LearnedMap, settings: EmbeddingSettings, seed: int) -> None:
        self.map = feature_map
        self.learner = FeatureLearner(feature_map, settings, seed)
        self._seconds = 0.0
        # By slot the observations of subgoal and initiation set, and the points of that set that they have now.
        self._anchors: dict[int, tuple[Observations, Observations, FloatArray]] = {}

    @property
    def ready(self) -> bool:  # type: ignore[override]  # which may change, and is not set from outside
        """Whether distances mean anything yet."""
        return self.map.learned > 0

    def why_not_ready(self, n: int) -> str | None:
        """Why nothing is searched yet after ``n`` trajectories, in a sentence; None where something is."""
        least = FIRST_TRAJECTORIES
        if self.ready or n >= least:
            return None
        return (
            f"No subgoal was discovered: the feature map is learned after {least} trajectories, and {n} have ended. "
            "Train for longer."
        )

    def values(self) -> dict[str, float]:
        """How long learning the map took in this training, by the clock."""
        return {"discovery/map_seconds": self._seconds}

    def begin(self, options: OptionInstaller) -> None:
        """Take note of the options that are there when training starts."""
        options.learned_map = options.bank.feature_map = self.map
        others = [s for s in options.bank.filled if isinstance(options.bank[s], SubgoalOption)]
        self.map.fixed = any(slot not in self._anchors for slot in others)
        if self.ready:
            options.send_learned_map()

    def learn_if_due(self, search: Discovery, options: OptionInstaller) -> bool:
        """Learn the map when there are enough new trajectories, and move everything along.

        Returns:
            Whether the map has changed, and with it the features of all trajectories.
        """
        began = time.perf_counter()
        changed = search.learn_if_due(self.learner)
        self._seconds += time.perf_counter() - began
        if not changed:
            return False
        options.send_learned_map()
        for slot, (subgoal, initiation, _) in list(self._anchors.items()):
            option = options.bank[slot]
            if isinstance(option, SubgoalOption):
                region = moved(option.initiation_set, initiation, self.map)
                options.replace(slot, option.with_regions(moved(option.subgoal, subgoal, self.map), region))
                self._anchors[slot] = subgoal, initiation, region.points
        return True

    def remember(self, slot: int, option: SubgoalOption, search: Discovery) -> None:
        """Take note of the observations behind an option's regions.

        They were made of features in the database. Where an initiation set has only lost points, its observations are
        those that are known: their trajectories may have left the database.
        """
        known, points = self._anchors.get(slot), option.initiation_set.points
        if known is None:
            subgoal = nearest_observations(option.subgoal.points, search.database)
            self._anchors[slot] = subgoal, nearest_observations(points, search.database), points
            return
        subgoal, initiation, before = known
        if np.array_equal(before, points):
            return  # an option that has learned further
        left = {point.tobytes() for point in points}
        still = np.array([point.tobytes() in left for point in before], dtype=bool)
        if still.sum() == len(left):
            nearest = cdist(self.map(initiation), before).argmin(axis=1)
            initiation = take(initiation, np.flatnonzero(still[nearest]))
        else:
            initiation = nearest_observations(points, search.database)
        self._anchors[slot] = subgoal, initiation, points

    def forget(self, slot: int) -> None:
        """An option is closed."""
        self._anchors.pop(slot, None)

    def resume(self, options: OptionInstaller) -> None:
        """Its state was restored: every environment gets the map."""
        options.send_learned_map()


def features_for(
    present: GivenFeatures, options: OptionInstaller, settings: EmbeddingSettings, seed: int
) -> GivenFeatures:
    """What looks after the feature map of the environments, when training starts.

    Args:
        present: What did so in an earlier training.
        options: Of the environments.
        settings: How a map is learned.
        seed: Likewise.
    """
    there: object = options.venv.get_attr("bank", [0])[0].feature_map
    if isinstance(there, LearnedMap) and not isinstance(present, LearnedFeatures):
        present = LearnedFeatures(copy.deepcopy(there), settings, seed)
    present.begin(options)
    return present


def check_learned(
    features: GivenFeatures, discovery: DiscoverySettings, option: OptionLearningSettings, *, own: bool
) -> None:
    """Refuse what does not go together with a space that moves.

    Args:
        features: Of the environments.
        discovery: Settings.
        option: Settings.
        own: Whether there is a method of the user's own, or groups of features.

    Raises:
        ValueError: Policies act on features, or discovery remembers places or groups of features.
    """
    if not isinstance(features, LearnedFeatures):
        return
    if option.policy_input == "features":
        raise ValueError(
            "A learned feature map moves while it is learned on, and policies on features would not move along: leave "
            "policy_input at 'observation'."
        )
    if own or discovery.method != "diverse-density":
        raise ValueError(
            "A learned feature map moves while it is learned on. Diverse density moves along; other methods "
            "and groups of features need features that stay: pass OptionsWrapper(feature_map=...) a function."
        )
