"""Discovery in a concept space that is learned: it moves each time it is learned on, with all that is in it."""

from __future__ import annotations

from sb3_options.discovery.subgoals import SubgoalDiscovery
from sb3_options.embedding.learner import FeatureLearner


def learn_if_due(learner: FeatureLearner, discovery: SubgoalDiscovery) -> bool:
    """Learn the feature map from the saved trajectories when there are enough of them, and take discovery along.

    Args:
        learner: Of the feature map by which all features in ``discovery`` were made.
        discovery: Its trajectories have features of the learned map afterwards.

    Returns:
        Whether the map has changed.
    """
    n = discovery.outcomes.n
    trajectories = [labelled.trajectory for labelled in discovery.database]
    if learner.map.fixed or not learner.is_due(n) or not learner.can_learn(trajectories):
        return False
    learner.learn(trajectories, n)
    discovery.embed_again(learner.map)
    return True
