from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from sb3_options.discovery import local_cuts
from sb3_options.discovery.local_cuts import LocalCuts
from sb3_options.envs import GridWorld

ROOMS = """
    ###########
    #....#....#
    #....#....#
    #.........#
    #....#....#
    #S...#...G#
    ###########
"""


def walked(cuts: LocalCuts, ways: Sequence[Any]) -> LocalCuts:
    for way in ways:
        states, visits = np.unique(np.array(way, dtype=float), axis=0, return_inverse=True)
        cuts.add(states, visits.ravel())
    return cuts


def shares_of(cuts: LocalCuts, states: npt.ArrayLike) -> npt.NDArray[np.float64]:
    return cuts.shares(np.asarray(states, dtype=np.float64))


def everywhere(world: GridWorld) -> list[list[tuple[float, ...]]]:
    """Each step from cell to cell as a trajectory, there and back."""
    cells = {(x, y) for y in range(world.height) for x in range(world.width) if not world.walls[y, x]}
    return [[c, d, c] for c in cells for d in ((c[0] + 1, c[1]), (c[0], c[1] + 1)) if d in cells]


def test_what_more_than_one_trajectory_visited_is_known() -> None:
    cuts = walked(LocalCuts(), [[(0, 0), (1, 0)], [(1, 0), (2, 0)], [(2, 0), (1, 0)]])
    states = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [9.0, 9.0]])
    assert cuts.are_known(states).tolist() == [False, True, True, False]
    assert walked(cuts, [[(0, 0)]]).are_known(states).tolist() == [True, True, True, False]


def test_a_doorway_cuts_and_the_floor_does_not() -> None:
    world = GridWorld(ROOMS)
    (doorway,) = world.doorways
    cells = np.unique([c for way in everywhere(world) for c in way], axis=0)
    shares = shares_of(walked(LocalCuts(), everywhere(world)), cells)
    steps = np.abs(cells - doorway).sum(axis=1)
    assert shares[steps == 0] == pytest.approx(0.5)
    assert (shares[steps == 1] > 0.2).all()
    assert (shares[steps > 1] == 0.0).all()


def test_one_way_more_can_undo_a_cut_and_is_seen_at_once() -> None:
    line = [(x, 0) for x in range(5)]
    cuts = walked(LocalCuts(), [line, line])
    middle = np.array([[2.0, 0.0]])
    assert shares_of(cuts, middle) == 0.5
    walked(cuts, [[(1, 0), (1, 1), (2, 1), (3, 1), (3, 0)]])
    assert shares_of(cuts, middle) == 0.0


def test_what_one_trajectory_visited_or_none_counts_as_a_cut() -> None:
    square = [(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]
    cuts = walked(LocalCuts(), [square])
    assert shares_of(cuts, [[0.0, 0.0], [7.0, 7.0]]).tolist() == [0.5, 0.5]
    assert shares_of(walked(cuts, [square]), [[0.0, 0.0], [7.0, 7.0]]).tolist() == [0.0, 0.5]
    assert cuts.n_computed == 1


def test_states_beyond_the_most_are_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_cuts, "MAX_STATES", 3)
    line = [(float(x), 0.0) for x in range(6)]
    cuts = walked(LocalCuts(), [line, line])
    assert shares_of(cuts, line).tolist() == [0.0, 0.5, 0.0, 0.5, 0.5, 0.5]
    assert cuts.are_known(np.array(line)).tolist() == [True] * 3 + [False] * 3


def test_negative_zero_is_zero() -> None:
    cuts = walked(LocalCuts(), [[(0.0,), (1.0,), (2.0,)], [(-0.0,), (1.0,), (2.0,)]])
    assert shares_of(cuts, [[-0.0], [1.0]]).tolist() == [0.0, 0.5]


def test_states_of_many_features_have_short_keys_and_the_same_shares() -> None:
    many = np.zeros((3, 20))
    many[:, 19] = np.arange(3.0)
    cuts = walked(LocalCuts(), [many[way] for way in ([0, 1, 2], [1, 2], [2, 1])])
    assert {len(key) for key in cuts._number} == {16}
    assert shares_of(cuts, many).tolist() == [0.5, 0.5, 0.0]
