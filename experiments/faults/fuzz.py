"""Bags and settings of every kind, drawn by hypothesis: does each give a result, or an error of ours?"""

from __future__ import annotations

import inspect
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

import sb3_options
from sb3_options.callbacks import IntrinsicRewardCallback, SubgoalDiscoveryCallback
from sb3_options.density.bags import Bags
from sb3_options.density.concepts import Point
from sb3_options.density.diverse_density import DiverseDensity
from sb3_options.density.log_density import log_diverse_density
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.trajectories import Trajectory
from sb3_options.options.settings import OptionLearningSettings
from sb3_options.runs.config import TrainConfig

Found = list[npt.NDArray[Any]]
"""Numbers that a computation gave."""

LIBRARY = Path(sb3_options.__file__).resolve().parents[1]
"""Where the modules of this library are; envs and callbacks lie beside the package."""

SETTINGS: dict[str, Callable[..., Any]] = {
    of.__name__: of
    for of in (
        DiscoverySettings,
        OptionLearningSettings,
        DiverseDensity,
        Point,
        TrainConfig,
        SubgoalDiscoveryCallback,
        IntrinsicRewardCallback,
    )
}
"""What takes settings."""

VALUES = st.one_of(
    st.floats(),
    st.integers(-5, 5),
    st.text(max_size=4),
    st.lists(st.floats(), max_size=2),
    st.complex_numbers(),
    st.sampled_from([None, True, 10**30, -(10**30), {}, (), b"x", "gradient", np.nan]),
    st.sampled_from([np.float32(1), np.int64(2), np.array([1.0, 2.0]), np.array([]), object()]),
)
"""What somebody may pass by mistake."""

MAGNITUDES = st.sampled_from(
    [0.0, 1.0, -1.0, 3.0, 1e-300, 1e10, 1e15, 1e19, 1e38, 1e39, -1e39, 1e100, 1e101, 1e308, np.nan, np.inf]
)
SMALL = st.sampled_from([0.0, 1.0, -1.0, 3.0, 0.5, 1e-300, 1e10])
"""Numbers that can be searched: among those of every magnitude nearly every set of bags has one that cannot."""


def bags(numbers: st.SearchStrategy[float]) -> st.SearchStrategy[list[list[list[float]]]]:
    """One to three bags of one to three instances with two features."""
    instance = st.lists(numbers, min_size=2, max_size=2)
    return st.lists(st.lists(instance, min_size=1, max_size=3), min_size=1, max_size=3)


SETS = st.one_of(st.tuples(bags(MAGNITUDES), bags(MAGNITUDES)), st.tuples(bags(SMALL), bags(SMALL)))
SCALES = st.sampled_from([1e-50, 1.0, 1e20, 1e39, 1e50])


def check_bags(n: int, of_seed: int) -> dict[str, dict[str, int]]:
    """Search ``n`` fuzzed sets of bags.

    Returns:
        For diverse density and for discovery how many sets gave which `outcome`.
    """
    counts: dict[str, Counter[str]] = {"diverse density": Counter(), "discovery": Counter()}

    @_drawn(n, of_seed)
    @given(SETS, SCALES)
    def each(sets: Any, scale: float) -> None:
        counts["diverse density"][outcome(lambda: densities(sets[0], sets[1], scale))] += 1
        counts["discovery"][outcome(lambda: discovered(sets[0], sets[1], scale))] += 1

    each()
    return {name: dict(sorted(of.items())) for name, of in counts.items()}


def check_settings(n: int, of_seed: int) -> dict[str, dict[str, int]]:
    """Make what takes settings from ``n`` fuzzed configurations, in turns.

    Returns:
        By what was made, how many configurations gave which `outcome`.
    """
    shares = {name: n // len(SETTINGS) + (i < n % len(SETTINGS)) for i, name in enumerate(SETTINGS)}
    return {name: _count_settings(make, shares[name], of_seed) for name, make in SETTINGS.items()}


def _count_settings(make: Callable[..., Any], n: int, of_seed: int) -> dict[str, int]:
    counts: Counter[str] = Counter()
    names = list(inspect.signature(make).parameters)

    @_drawn(n, of_seed)
    @given(st.dictionaries(st.sampled_from(names), VALUES, min_size=1, max_size=3))
    def each(kwargs: dict[str, Any]) -> None:
        counts[outcome(lambda: made(make, kwargs))] += 1

    if n:
        each()
    return dict(sorted(counts.items()))


def outcome(compute: Callable[[], Found]) -> str:
    """What a computation ends in.

    Returns:
        ``result``; ``not a number``, where NaN or +∞ is among it (a density of 0 has the logarithm −∞); ``refused``, a
        ``ValueError`` or ``TypeError`` that this library raised; ``another's error``, one that some other library
        raised; ``error``, any other exception.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = compute()
    except (ValueError, TypeError) as error:
        raised_in = Path(traceback.extract_tb(error.__traceback__)[-1].filename).resolve()
        ours = raised_in.is_relative_to(LIBRARY) and "site-packages" not in raised_in.relative_to(LIBRARY).parts
        return "refused" if ours else "another's error"
    except Exception:
        return "error"
    return "result" if all((values < np.inf).all() for values in found) else "not a number"


def densities(positive: Any, negative: Any, scale: float) -> Found:
    """Diverse density at the instances, and what all searches find."""
    packed = Bags.pack(positive, negative)
    found = [log_diverse_density(packed.instances, scale, packed, negative_strength=0.1).numpy()]
    for method in ("gradient", "exhaustive"):
        peaks = DiverseDensity(scale=scale, method=method, negative_strength=0.1).search(packed)
        found += [np.append(peak.point, peak.log_density) for peak in peaks]
    return found + [s.point for s in DiverseDensity(concept=Point(), scale=scale, negative_strength=0.1).search(packed)]


def discovered(positive: Any, negative: Any, scale: float) -> Found:
    """What discovery finds in episodes that were in these instances, one after another."""
    how = DiscoverySettings(min_positive=1, start_radius=0.0, goal_radius=0.0, threshold=0.1)
    discovery = Discovery(how)
    found: Found = []
    for rows, success in [(rows, True) for rows in positive] + [(rows, False) for rows in negative]:
        features = np.unique(np.array(rows), axis=0)
        n = len(features)
        visits, steps = np.arange(n), np.zeros(n - 1)
        discovery.add(
            Trajectory(features, visits, steps.astype(int), steps, success, not success, success), features * scale
        )
    for _ in range(2):
        subgoal = discovery.search()
        found += [np.append(peak.point, peak.log_density) for peak in discovery.method.peaks]  # type: ignore[attr-defined]
        found += [] if subgoal is None else [subgoal.points, np.array(subgoal.radius)]
    return found


def made(make: Callable[..., Any], kwargs: dict[str, Any]) -> Found:
    """Make it, which gives no numbers."""
    make(**kwargs)
    return []


def _drawn(n: int, of_seed: int) -> Callable[[Any], Any]:
    """Have hypothesis draw ``n`` times, and nothing else: what fails is counted, not made small."""

    def decorate(check: Any) -> Any:
        how = settings(
            max_examples=n,
            deadline=None,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        return seed(of_seed)(how(check))

    return decorate
