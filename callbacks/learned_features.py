"""`LearnedFeatures`: a feature map that is learned during training, and options that move with it."""

import copy
from dataclasses import replace

import numpy as np
from scipy.spatial.distance import cdist

from sb3_options.callbacks.installer import OptionInstaller
from sb3_options.discovery.discovery import Discovery, nearest_observations
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.embedding.learner import FIRST_TRAJECTORIES, FeatureLearner
from sb3_options.embedding.settings import EmbeddingSettings
from sb3_options.experience.observations import FloatArray, Observations, take
from sb3_options.options.option import SubgoalOption
from sb3_options.options.settings import OptionLearningSettings


class LearnedFeatures:
    """Learns the feature map of all environments, and keeps subgoals and initiation sets at their observations.

    When the map changes, every environment gets it. The options that were made here get regions around the same
    observations in the new space. Their policies act on observations, and stay as they are. A map that came with
    options stays fixed, because their observations are unknown.
    """

    STATE = ("learner", "_anchors")

    def __init__(self, feature_map: LearnedMap, settings: EmbeddingSettings, seed: int, verbose: int) -> None:
        self.map = feature_map
        self.verbose = verbose
        self.learner = FeatureLearner(feature_map, settings, seed)
        # By slot: observations of the subgoal and of the initiation set, and the present points of that set.
        self._anchors: dict[int, tuple[Observations, Observations, FloatArray]] = {}

    @property
    def ready(self) -> bool:
        """Whether distances mean anything yet."""
        return self.map.learned > 0

    def why_not_ready(self, n: int) -> str | None:
        """Return why nothing can be searched yet after ``n`` trajectories, or None if it can."""
        if self.ready:
            return None
        return (
            f"No subgoal was discovered: the feature map is learned after {FIRST_TRAJECTORIES} trajectories, in "
            f"{self.learner.updates} gradient steps; {n} have ended, {self.learner.done} are done. Train for longer."
        )

    def begin(self, options: OptionInstaller) -> None:
        """Note the options that exist when training starts."""
        options.learned_map = self.map
        options.bank.bind(self.map)
        others = [s for s in options.bank.filled if isinstance(options.bank[s], SubgoalOption)]
        self.map.fixed = any(slot not in self._anchors for slot in others)
        if self.ready:
            options.send_learned_map()

    def learn_if_due(self, search: Discovery, options: OptionInstaller) -> bool:
        """Train the map if that is due, and move the options' regions once it has changed."""
        begins = not self.learner.done
        changed = search.learn_if_due(self.learner)
        if self.verbose and (changed or (begins and self.learner.done)):
            steps = f"{self.learner.updates:,} gradient steps"
            print("The feature map has been learned." if changed else f"The feature map is being learned, in {steps}.")
        if not changed:
            return False
        options.send_learned_map()
        for slot, (subgoal, initiation, _) in list(self._anchors.items()):
            option = options.bank[slot]
            if isinstance(option, SubgoalOption):
                region = option.initiation_set.around(self.map(initiation))
                options.replace(
                    slot, replace(option, subgoal=option.subgoal.around(self.map(subgoal)), initiation_set=region)
                )
                self._anchors[slot] = subgoal, initiation, region.points
        return True

    def remember(self, slot: int, option: SubgoalOption, search: Discovery) -> None:
        """Remember the observations behind an option's regions, which were made from features in the database.

        If an initiation set has only lost points, its observations are known. Their trajectories may have left the
        database. In a map that stays fixed regions never move.
        """
        if self.map.fixed:
            return
        known = self._anchors.get(slot)
        points = option.initiation_set.points
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
        """Forget a closed option."""
        self._anchors.pop(slot, None)


def features_for(
    present: LearnedFeatures | None, options: OptionInstaller, settings: EmbeddingSettings, seed: int, verbose: int
) -> LearnedFeatures | None:
    """Return the `LearnedFeatures` of the environments when training starts, or None if their map is not learned."""
    there: object = options.venv.get_attr("bank", [0])[0].feature_map
    if isinstance(there, LearnedMap) and present is None:
        present = LearnedFeatures(copy.deepcopy(there), settings, seed, verbose)
    if present is not None:
        present.begin(options)
    return present


def check_learned(discovery: DiscoverySettings, option: OptionLearningSettings, *, own: bool) -> None:
    """Refuse settings that need a fixed feature map, such as a method or groups of the user's ``own``."""
    if own or discovery.method != "diverse-density" or option.policy_input == "features":
        raise ValueError(
            "A learned feature map moves while it is learned on. Diverse density moves along; other methods, groups of "
            "features and policy_input='features' need features that stay: pass OptionsWrapper(feature_map=...) a "
            "function."
        )
