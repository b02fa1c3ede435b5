"""Figures of a few trajectories, as text.

`python -m tests.discovery.drawn > tests/discovery/figures.txt` writes the text anew, after a change that is meant.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from sb3_options.density.regions import Region
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.figures import map_figure, subgoals_figure
from sb3_options.discovery.methods import Experience
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from tests.discovery.lines import settings_of
from tests.discovery.told import Told
from tests.support.figures import described
from tests.support.helpers import trajectory_of

UP, RIGHT, DOWN, LEFT = range(4)
STEPS = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]])
WALKS = [
    ((0, 0), [RIGHT, RIGHT, DOWN, RIGHT, RIGHT], True),
    ((0, 2), [RIGHT, RIGHT, UP, RIGHT, DOWN, RIGHT], True),
    ((0, 0), [DOWN, DOWN, UP, UP, RIGHT], False),
]
"""Where each starts, its actions, and whether it succeeds: all successes pass (2, 1)."""

FAILED = "the option was closed again because none of the first trials reached the subgoal it was made for"


class Middle(Told):
    """Proposes (2, 1)."""

    def update(self, experience: Experience) -> list[Region]:
        return [experience.region([2.0, 1.0])]


def searched(side: float = 1.0, *, keyed: bool = False, method: Told | None = None) -> Discovery:
    """Discovery over the walks, whose columns are ``side`` wide; ``keyed`` observations have keys."""
    kind = "identity" if keyed else "environment"
    discovery = Discovery(settings_of(leak=0.05, threshold=0.2, max_share=None), method, kind=kind)
    for start, actions, success in WALKS:
        places = np.cumsum([start, *STEPS[actions]], axis=0) * [side, 1.0]
        walk = trajectory_of(list(places), actions, is_success=success)
        features = np.asarray(walk.states)
        if keyed:
            walk = dataclasses.replace(walk, states={"time": features[:, 1:] * 0, "place": features})
            features = np.column_stack([features, features[:, 1] * 0])
        discovery.add(walk, features)
        discovery.search()
    return discovery


def option() -> OptionBank:
    """A bank with an option to the middle."""
    places = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [0.0, 1.0], [2.0, 1.0]])
    values = np.eye(4)[[RIGHT, RIGHT, DOWN, UP, RIGHT]]
    bank = OptionBank(4, 1)
    subgoal, initiation = (Region(points, np.ones(2), 0.5) for points in (places[4:], places[:4]))
    bank.add(SubgoalOption(subgoal, initiation, TabularPolicy(places, values), policy_input="features"))
    return bank


def _map(discovery: Discovery, bank: OptionBank) -> Figure:
    figure = map_figure(discovery, bank)
    assert figure is not None
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    "density, an option": lambda: _map(searched(), option()),
    "one feature of three has other units, no option": lambda: _map(searched(3.0, keyed=True), OptionBank(4, 1)),
    "another method, with a text": lambda: subgoals_figure(searched(method=Middle()), OptionBank(4, 1), FAILED),
    "no map": lambda: subgoals_figure(Discovery(), OptionBank(4, 1), FAILED),
}


def all_of_them() -> str:
    """Every figure under its name."""
    return "\n".join(f"=== {name}\n{described(make())}" for name, make in FIGURES.items())


if __name__ == "__main__":
    print(all_of_them(), end="")
