"""What must be shown, each with its number, its bar and whether it is reached."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

Figures = dict[str, dict[str, Any]]

NEAR_SHARE = 0.9
"""27 of 30 subgoals at the doorway."""

ASYMPTOTE = 0.03


class Claim(NamedTuple):
    """A number held against a bar.

    Attributes:
        name: Stable key.
        value: The number.
        low: Lower end of its 95 % interval; None where there is none.
        high: Upper end.
        bar: In words.
        reached: Whether it is.
    """

    name: str
    value: float | None
    low: float | None
    high: float | None
    bar: str
    reached: bool


def claims_of(figures: Figures) -> list[Claim]:
    """The claims about those figures that were made."""
    makers = {
        "figure1": _histograms,
        "figure2": _subgoals,
        "figure3": _learning,
        "figure4": _replay,
        "figure5": _transfer,
        "figure6": _reuse,
        "controls": _controls,
    }
    return [claim for name, make in makers.items() if name in figures for claim in make(figures[name])]


def _histograms(numbers: dict[str, Any]) -> Iterator[Claim]:
    every, first = (numbers[kind]["share_of_cells_below_doorway"] for kind in ("every", "first"))
    reached = first["low"] > every["high"]
    yield Claim("doorway_stands_out_more_in_first_visits", **_of(first), bar="above every-visit", reached=reached)


def _subgoals(numbers: dict[str, Any]) -> Iterator[Claim]:
    median = numbers["option_trial"]["median"]
    reached = median is not None and 15 <= median <= 40
    yield Claim("option_median_trial", median, None, None, "15 to 40", reached)
    share = numbers["diverse_density"]["share_near_doorway"]
    reached = share["mean"] >= NEAR_SHARE
    yield Claim("subgoals_near_doorway", **_of(share), bar="27 of 30 runs", reached=reached)


def _learning(numbers: dict[str, Any]) -> Iterator[Claim]:
    for window, bar in (("30_39", 0.25), ("20_199", 0.45)):
        r = numbers["ratios"][f"discovery_to_primitive_trials_{window}"]
        reached = r["mean"] <= bar and r["high"] < 1
        yield Claim(f"steps_trials_{window}", **_of(r), bar=f"<= {bar}, interval below 1", reached=reached)
    r = numbers["ratios"]["discovery_to_primitive_trials_250_299"]
    within = abs(r["mean"] - 1) <= ASYMPTOTE
    yield Claim("asymptote_trials_250_299", **_of(r), bar="0.97 to 1.03", reached=within)
    not_hurt = r["mean"] <= 1 + ASYMPTOTE
    yield Claim("asymptote_not_hurt", **_of(r), bar="<= 1.03", reached=not_hurt)
    value = numbers["difference_in_sd_trials_30_39"]
    yield Claim("difference_exceeds_one_sd_trials_30_39", value, None, None, "> 1", value is not None and value > 1)


def _replay(numbers: dict[str, Any]) -> Iterator[Claim]:
    for suffix in ("", "_once"):
        to_primitive = numbers["ratios"][f"replay_whole{suffix}_to_primitive_trials_20_199"]
        helps = to_primitive["high"] < 1
        yield Claim(f"whole_replay{suffix}_helps", **_of(to_primitive), bar="interval below 1", reached=helps)
        to_options = numbers["ratios"][f"replay_whole{suffix}_to_discovery_trials_20_199"]
        worse = to_options["low"] > 1
        name = f"option_beats_whole_replay{suffix}"
        yield Claim(name, **_of(to_options), bar="replay to option, interval above 1", reached=worse)
        partial = numbers["ratios"][f"replay_partial{suffix}_to_discovery_trials_20_199"]
        same = partial["low"] <= 1 <= partial["high"]
        name = f"partial_replay{suffix}_like_option"
        yield Claim(name, **_of(partial), bar="replay to option, interval holds 1", reached=same)


def _transfer(numbers: dict[str, Any]) -> Iterator[Claim]:
    r = numbers["ratios"]["options_to_primitive_trials_0_49"]
    reached = r["mean"] <= 0.5 and r["high"] < 1
    yield Claim("transfer_trials_0_49", **_of(r), bar="<= 0.5, interval below 1", reached=reached)


def _reuse(numbers: dict[str, Any]) -> Iterator[Claim]:
    for name in ("whole", "partial"):
        r = numbers["ratios"][f"{name}_to_options_trials_0_49"]
        bar = "reuse to option, interval above 1"
        yield Claim(f"value_reuse_{name}_worse_than_option", **_of(r), bar=bar, reached=r["low"] > 1)


def _controls(numbers: dict[str, Any]) -> Iterator[Claim]:
    for window in ("30_39", "20_199"):
        r = numbers["ratios"][f"random_to_primitive_trials_{window}"]
        bar = "interval not below 1"
        yield Claim(f"random_no_better_trials_{window}", **_of(r), bar=bar, reached=r["high"] >= 1)
    for window in ("30_39", "20_199"):
        r = numbers["ratios"][f"handmade_to_discovery_trials_{window}"]
        yield Claim(f"handmade_as_good_trials_{window}", **_of(r), bar="<= 1", reached=r["mean"] <= 1)


def _of(interval: dict[str, float]) -> dict[str, Any]:
    return {"value": interval["mean"], "low": interval["low"], "high": interval["high"]}
