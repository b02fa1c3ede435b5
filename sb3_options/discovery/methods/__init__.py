"""Methods of discovery: trajectories in, proposals out. Pure."""

from collections.abc import Callable

from sb3_options.density.regions import Region
from sb3_options.discovery.methods.diverse_density import PersistentPeaks
from sb3_options.discovery.methods.grouped import GroupedPeaks
from sb3_options.discovery.methods.method import DiscoveryMethod, Experience, Method, OwnMethod, checked_method
from sb3_options.discovery.methods.random_places import RandomPlaces
from sb3_options.discovery.methods.relative_novelty import RelativeNovelty
from sb3_options.discovery.settings import MethodName

METHODS: dict[MethodName, Callable[..., Method]] = {
    "relative-novelty": RelativeNovelty,
    "random": RandomPlaces,
}
"""Constructors of the methods besides diverse density, by name."""


def method_with(name: MethodName, given: DiscoveryMethod | None, *, grouped: bool, seed: int) -> Method:
    """Return the given method, which may be a user's own, or else the named one; ``random`` needs ``seed``."""
    if given is not None:
        return given if isinstance(given, Method) else OwnMethod(given)
    if name == "diverse-density":
        return GroupedPeaks() if grouped else PersistentPeaks()
    return RandomPlaces(seed=seed) if name == "random" else METHODS[name]()


__all__ = [
    "METHODS",
    "DiscoveryMethod",
    "Experience",
    "Method",
    "MethodName",
    "OwnMethod",
    "Region",
    "checked_method",
    "method_with",
]
