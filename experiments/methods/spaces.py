"""What is tuned of each method."""

from __future__ import annotations

import inspect
from typing import Any

from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from experiments.methods.entrants import RACERS
from sb3_options.discovery.settings import DiscoverySettings

Space = dict[str, BaseDistribution]

_PERSISTENCE: Space = {"decay": CategoricalDistribution([0.5, 0.75, 0.9]), "threshold": FloatDistribution(0.3, 0.9)}
_DENSITY: Space = {
    **_PERSISTENCE,
    "min_positive": IntDistribution(3, 12),
    "min_passing": FloatDistribution(0.0, 0.9),
    "leak": FloatDistribution(0.0, 0.5),
    "negative_strength": FloatDistribution(0.01, 1.0, log=True),
}
_VISITS: Space = {**_PERSISTENCE, "min_successes": IntDistribution(3, 12), "radius": FloatDistribution(0.5, 3.0)}
_GRAPH: Space = {
    "horizon": IntDistribution(100, 3000, log=True),
    "min_seen": IntDistribution(3, 20),
    "min_share": FloatDistribution(0.05, 0.9),
}

SPACES: dict[str, Space] = {
    "diverse-density": _DENSITY,
    "em-dd": _DENSITY,
    "first-visits": _VISITS,
    "every-visit": _VISITS,
    "relative-novelty": {
        "lag": IntDistribution(3, 15),
        "threshold": FloatDistribution(1.0, 4.0),
        "odds": FloatDistribution(1.0, 100_000.0, log=True),
    },
    "l-cut": {**_GRAPH, "max_cut": FloatDistribution(0.01, 0.5, log=True)},
    "betweenness": _GRAPH,
    "random": {"min_successes": IntDistribution(3, 12)},
}
"""By method. Each includes its defaults."""


def defaults_of(method: str) -> dict[str, Any]:
    """The defaults of what is tuned."""
    if method not in RACERS:
        return {name: getattr(DiscoverySettings(), name) for name in SPACES[method]}
    known = inspect.signature(RACERS[method]).parameters
    return {name: known[name].default for name in SPACES[method]}
