"""Settings of `SubgoalDiscoveryCallback` that belong together."""

from dataclasses import field
from typing import Annotated

from sb3_options.checked import Field, settings
from sb3_options.density.groups import FeatureGroup
from sb3_options.discovery.static_filter import StaticFilter
from sb3_options.embedding.settings import EmbeddingSettings


@settings
class OptionUse:
    """How an algorithm uses options.

    Attributes:
        max_option_exploration: Largest share of all options among the random choices of DQN, QRDQN and OptionDQN. With
            MaskablePPO it is the first option's initial probability where primitives are equally likely. The k-th
            option available in the same states gets 1/k of those odds. So it does not cap all options together:
            three at 0.5 start with a joint 0.65.
        primitive_rollouts: Whether ``n_steps`` of an on-policy algorithm counts primitive steps, not decisions.
    """

    max_option_exploration: Annotated[float, Field(ge=0, le=1)] = 0.5
    primitive_rollouts: bool = False


@settings
class ConceptSettings:
    """The space in which subgoals are searched.

    Attributes:
        groups: Groups of features that make a concept together, each a `FeatureGroup` or a mapping of its fields. None
            takes the groups that the environment or φ names. Without groups, all features make one concept.
        static_filter: Function for states that may be subgoals: from the features of a trajectory's states (m, d) and
            of its first and last state, (d,) each, to (m,) truth values. None leaves out states near its start and end.
        embedding: How a map is learned, for environments in ``OptionsWrapper(feature_map="temporal-distance")``: an
            `EmbeddingSettings`, or a mapping of its fields.
    """

    groups: tuple[FeatureGroup, ...] | None = None
    static_filter: StaticFilter | None = None
    embedding: EmbeddingSettings = field(default_factory=EmbeddingSettings)
