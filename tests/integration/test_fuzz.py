"""Settings and bags of every kind: each is taken, or refused by an error that says what it is about."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_options import OptionsWrapper
from sb3_options.callbacks import IntrinsicRewardCallback, SubgoalDiscoveryCallback
from sb3_options.density.bags import Bags
from sb3_options.density.concepts import Plane, Point
from sb3_options.density.diverse_density import DiverseDensity, log_diverse_density
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.search import ConceptSearch
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.execution.trials import TrialSettings
from sb3_options.experience.recording import RewardPeaks
from sb3_options.options.settings import OptionLearningSettings
from sb3_options.runs.config import DQNConfig, MaskablePPOConfig
from tests.support.helpers import CountingEnv

VALUES = st.one_of(
    st.floats(),
    st.integers(-5, 5),
    st.text(max_size=4),
    st.lists(st.floats(), max_size=2),
    st.complex_numbers(),
    st.sampled_from([None, True, 10**30, -(10**30), {}, (), b"x", "gradient", np.nan]),
    st.sampled_from([np.float32(1), np.int64(2), np.array([1.0, 2.0]), np.array([]), object()]),
)


def wrapped(**kwargs: Any) -> OptionsWrapper:
    return OptionsWrapper(CountingEnv(), **kwargs)


CLASSES = (
    DiscoverySettings,
    OptionLearningSettings,
    TrialSettings,
    RewardPeaks,
    DiverseDensity,
    ConceptSearch,
    Point,
    Plane,
    DQNConfig,
    MaskablePPOConfig,
    SubgoalDiscoveryCallback,
    IntrinsicRewardCallback,
)

MADE: dict[str, tuple[Callable[..., Any], Callable[..., Any], dict[str, Any]]] = {
    **{of.__name__: (of, of, {}) for of in CLASSES},
    "FeatureGroup": (FeatureGroup, FeatureGroup, {"name": "group", "features": (0, 1)}),
    "OptionsWrapper": (wrapped, OptionsWrapper, {}),
}

ALIASES = {
    "env_kwargs": "env-kwargs",
    "groups": "FeatureGroup",
    "settings": "DiscoverySettings",
    "option_settings": "OptionLearningSettings",
    "trial": "TrialSettings",
    "rnd": "RNDSettings",
    "max_option_exploration": "opening_share",
}
"""What an error may say in place of an argument's name."""


@pytest.mark.parametrize("name", MADE)
def test_arguments_of_every_kind(name: str) -> None:
    make, of, needed = MADE[name]
    names = [n for n in inspect.signature(of).parameters if n not in ("env", "options_file")]

    @settings(max_examples=150, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(st.dictionaries(st.sampled_from(names), VALUES, min_size=1, max_size=2))
    def check(kwargs: dict[str, Any]) -> None:
        try:
            make(**{**needed, **kwargs})
        except (ValueError, TypeError) as error:
            said = str(error)
            if not any(n in said or ALIASES.get(n, n) in said for n in kwargs):
                pytest.fail(f"{kwargs} gave {type(error).__name__}: {said}")

    check()


MAGNITUDES = st.sampled_from(
    [0.0, 1.0, -1.0, 3.0, 1e-300, 1e10, 1e15, 1e19, 1e38, 1e39, -1e39, 1e100, 1e101, 1e308, np.nan, np.inf]
)
BAGS = st.lists(st.lists(st.lists(MAGNITUDES, min_size=2, max_size=2), min_size=1, max_size=3), min_size=1, max_size=3)


@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(BAGS, BAGS, st.sampled_from([1e-50, 1.0, 1e20, 1e39, 1e50]), st.sampled_from([torch.float32, torch.float64]))
def test_bags_of_every_size(positive: Any, negative: Any, scale: float, dtype: torch.dtype) -> None:
    found = []
    try:
        bags = Bags.pack(positive, negative, dtype=dtype)
        found.append(log_diverse_density(bags.instances, scale, bags, negative_strength=0.1).numpy())
        for method in ("gradient", "exhaustive"):
            peaks = DiverseDensity(scale=scale, method=method, negative_strength=0.1).search(bags)
            found += [np.append(peak.point, peak.log_density) for peak in peaks]
        found += [s.theta for s in ConceptSearch(scale=scale, negative_strength=0.1).search(bags)]
    except ValueError as error:
        if not any(what in str(error) for what in ("NaN or infinite", "overflow", "at most 1e+15 can be searched")):
            raise
    assert not any(np.isnan(values).any() for values in found)
