"""Settings and bags of every kind: each is taken, or refused by an error that says what it is about."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from experiments.faults.fuzz import MAGNITUDES, SCALES, SETTINGS, VALUES, Found, bags, densities
from sb3_options import OptionsWrapper
from sb3_options.density.groups import FeatureGroup
from tests.support.helpers import CountingEnv


def wrapped(**kwargs: Any) -> OptionsWrapper:
    return OptionsWrapper(CountingEnv(), **kwargs)


MADE: dict[str, tuple[Callable[..., Any], Callable[..., Any], dict[str, Any]]] = {
    **{name: (of, of, {}) for name, of in SETTINGS.items()},
    "FeatureGroup": (FeatureGroup, FeatureGroup, {"name": "group", "features": (0, 1)}),
    "OptionsWrapper": (wrapped, OptionsWrapper, {}),
}

ALIASES = {
    **{name: name.replace("_", "-") for name in ("env_kwargs", "algo_kwargs", "max_runs", "n_envs")},
    "groups": "FeatureGroup",
    "use": "OptionUse",
    "concepts": "ConceptSettings",
    "settings": "DiscoverySettings",
    "option_settings": "OptionLearningSettings",
    "embedding": "EmbeddingSettings",
    "usefulness": "UsefulnessSettings",
}
"""What an error may say in place of an argument's name."""


@pytest.mark.parametrize("name", MADE)
def test_arguments_of_every_kind(name: str) -> None:
    make, of, needed = MADE[name]
    names = [n for n in inspect.signature(of).parameters if n not in ("env", "options_file")]

    @settings(max_examples=150, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(st.dictionaries(st.sampled_from(names), VALUES, min_size=1, max_size=2))
    def check(kwargs: dict[str, Any]) -> None:
        try:
            make(**{**needed, **kwargs})
        except (ValueError, TypeError) as error:
            said = str(error)
            if not any(n in said or ALIASES.get(n, n) in said for n in kwargs):
                pytest.fail(f"{kwargs} gave {type(error).__name__}: {said}")

    check()


@settings(max_examples=40, derandomize=True, suppress_health_check=list(HealthCheck))
@given(bags(MAGNITUDES), bags(MAGNITUDES), SCALES)
def test_bags_of_every_size(positive: Any, negative: Any, scale: float) -> None:
    found: Found = []
    try:
        found = densities(positive, negative, scale)
    except ValueError as error:
        if not any(what in str(error) for what in ("NaN or infinite", "overflow", "at most 1e+15 can be searched")):
            raise
    assert not any(np.isnan(values).any() for values in found)
