"""Features against tiles worked out by hand."""

import numpy as np

from experiments.pioneer.tiles import Concatenated, TileCoding


def test_one_tiling_is_a_grid() -> None:
    # Two by three tiles and one more along each dimension: tile (column, row) is 4 · column + row.
    tiles = TileCoding([0.0, 0.0], [2.0, 3.0], [2, 3], n_tilings=1)
    points = np.array([[0.0, 0.0], [0.9, 0.9], [1.0, 0.0], [1.5, 2.5], [2.0, 3.0]])
    assert tiles.active(points).tolist() == [[0], [0], [4], [6], [11]]
    assert tiles.n_features == 12


def test_tilings_are_shifted_by_the_first_odd_integers() -> None:
    # Four tilings, unit tiles: along x by 0, 1/4, 2/4, 3/4 and along y by 0, 3/4, 2/4 (6 mod 4), 1/4 (9 mod 4).
    tiles = TileCoding([0.0, 0.0], [4.0, 4.0], [4, 4], n_tilings=4)
    shift_x, shift_y = [0.0, 0.25, 0.5, 0.75], [0.0, 0.75, 0.5, 0.25]
    for x, y in [(0.0, 0.0), (0.3, 0.3), (1.3, 2.6), (3.9, 0.1), (4.0, 4.0)]:
        by_hand = [25 * i + 5 * int(x + shift_x[i]) + int(y + shift_y[i]) for i in range(4)]
        assert tiles.active(np.array([[x, y]])).tolist() == [by_hand]
    assert tiles.active(np.array([[0.3, 0.3]])).tolist() == [[0, 25 + 1, 50, 75 + 5]]
    assert tiles.n_features == 100


def test_parts_see_their_own_numbers_and_have_features_of_their_own() -> None:
    column, row = TileCoding([0.0], [2.0], [2], n_tilings=1), TileCoding([0.0], [3.0], [3], n_tilings=1)
    both = Concatenated([([2], column), ([0], row)])
    assert (both.n_features, both.n_active) == (3 + 4, 2)
    observations = np.array([[2.5, 99.0, 1.5], [0.0, 99.0, 0.0]])
    assert both.active(observations).tolist() == [[1, 3 + 2], [0, 3 + 0]]
    assert both.active(observations.reshape(2, 3, 1)).tolist() == [[1, 5], [0, 3]]
