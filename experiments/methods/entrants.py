"""Who races: methods of discovery, two controls, places that somebody knows, and no options at all."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from inspect import signature
from pathlib import Path
from typing import Any, get_args

from experiments.methods.em_dd import MostLikelyPeaks
from experiments.methods.filtered import FilteredStates
from experiments.methods.left_out import LEFT_OUT
from experiments.methods.tasks import RaceTask, places
from sb3_options.density.regions import Region
from sb3_options.discovery.methods import METHODS, DiscoveryMethod, Experience, Method, MethodName
from sb3_options.discovery.settings import DiscoverySettings

NONE = "none"
HAND_MADE = "hand-made"

FILTERED = "random-filtered"

EM_DD = "em-dd"

RACERS: dict[str, Callable[..., Method]] = {**dict(METHODS.items()), **LEFT_OUT}
"""Make a method beside diverse density."""

ENTRANTS = (*get_args(MethodName), *LEFT_OUT, EM_DD, HAND_MADE, NONE)
"""Of `MethodName`; those that the library leaves out; ``em-dd``: one instance speaks for each bag; ``hand-made``: the
bottlenecks themselves; ``none``: primitives."""

POSSIBLE = (*ENTRANTS, FILTERED)
"""``random-filtered``: states drawn from diverse density's bags; it takes part where it is named."""

TUNED = Path(__file__).with_name("tuned.json")
"""What `experiments.methods.tune` chose, by method."""


class GivenPlaces(Method):
    """Proposes places that somebody knows, (n, d), as soon as a trajectory comes to them."""

    def __init__(self, points: list[Sequence[float]]) -> None:
        self.points = points

    def update(self, experience: Experience) -> list[Region]:
        """Propose those that the trajectory came to; as `DiscoveryMethod.update`."""
        regions = [experience.region(point) for point in self.points]
        return [region for region in regions if region.contains(experience.features).any()]


def chosen_settings(entrants: tuple[str, ...], which: str) -> dict[str, dict[str, Any]]:
    """The settings of each entrant other than its defaults.

    Raises:
        SystemExit: They are to be the tuned ones, and some method was not tuned.
    """
    if which == "defaults":
        return {entrant: {} for entrant in entrants}
    tuned = json.loads(TUNED.read_text(encoding="utf-8")) if TUNED.is_file() else {}
    missing = [entrant for entrant in entrants if entrant in TUNABLE and entrant not in tuned]
    if missing:
        raise SystemExit(
            f"--settings tuned: {', '.join(missing)} not tuned yet, see python -m experiments.methods.tune --help, or "
            "take --settings defaults."
        )
    return {entrant: tuned[entrant]["settings"] if entrant in tuned else {} for entrant in entrants}


TUNABLE = frozenset(ENTRANTS) - {HAND_MADE, NONE}
"""What has something to tune: the methods, and how long random places wait."""


def all_settings_of(entrant: str, changed: Mapping[str, Any]) -> dict[str, Any]:
    """All settings of an entrant, its defaults among them: what its results depend on."""
    if entrant in RACERS:
        made: Any = RACERS[entrant]
        defaults = {name: p.default for name, p in signature(made).parameters.items() if name != "seed"}
        return {**defaults, **changed}
    if entrant in (FILTERED, EM_DD):
        return {**asdict(DiscoverySettings(**changed)), "method": entrant}
    return {} if entrant in (HAND_MADE, NONE) else asdict(DiscoverySettings(**{"method": entrant, **changed}))


def discovery_of(
    entrant: str, changed: Mapping[str, Any], task: RaceTask, seed: int
) -> tuple[DiscoverySettings, DiscoveryMethod | None]:
    """How an entrant discovers: settings, and the method itself where it is none of diverse density.

    Args:
        entrant: Of `ENTRANTS`.
        changed: Its settings other than the defaults.
        task: Whose concept space is used.
        seed: Of the controls' draws.
    """
    if entrant in RACERS:
        drawn = {"seed": seed} if entrant == "random" else {}
        return DiscoverySettings(**task.discovery), RACERS[entrant](**changed, **drawn)
    if entrant == HAND_MADE:
        return DiscoverySettings(**task.discovery), GivenPlaces(places(task))
    if entrant == EM_DD:
        return DiscoverySettings(**{**task.discovery, **changed}), MostLikelyPeaks()
    if entrant == FILTERED:
        return DiscoverySettings(**task.discovery), FilteredStates(seed=seed)
    if entrant == NONE:
        return DiscoverySettings(**task.discovery), None
    return DiscoverySettings(**{**task.discovery, "method": entrant, **changed}), None
