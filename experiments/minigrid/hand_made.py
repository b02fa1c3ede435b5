"""Options by hand on the retina: what discovery could find at best."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from sb3_options import Option
from sb3_options.envs.minigrid import FEATURES
from sb3_options.experience.observations import BoolArray, FeatureMap, FloatArray, IntArray

LEFT, RIGHT, FORWARD, PICK_UP, DROP, TOGGLE = 0, 1, 2, 3, 4, 5
"""Actions of MiniGrid."""

MadeBy: TypeAlias = Callable[[FeatureMap], list[Option]]

COLUMN = {name: i for i, name in enumerate(FEATURES)}


def options_on(features: FeatureMap) -> list[Option]:
    """Open a closed door, go into an open one, go to the goal, go ahead; with keys: fetch one, unlock a door with it.

    With balls too: fetch one, put down what is carried.

    Args:
        features: φ of MiniGrid.
    """

    def made(
        name: str,
        begins: Callable[[FloatArray], BoolArray],
        acts: Callable[[FloatArray], IntArray],
        ends: Callable[[FloatArray], BoolArray],
    ) -> Option:
        return Option(
            lambda seen: begins(features(seen)),
            lambda seen: acts(features(seen)),
            lambda seen: ends(features(seen)),
            max_duration=20,
            name=name,
        )

    def visible(kind: str) -> Callable[[FloatArray], BoolArray]:
        return lambda x: x[:, COLUMN[f"{kind}_visible"]] > 0

    def carried(kind: str) -> Callable[[FloatArray], BoolArray]:
        """Whether it is carried: MiniGrid draws that where the agent stands."""
        there = [COLUMN[f"{kind}_forward"], COLUMN[f"{kind}_lateral"]]
        return lambda x: visible(kind)(x) & (x[:, there] == 0).all(axis=1)

    def lies(kind: str) -> Callable[[FloatArray], BoolArray]:
        return lambda x: visible(kind)(x) & ~carried(kind)(x)

    def not_between(x: FloatArray) -> BoolArray:
        outside: BoolArray = x[:, COLUMN["between_walls"]] == 0
        return outside

    def never(x: FloatArray) -> BoolArray:
        return np.zeros(len(x), dtype=bool)

    def always_ahead(x: FloatArray) -> IntArray:
        return np.full(len(x), FORWARD)

    return [
        made("open a door", visible("closed_door"), lambda x: approach(x, "closed_door", TOGGLE), never),
        made(
            "into the doorway",
            lambda x: visible("open_door")(x) & not_between(x),
            lambda x: approach(x, "open_door", FORWARD),
            never,
        ),
        made("to the goal", visible("goal"), lambda x: approach(x, "goal", FORWARD), never),
        made("ahead", lambda x: x[:, COLUMN["free_ahead"]] > 0, always_ahead, never),
        made("fetch the key", lies("key"), lambda x: approach(x, "key", PICK_UP), never),
        made(
            "unlock the door",
            lambda x: visible("locked_door")(x) & carried("key")(x),
            lambda x: approach(x, "locked_door", TOGGLE),
            never,
        ),
        made("fetch the ball", lies("ball"), lambda x: approach(x, "ball", PICK_UP), never),
        made(
            "put down the key",
            lambda x: carried("key")(x) & (x[:, COLUMN["free_ahead"]] > 0),
            lambda x: np.full(len(x), DROP),
            never,
        ),
    ]


def to_subgoals_on(features: FeatureMap, within: int | None = None) -> list[Option]:
    """To the subgoals that discovery finds in rooms: closed door ahead, in an open one, goal ahead.

    Args:
        features: φ of MiniGrid.
        within: They begin so many cells away at most, ahead and sideways together; None: wherever they are in view.
    """

    def made(kind: str, forward: int, action: int) -> Option:
        where = [COLUMN[f"{kind}_forward"], COLUMN[f"{kind}_lateral"]]

        def reached(x: FloatArray) -> BoolArray:
            there: BoolArray = (x[:, COLUMN[f"{kind}_visible"]] > 0) & (x[:, where] == [forward, 0]).all(axis=1)
            return there

        def begins(x: FloatArray) -> BoolArray:
            near: BoolArray = np.abs(x[:, where]).sum(axis=1) <= (np.inf if within is None else within)
            return (x[:, COLUMN[f"{kind}_visible"]] > 0) & ~reached(x) & near

        return Option(
            lambda seen: begins(features(seen)),
            lambda seen: approach(features(seen), kind, action),
            lambda seen: reached(features(seen)),
            max_duration=20,
            name=f"{kind} at {forward}, 0",
        )

    return [made("closed_door", 1, TOGGLE), made("open_door", 0, FORWARD), made("goal", 1, FORWARD)]


def approach(features: FloatArray, kind: str, there: int) -> IntArray:
    """The action that leads to the cell before the nearest thing of a kind, and ``there`` when it is straight ahead.

    The way is ahead as long as that is free and the thing is not beside the agent, then to the side.
    """
    forward, lateral = features[:, COLUMN[f"{kind}_forward"]], features[:, COLUMN[f"{kind}_lateral"]]
    free = features[:, COLUMN["free_ahead"]] > 0
    turn = np.where(lateral > 0, RIGHT, LEFT)
    straight = np.where(forward == 1, there, FORWARD)
    return np.where(lateral == 0, straight, np.where((forward > 0) & free, FORWARD, turn))
