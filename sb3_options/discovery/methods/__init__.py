"""Methods of discovery beside diverse density: from one trajectory after the other to proposals. Pure."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

from sb3_options.discovery.methods.graphs import Betweenness, LCut
from sb3_options.discovery.methods.method import DiscoveryMethod, Experience, Proposal
from sb3_options.discovery.methods.relative_novelty import RelativeNovelty
from sb3_options.discovery.methods.visits import RandomPlaces, VisitFrequency

MethodName = Literal[
    "diverse-density", "first-visits", "every-visit", "relative-novelty", "l-cut", "betweenness", "random"
]

METHODS: dict[MethodName, Callable[[], DiscoveryMethod]] = {
    "first-visits": VisitFrequency,
    "every-visit": partial(VisitFrequency, "every"),
    "relative-novelty": RelativeNovelty,
    "l-cut": LCut,
    "betweenness": Betweenness,
    "random": RandomPlaces,
}
"""Makes a method, by its name. Diverse density is `SubgoalDiscovery` itself."""

__all__ = ["METHODS", "DiscoveryMethod", "Experience", "MethodName", "Proposal"]
