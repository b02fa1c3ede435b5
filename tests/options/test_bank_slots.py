"""Options move into the slots of a bank, stay there, and are available."""

import dataclasses
import pickle

import numpy as np
import pytest

from sb3_options.experience.observations import flatten
from sb3_options.options.bank import OptionBank
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

    def test_one_observation_is_answered_by_the_options_of_now(self) -> None:
        bank = filled_bank()
        for change in (lambda: None, lambda: bank.remove(1), lambda: bank.add(table(7)), lambda: bank.bind(first_two)):
            change()
            one_by_one = [bank.available_slots(OBSERVATIONS[i : i + 1])[0] for i in range(300) for _ in range(2)]
            np.testing.assert_array_equal(one_by_one[::2], bank.available_slots(OBSERVATIONS)[:300])
            np.testing.assert_array_equal(one_by_one[1::2], one_by_one[::2])

    @pytest.mark.parametrize("sees", ["observation", "features", "both", "hand-made"])
    def test_one_observation_is_answered_as_the_options_themselves_answer(
        self, sees: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("sb3_options.options.bank.CACHE_BYTES", 50 * 600)  # not all have room
        # The third number is no feature, so many observations have the same features.
        coarse = np.concatenate([OBSERVATIONS[:200, :2].round(), OBSERVATIONS[:200, 2:].round(1)], axis=1)
        bank = filled_bank() if sees == "observation" else empty_bank()
        if sees != "observation":
            bank.add(dataclasses.replace(table(size=2), policy_input="features"), 0)
        if sees == "both":
            bank.add(table(), 1)
        if sees == "hand-made":
            bank.add(steady_option(), 2)
        for change in (lambda: None, lambda: bank.add(dataclasses.replace(table(7, size=2), policy_input="features"))):
            change()
            for observation in coarse:
                one = observation[None]
                np.testing.assert_array_equal(bank.available_at(observation), bank.available_slots(one)[0])
                for slot in bank.filled:
                    option = bank[slot]
                    assert option is not None
                    assert bank.membership(slot, observation) == (option.initiation(one)[0], option.termination(one)[0])
                    assert bank.may_start(slot, observation) == option.initiation(one)[0]
                    assert bank.action(slot, observation) == option.policy(one)[0]

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
