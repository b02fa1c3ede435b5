"""Options move into the slots of a bank, stay there, and are available."""

import dataclasses
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sb3_options.density.regions import Region
from sb3_options.experience.observations import FloatArray, Observations, flatten
from sb3_options.options.bank import FEW, HITS, TRIAL, OptionBank
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from tests.options.banks import (
    CAPACITY,
    N_PRIMITIVE,
    OBSERVATIONS,
    behaviour,
    empty_bank,
    filled_bank,
    first_two,
    table,
)
from tests.support.helpers import steady_option


def last_two(observations: Observations) -> FloatArray:
    return flatten(observations)[:, 1:]


class TestSlots:
    def test_options_fill_the_first_empty_slot_and_stay_there(self) -> None:
        bank = OptionBank(2, 3)
        options = [steady_option(name=str(i)) for i in range(4)]
        assert [bank.add(option) for option in options[:2]] == [0, 1]
        assert bank.remove(0) is options[0]
        assert (bank.slots, bank.filled, len(bank)) == ((None, options[1], None), (1,), 1)
        assert [bank.add(options[2]), bank.add(options[3])] == [0, 2]
        assert (bank.slots, bank.filled, len(bank)) == ((options[2], options[1], options[3]), (0, 1, 2), 3)
        assert bank[2] is options[3]

    def test_full(self) -> None:
        bank = OptionBank(2, 1)
        bank.add(steady_option())
        message = r"^All 1 option slots are filled: remove one, or make the wrapper with a larger max_options\.$"
        with pytest.raises(ValueError, match=message):
            bank.add(steady_option())
        assert (len(bank), bank.max_options) == (1, 1)
        with pytest.raises(ValueError, match=r"^All 0 option slots are filled"):
            OptionBank(2, 0).add(steady_option())

    @pytest.mark.parametrize("slot", [-1, 3, 100])
    def test_no_such_slot(self, slot: int) -> None:
        bank = OptionBank(2, 3)
        message = rf"^slot must be between 0 and 2, got {slot}\.$"
        with pytest.raises(ValueError, match=message):
            bank.add(steady_option(), slot)
        with pytest.raises(ValueError, match=message):
            bank.remove(slot)
        assert len(bank) == 0

    @pytest.mark.parametrize("room", [None, 50 * 600], ids=["with room", "without room for all"])
    @pytest.mark.parametrize("sees", ["observation", "features", "both", "hand-made"])
    def test_one_observation_is_answered_as_many_are(
        self, sees: str, room: int | None, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        if room is not None:
            monkeypatch.setattr("sb3_options.options.bank.CACHE_BYTES", room)
        # The third number is no feature, so many observations have the same features.
        coarse = np.concatenate([OBSERVATIONS[:200, :2].round(), OBSERVATIONS[:200, 2:].round(1)], axis=1)
        on_features = [dataclasses.replace(table(seed, size=2), policy_input="features") for seed in (0, 7)]
        bank = filled_bank() if sees == "observation" else empty_bank()
        if sees != "observation":
            bank.add(on_features[0], 0)
        if sees == "both":
            bank.add(table(), 1)
        if sees == "hand-made":
            bank.add(steady_option(), 2)
        changes: list[Callable[[], object]] = [
            lambda: None,
            lambda: bank.add(on_features[1], 4),
            lambda: bank.add(on_features[0], 4),
            lambda: bank.bind(last_two),
            lambda: bank.remove(4),
        ]
        for change in changes:
            change()
            expected = bank.available_slots(coarse)
            np.testing.assert_array_equal(bank.available_in(list(coarse)), expected)
            for _ in range(2):
                one_by_one = [bank.available_slots(coarse[i : i + 1])[0] for i in range(len(coarse))]
                np.testing.assert_array_equal(one_by_one, expected)
            members = {slot: option.membership(coarse) for slot in bank.filled if (option := bank[slot])}
            actions = {slot: option.policy(coarse) for slot in bank.filled if (option := bank[slot])}
            for i, observation in enumerate(coarse):
                np.testing.assert_array_equal(bank.available_at(observation), expected[i])
                for slot, (initiation, termination) in members.items():
                    assert bank.membership(slot, observation) == (initiation[i], termination[i])
                    assert bank.may_start(slot, observation) == initiation[i]
                    assert bank.action(slot, observation) == actions[slot][i]

    def test_a_few_observations_are_looked_up_while_they_recur(self) -> None:
        bank = filled_bank()
        slot = bank.filled[0]
        option: Any = bank[slot]
        assert bank.looks_up(slot, option, FEW)
        assert not bank.looks_up(slot, option, FEW + 1)
        assert not bank.looks_up(slot, dataclasses.replace(option), 1), "the bank holds another one"
        for observation in OBSERVATIONS[:TRIAL]:
            bank.action(slot, observation)
        assert not bank.looks_up(slot, option, 1)
        for _ in range(HITS):
            for observation in OBSERVATIONS[:TRIAL]:
                bank.action(slot, observation)
        assert bank.looks_up(slot, option, 1)
        bank.add(steady_option())
        assert not bank.looks_up(slot, option, 1), "a hand-made option may have a memory"

    def test_answers_to_observations_with_many_features_take_no_more_memory(self) -> None:
        codes = np.eye(4000)
        bank = OptionBank(N_PRIMITIVE, 1, feature_map=lambda observations: codes[np.asarray(observations).ravel()])
        scales, policy = np.ones(4000), TabularPolicy(np.zeros((1, 1)), np.zeros((1, N_PRIMITIVE)))
        bank.add(SubgoalOption(Region(codes[:1], scales, 0.5), Region(codes[1:3], scales, 0.5), policy))
        for number in range(300):
            assert bank.available_at(np.array(number)).tolist() == [number in (1, 2)]
        assert len(bank._answers) < 200

    def test_a_subclass_answers_for_itself(self) -> None:
        class Ends(SubgoalOption):
            def membership(self, observations: Any) -> Any:
                return np.ones(len(observations), dtype=bool), np.ones(len(observations))

        bank = empty_bank()
        one = table()
        bank.add(Ends(one.subgoal, one.initiation_set, one.option_policy), 0)
        assert {bank.membership(0, observation) for observation in OBSERVATIONS[:50]} == {(True, 1.0)}

    def test_available(self) -> None:
        bank = filled_bank()
        available = bank.available(OBSERVATIONS)
        assert (available.shape, available.dtype) == ((1000, N_PRIMITIVE + CAPACITY), np.dtype(bool))
        assert available[:, :N_PRIMITIVE].all()
        for slot, option in enumerate(bank.slots):
            expected = np.zeros(1000, dtype=bool) if option is None else option.initiation(OBSERVATIONS)
            np.testing.assert_array_equal(available[:, N_PRIMITIVE + slot], expected)
        assert 0 < available[:, N_PRIMITIVE + 1].sum() < 1000

    def test_discovered_options_are_bound_to_the_banks_feature_map(self) -> None:
        option = table()
        bank = empty_bank(feature_map=None)
        bank.add(option)
        with pytest.raises(ValueError, match="no feature map"):
            bank.available(OBSERVATIONS)
        bank.bind(first_two)
        assert bank.available(OBSERVATIONS).any(axis=0).sum() == N_PRIMITIVE + 1
        with pytest.raises(ValueError, match="no feature map"):
            option.initiation(OBSERVATIONS)

    def test_pickle_leaves_the_feature_map_behind(self) -> None:
        bank = empty_bank(feature_map=lambda obs: flatten(obs)[:, :2])
        bank.add(table())
        copied = pickle.loads(pickle.dumps(bank))
        assert copied.feature_map is None
        copied.bind(first_two)
        assert behaviour(copied, OBSERVATIONS) == behaviour(bank, OBSERVATIONS)
