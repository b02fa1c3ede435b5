"""The three kinds of proposals: what options are learned for them."""

from typing import Any

import numpy as np
import pytest

from sb3_options.density.regions import Region
from sb3_options.experience.observations import flatten
from sb3_options.experience.trajectories import LabelledTrajectory
from sb3_options.options.bank import OptionBank
from sb3_options.options.creation import learn_option
from sb3_options.options.initiation import leading
from sb3_options.options.option import SubgoalOption
from sb3_options.options.proposals import IntrinsicReward, Passage, Proposal, everywhere
from sb3_options.options.settings import OptionLearningSettings
from sb3_options.options.tasks import Climbing, Reaching, transitions_of
from tests.options.corridor import DOOR, LEFT, RIGHT, generator, walk
from tests.support.helpers import ball

PLACES = np.arange(8.0)[:, None]
BOTH_WAYS = [walk([1, 2, 3, 4, 5, 6]), walk([6, 5, 4, 3, 2, 1])]


def hill(*potentials: float) -> IntrinsicReward:
    """f of places 0, 1, 2 …"""
    places = np.arange(float(len(potentials)))[:, None]
    return IntrinsicReward(places, np.array(potentials), np.ones(1), 0.5)


def option_for(
    proposal: Proposal, trajectories: list[LabelledTrajectory] | None = None, **settings: object
) -> SubgoalOption | None:
    how = OptionLearningSettings(**{"value_function": "table", **settings})  # type: ignore[arg-type]  # of any setting
    option = learn_option(proposal, trajectories or BOTH_WAYS, 2, how, generator())
    return option and option.bind(flatten)


def inside(option: SubgoalOption) -> list[int]:
    return np.flatnonzero(option.initiation(PLACES)).tolist()


class TestIntrinsicReward:
    def test_it_climbs_and_stops_at_the_top(self) -> None:
        option = option_for(hill(0, 1, 2, 3, 4, 3, 2))
        assert option is not None
        assert inside(option) == [1, 2, 3, 5, 6]
        assert option.policy(PLACES[[1, 2, 3, 5, 6]]).tolist() == [RIGHT, RIGHT, RIGHT, LEFT, LEFT]
        assert np.flatnonzero(option.termination(PLACES)).tolist() == [4]
        assert option.subgoal.points[0, 0] == 4.0

    def test_gamma_says_whether_a_dip_is_crossed(self) -> None:
        dip = hill(0, 1, 2, 1, 1, 3, 3.5)
        far, near = option_for(dip, gamma=0.99), option_for(dip, gamma=0.3)
        assert far is not None
        assert near is not None
        assert inside(far) == [1, 2, 3, 4, 5]
        assert inside(near) == [1, 3, 4, 5]  # 2 is a top: what comes after the dip is worth too little
        assert option_for(hill(3, 2, 2, 2, 2, 2, 2), gamma=0.5) is None  # 0 was never visited

    def test_rewards_are_differences_and_stopping_is_worth_nothing(self) -> None:
        settings = OptionLearningSettings()
        steps = transitions_of(Climbing(hill(0, 5, 7, 7)), [walk([1, 2, 3, 2, 9])], settings)
        assert steps is not None
        assert steps.rewards.tolist() == [2.0, 0.0, 0.0]  # f is not known at 9
        assert steps.stop == 0.0

    def test_a_network_learns_it_too(self) -> None:
        option = option_for(hill(0, 1, 2, 3, 4, 5, 6), value_function="network", network_updates=600, gamma=0.9)
        assert option is not None
        assert set(inside(option)) >= {1, 2, 3, 4}
        assert option.policy(PLACES[1:5]).tolist() == [RIGHT] * 4

    def test_with_a_network_it_ends_where_it_does_with_a_table(self) -> None:
        """A network's values are above 0 at the top, too, and the option would go on for ever."""
        made = [option_for(hill(0, 1, 2, 3, 4, 3, 2), value_function=how) for how in ("network", "table")]
        by_network, by_table = (option for option in made if option is not None)
        assert inside(by_network) == inside(by_table)
        assert np.flatnonzero(by_network.termination(PLACES)).tolist() == [4]

    def test_a_flat_reward_makes_no_option(self) -> None:
        assert option_for(hill(1, 1, 1, 1, 1, 1, 1)) is None

    @pytest.mark.parametrize(("points", "potentials"), [((3, 1), (2,)), ((3,), (3,)), ((3, 2), (3,))])
    def test_arrays_must_fit(self, points: tuple[int, ...], potentials: tuple[int, ...]) -> None:
        with pytest.raises(ValueError, match=r"^points, potentials and scale must be \(n, d\), \(n,\) and \(d,\)"):
            IntrinsicReward(np.zeros(points), np.zeros(potentials), np.ones(1), 0.5)


class TestPassage:
    everywhere = Region(PLACES, np.ones(1), 0.5)

    def test_it_leads_from_wherever_saved_steps_do(self) -> None:
        one_way = [walk([1, 2, 3, 4, 5]), walk([5, 6, 7])]
        option = option_for(Passage(DOOR, self.everywhere), one_way)
        assert option is not None
        assert inside(option) == [1, 2, 3, 4]  # no step leads back from 6 and 7
        assert option.policy(PLACES[1:5]).tolist() == [RIGHT] * 4

    @pytest.mark.parametrize("initiation", [None, np.zeros((1, 1)), hill(0, 1)])
    def test_both_parts_must_be_regions(self, initiation: Any) -> None:
        with pytest.raises(TypeError, match=r"^initiation of a Passage must be a Region, got "):
            Passage(DOOR, initiation)

    def test_it_stays_in_its_set(self) -> None:
        passage = Passage(DOOR, Region(PLACES[[1, 3, 4]], np.ones(1), 0.5))
        began = leading(passage, BOTH_WAYS, OptionLearningSettings()).points.ravel()
        assert began.tolist() == [3.0, 4.0]  # 2 would have to be crossed

    def test_its_states_have_the_radius_of_the_settings(self) -> None:
        """In continuous spaces steps lead to where nobody stood."""
        for radius in (0.25, 1.5):
            began = leading(Passage(DOOR, everywhere(1)), BOTH_WAYS, OptionLearningSettings(initiation_radius=radius))
            assert (began.radius, began.scale.tolist()) == (radius, [1.0])

    def test_none_where_no_step_leads_there(self) -> None:
        assert option_for(Passage(ball(30.0), self.everywhere)) is None


def test_a_file_says_which_options_stay_as_they_are(tmp_path: object) -> None:
    bank = OptionBank(2, 2)
    for proposal in (DOOR, hill(0, 1, 2, 3, 4, 5, 6)):
        option = option_for(proposal)
        assert option is not None
        bank.add(option)
    bank.save(f"{tmp_path}/options")
    other = OptionBank(2, 2)
    other.load(f"{tmp_path}/options")
    assert [option.fixed for option in other.slots if isinstance(option, SubgoalOption)] == [False, True]


def test_values_of_reaching_are_not_those_of_stopping() -> None:
    settings = OptionLearningSettings()
    steps = transitions_of(Reaching(DOOR, ball(4.0), settings), [walk([4, 5])], settings)
    assert steps is not None
    assert steps.stop == -np.inf
