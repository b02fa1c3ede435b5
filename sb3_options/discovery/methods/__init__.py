"""Methods of discovery beside diverse density: from one trajectory after the other to proposals. Pure."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

from sb3_options.density.regions import Region
from sb3_options.discovery.methods.covering import CoveringOptions
from sb3_options.discovery.methods.eigenoptions import Eigenoptions
from sb3_options.discovery.methods.graphs import Betweenness, LCut
from sb3_options.discovery.methods.method import (
    DiscoveryMethod,
    Experience,
    IntrinsicReward,
    Passage,
    Proposal,
    checked_method,
    proposed_by,
)
from sb3_options.discovery.methods.relative_novelty import RelativeNovelty
from sb3_options.discovery.methods.visits import GivenPlaces, RandomPlaces, VisitFrequency

MethodName = Literal[
    "diverse-density",
    "first-visits",
    "every-visit",
    "relative-novelty",
    "l-cut",
    "betweenness",
    "eigenoptions",
    "covering",
    "random",
]
"""Names of the methods of discovery."""

METHODS: dict[MethodName, Callable[..., DiscoveryMethod]] = {
    "first-visits": VisitFrequency,
    "every-visit": partial(VisitFrequency, "every"),
    "relative-novelty": RelativeNovelty,
    "l-cut": LCut,
    "betweenness": Betweenness,
    "eigenoptions": Eigenoptions,
    "covering": CoveringOptions,
    "random": RandomPlaces,
}
"""Makes a method, by its name. Diverse density is `SubgoalDiscovery` itself."""

CONTROLS: frozenset[MethodName] = frozenset({"random"})
"""Those that draw at random."""


def method_named(name: MethodName, seed: int = 0) -> DiscoveryMethod:
    """A method of `METHODS` with its defaults; ``seed`` is for the controls."""
    return METHODS[name](seed=seed) if name in CONTROLS else METHODS[name]()


__all__ = [
    "CONTROLS",
    "METHODS",
    "DiscoveryMethod",
    "Experience",
    "GivenPlaces",
    "IntrinsicReward",
    "MethodName",
    "Passage",
    "Proposal",
    "Region",
    "checked_method",
    "method_named",
    "proposed_by",
]
