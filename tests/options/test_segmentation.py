"""The decisions of a trajectory: which options it passes through."""

from collections.abc import Callable

import pytest

from sb3_options.options.bank import OptionBank
from sb3_options.options.segmentation import explained
from tests.support.helpers import table_option, trajectory_of

UP, DOWN, LEFT, RIGHT = range(4)


@pytest.mark.parametrize(
    ("wanders", "expected"),
    [
        ([RIGHT, RIGHT, RIGHT, RIGHT], [4, 4, 3, 3]),  # the subgoal is at 3; an option of one step saves nothing
        ([RIGHT, LEFT, RIGHT, RIGHT, RIGHT], [3, 2, 4, 4, 3]),  # where the option would do something else, primitives
        ([RIGHT, RIGHT], [3, 3]),  # the subgoal is not reached
    ],
)
def test_steps_on_which_trajectory_and_option_agree_are_the_options(wanders: list[int], expected: list[int]) -> None:
    bank = OptionBank(4, 1)
    bank.add(table_option([True] * 6, [RIGHT] * 6, [0, 0, 0, 1, 0, 0], max_duration=3))
    moves: dict[int, Callable[[int], int]] = {RIGHT: lambda x: x + 1, LEFT: lambda x: x - 1}
    places = [0]
    for action in wanders:
        places.append(moves[action](places[-1]))
    durations, masks = explained(trajectory_of(places, wanders), bank)
    assert durations.argmax(axis=1).tolist() == expected
    assert masks.shape == (len(wanders) + 1, 5)


def test_an_option_is_a_decision_of_at_most_its_longest_duration() -> None:
    bank = OptionBank(4, 2)
    bank.add(table_option([True] * 6, [RIGHT] * 6, [0, 0, 0, 0, 1, 0], max_duration=3))
    bank.add(table_option([True] * 6, [RIGHT] * 6, [0, 0, 0, 1, 0, 0], max_duration=2))
    durations, _ = explained(trajectory_of([0, 1, 2, 3, 4], [RIGHT] * 4), bank)
    assert durations.argmax(axis=1).tolist() == [RIGHT, 4, 4, RIGHT]  # of two the one that goes farther
    assert durations[:, 4].tolist() == [0, 3, 2, 1]
