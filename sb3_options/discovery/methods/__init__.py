"""Methods of discovery: from trajectories to proposals. Pure."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from sb3_options.density.regions import Region
from sb3_options.discovery.methods.diverse_density import PersistentPeaks
from sb3_options.discovery.methods.graphs import Betweenness, LCut
from sb3_options.discovery.methods.grouped import GroupedPeaks, RandomGrouped
from sb3_options.discovery.methods.method import (
    DiscoveryMethod,
    Experience,
    Method,
    OwnMethod,
    checked_method,
)
from sb3_options.discovery.methods.relative_novelty import RelativeNovelty
from sb3_options.discovery.methods.visits import GivenPlaces, RandomPlaces, VisitFrequency
from sb3_options.discovery.settings import MethodName

METHODS: dict[MethodName, Callable[..., Method]] = {
    "first-visits": VisitFrequency,
    "every-visit": partial(VisitFrequency, "every"),
    "relative-novelty": RelativeNovelty,
    "l-cut": LCut,
    "betweenness": Betweenness,
    "random": RandomPlaces,
}
"""Makes a method beside diverse density, by its name."""

GROUPED: dict[MethodName, Callable[..., Method]] = {"diverse-density": GroupedPeaks, "random": RandomGrouped}
"""Makes a method that works on groups of features."""

CONTROLS: frozenset[MethodName] = frozenset({"random"})
"""Those that draw at random."""


def method_with(name: MethodName, given: DiscoveryMethod | None, *, grouped: bool, seed: int) -> Method:
    """A method with its defaults, or the given one.

    Args:
        name: Of the method where none is given.
        given: One of the library, or a user's own.
        grouped: Whether features are in groups.
        seed: For the controls.
    """
    if given is not None:
        return given if isinstance(given, Method) else OwnMethod(given)
    of_all = {**METHODS, "diverse-density": PersistentPeaks, **(GROUPED if grouped else {})}
    made = of_all[name]
    return made(seed=seed) if name in CONTROLS else made()


__all__ = [
    "CONTROLS",
    "METHODS",
    "DiscoveryMethod",
    "Experience",
    "GivenPlaces",
    "Method",
    "MethodName",
    "OwnMethod",
    "Region",
    "checked_method",
    "method_with",
]
