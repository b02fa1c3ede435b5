"""``python -m experiments.paper.report results.json docs/studies/paper.md``: puts the numbers of a study in place.

No number is copied by hand.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from experiments.common.documents import fill, number, settings_table

SAYS: list[tuple[str, str, str, tuple[str, ...]]] = [
    (
        "§3",
        "First-visit frequencies highlight the doorway better than every-visit frequencies.",
        "figure1",
        ("doorway_stands_out_more_in_first_visits",),
    ),
    ("§5, §6.1", "Options are added at about trial 20.", "figure2", ("option_median_trial",)),
    ("§6.1", "Most subgoals fall near the doorway.", "figure2", ("subgoals_near_doorway",)),
    (
        "§6.1",
        "Discovery considerably accelerates learning.",
        "figure3",
        ("steps_trials_30_39", "steps_trials_20_199"),
    ),
    (
        "§6.1",
        "The difference between the curves exceeds one standard deviation.",
        "figure3",
        ("difference_exceeds_one_sd_trials_30_39",),
    ),
    (
        "ours",
        "Options do not hurt once the task is learned.",
        "figure3",
        ("asymptote_trials_250_299", "asymptote_not_hurt"),
    ),
    (
        "§6.1",
        "As much experience replay over the whole state space helps.",
        "figure4",
        ("whole_replay_helps", "whole_replay_once_helps"),
    ),
    (
        "§6.1",
        "Discovery is more advantageous than that replay.",
        "figure4",
        ("option_beats_whole_replay", "option_beats_whole_replay_once"),
    ),
    (
        "§6.1",
        "Replay over the input set into the main value function does almost what the option does.",
        "figure4",
        ("partial_replay_like_option", "partial_replay_once_like_option"),
    ),
    ("§6.1", "Earlier options considerably accelerate a related task.", "figure5", ("transfer_trials_0_49",)),
    (
        "§6.1",
        "Reusing the value function, whole or in part, is drastically worse.",
        "figure6",
        ("value_reuse_whole_worse_than_option", "value_reuse_partial_worse_than_option"),
    ),
    (
        "§3",
        "Options for random subgoals do not help.",
        "controls",
        ("random_no_better_trials_30_39", "random_no_better_trials_20_199"),
    ),
    (
        "ours",
        "A hand-made doorway option is at least as good as the discovered one.",
        "controls",
        ("handmade_as_good_trials_30_39", "handmade_as_good_trials_20_199"),
    ),
]
"""Section, what the paper says there, our figure, and our claims that test it."""


@dataclass(frozen=True)
class Report:
    """Put the numbers of a study into its document.

    Attributes:
        results: What the study wrote.
        document: Markdown with the markers.
    """

    results: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULTS")]
    document: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DOCUMENT")]


def main(report: Report) -> None:
    """Read, and fill in."""
    results = json.loads(report.results.read_text(encoding="utf-8"))
    parts = {
        "run": f"`{results['command']}`: {results['n_runs']} runs, {results['seconds']:.0f} s.",
        "claims": claims_table(results["claims"]),
        "subgoals": subgoals_table(results["figures"]),
        "ratios": ratios_table(results["figures"]),
        "settings": settings_table(results["settings"]),
    }
    fill(report.document, parts)


def claims_table(claims: dict[str, dict[str, Any]]) -> str:
    """Claim by claim: the paper's words, our number and bar, and whether they agree."""
    rows = ["| paper | claim | ours | number (95 % interval) | bar | agrees |", "|---|---|---|---|---|---|"]
    for section, words, figure, names in SAYS:
        for name in names:
            claim = claims[name]
            agrees = "yes" if claim["reached"] else "**no**"
            rows.append(
                f"| {section} | {words} | [{figure}](../images/paper/{figure}.png), `{name}` | "
                f"{number(claim, 'value')} | {claim['bar']} | {agrees} |"
            )
    return "\n".join(rows)


def subgoals_table(figures: dict[str, Any]) -> str:
    """How many subgoals each way of looking for them puts at the doorway."""
    found = {
        "diverse density, no negative bags": figures["figure2"]["diverse_density"],
        "baseline: most first visits, same trial and filter": figures["figure2"]["first_visit_baseline"],
        "baseline: most visits, same trial and filter": figures["figure2"]["every_visit_baseline"],
        "step limit, negative bags, η = 1": figures["negatives"]["step_limit_strict"],
        "step limit, negative bags, η = 0.1": figures["negatives"]["step_limit_soft"],
        "the same without loops, passages only: the library's bags": figures["negatives"]["without_loops"],
        "noisy negative bags, η = 1": figures["negatives"]["noisy_strict"],
        "noisy negative bags, η = 0.1": figures["negatives"]["noisy_soft"],
    }
    rows = ["| subgoals from | found | within one cell of the doorway | median trial |", "|---|---|---|---|"]
    for words, n in found.items():
        rows.append(f"| {words} | {n['n_found']} | {n['n_near_doorway']} of {n['n_runs']} | {n['median_trial']} |")
    return "\n".join(rows)


def ratios_table(figures: dict[str, Any]) -> str:
    """Every ratio of mean steps."""
    rows = ["| figure | ratio of mean steps | number (95 % interval) |", "|---|---|---|"]
    for figure, numbers in figures.items():
        for name, ratio in numbers.get("ratios", {}).items():
            rows.append(f"| {figure} | `{name}` | {number(ratio)} |")
    return "\n".join(rows)


if __name__ == "__main__":
    main(tyro.cli(Report))
