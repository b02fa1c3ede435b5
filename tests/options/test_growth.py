"""An option is learned anew each time twice as many trajectories have reached its subgoal."""

from sb3_options.options.growth import OptionGrowth
from tests.support.helpers import ball, line

REACHES, MISSES = line([0, 1, 2]), line([0, 1, 0])


def test_due_at_every_doubling_of_what_reached_the_subgoal() -> None:
    growth, subgoal = OptionGrowth(), ball(2.0)
    growth.made(0, subgoal, [REACHES, MISSES, REACHES])
    due = [growth.is_due(0, subgoal, t) for t in (REACHES, MISSES, REACHES, REACHES, REACHES, REACHES, REACHES)]
    assert due == [False, False, True, False, False, False, True]


def test_slots_are_counted_apart() -> None:
    growth = OptionGrowth()
    growth.made(0, ball(2.0), [REACHES])
    growth.made(1, ball(1.0), [REACHES, MISSES])
    assert growth.is_due(0, ball(2.0), REACHES)
    assert not growth.is_due(1, ball(1.0), REACHES)
    assert growth.is_due(1, ball(1.0), MISSES)


def test_an_option_made_elsewhere_stays_what_it_is() -> None:
    growth = OptionGrowth()
    assert not any(growth.is_due(3, ball(2.0), REACHES) for _ in range(5))
