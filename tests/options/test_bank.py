import errno
import json
import os
import pickle
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import load as from_safetensors
from safetensors.numpy import save as to_safetensors

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import HalfSpace, Region
from sb3_options.experience.observations import FloatArray, Observations, flatten
from sb3_options.options.bank import OptionBank
from sb3_options.options.file import FILE_FORMAT, digest
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import NetworkPolicy, TabularPolicy
from tests.support import processes
from tests.support.helpers import steady_option

N_PRIMITIVE, SIZE, CAPACITY = 4, 3, 5

ONE_FEATURE = (
    "does not fit: the option in slot 0, 'subgoal': its group 'second' names feature 1, the feature map gives 1. "
    "Discover options on groups that both tasks have, SubgoalDiscoveryCallback(groups=...). In MiniGrid what a mission "
    "asks for is such a group: discover with make(..., asked=False), train.py --env-kwargs asked:False."
)


def first_two(observations: Observations) -> FloatArray:
    return flatten(observations)[:, :2]


def table(seed: int = 0, *, size: int = SIZE, n_primitive: int = N_PRIMITIVE, features: int = 2) -> SubgoalOption:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(30, n_primitive))
    values[rng.random(values.shape) < 0.3] = -np.inf
    return SubgoalOption(
        Region(0.3 * rng.normal(size=(1, features)), rng.uniform(0.5, 2.0, size=features), 0.6),
        Region(rng.normal(size=(12, features)), rng.uniform(0.5, 2.0, size=features), 0.8),
        TabularPolicy(rng.normal(size=(30, size)), values),
        max_duration=17 + seed,
        name=f"table {seed}",
    )


def network(seed: int = 1) -> SubgoalOption:
    rng = np.random.default_rng(seed)
    policy = NetworkPolicy(
        rng.normal(size=SIZE),
        rng.uniform(0.5, 2.0, size=SIZE),
        [rng.normal(size=(SIZE, 8)), rng.normal(size=(8, N_PRIMITIVE))],
        [rng.normal(size=8), rng.normal(size=N_PRIMITIVE)],
    )
    option = table(seed)
    return SubgoalOption(option.subgoal, option.initiation_set, policy, max_duration=3, name="network: π ≠ β")


def empty_bank(**changes: Any) -> OptionBank:
    about: dict[str, Any] = {"feature_map": first_two, "observation_size": SIZE, "feature_size": 2, **changes}
    return OptionBank(about.pop("n_primitive", N_PRIMITIVE), about.pop("max_options", CAPACITY), **about)


def filled_bank() -> OptionBank:
    bank = empty_bank()
    bank.add(table(), 1)
    bank.add(network(), 3)
    return bank


def behaviour(bank: OptionBank, observations: FloatArray) -> list[Any]:
    """I, π, β and the rest of every option."""
    return [
        None
        if option is None
        else (
            option.name,
            option.max_duration,
            option.initiation(observations).tolist(),
            option.policy(observations).tolist(),
            option.termination(observations).tolist(),
        )
        for option in bank.slots
    ]


OBSERVATIONS = np.random.default_rng(7).normal(size=(1000, SIZE))


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

    def test_a_named_slot_is_replaced(self) -> None:
        bank = OptionBank(2, 3)
        first, second = steady_option(), steady_option()
        assert bank.add(first, 2) == 2
        assert bank.add(second, 2) == 2
        assert bank.slots == (None, None, second)

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

    def test_empty_already(self) -> None:
        bank = OptionBank(2, 3)
        with pytest.raises(ValueError, match=r"^Slot 1 is empty already\.$"):
            bank.remove(1)

    def test_not_an_option(self) -> None:
        with pytest.raises(TypeError, match=r"^option must be an Option, got str\.$"):
            OptionBank(2, 3).add("go")  # type: ignore[arg-type]  # the point of the test

    def test_arguments(self) -> None:
        with pytest.raises(ValueError, match=r"^n_primitive must be at least 1, got 0\.$"):
            OptionBank(0, 3)
        with pytest.raises(ValueError, match=r"^max_options must be a whole number of at least 0, got -2\.$"):
            OptionBank(3, -2)

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

    def test_a_bank_without_feature_map_leaves_an_option_its_own(self) -> None:
        bank = empty_bank(feature_map=None)
        bank.add(table().bind(first_two))
        assert bank.available(OBSERVATIONS)[:, N_PRIMITIVE].any()

    def test_pickle_leaves_the_feature_map_behind(self) -> None:
        bank = empty_bank(feature_map=lambda obs: flatten(obs)[:, :2])
        bank.add(table())
        copied = pickle.loads(pickle.dumps(bank))
        assert copied.feature_map is None
        copied.bind(first_two)
        assert behaviour(copied, OBSERVATIONS) == behaviour(bank, OBSERVATIONS)


class TestFile:
    def test_save_new_process_load(self, tmp_path: Path) -> None:
        """I, π and β on 1,000 observations are the same in a process that shares nothing but the file."""
        bank = filled_bank()
        bank.save(tmp_path / "new" / "options.safetensors")
        np.save(tmp_path / "observations.npy", OBSERVATIONS)
        script = """if True:
            import json, sys
            import numpy as np
            from sb3_options import OptionBank

            folder = sys.argv[1]
            observations = np.load(folder + "/observations.npy")
            bank = OptionBank(4, 5, feature_map=lambda obs: obs[:, :2], observation_size=3, feature_size=2)
            bank.load(folder + "/new/options.safetensors")
            print(json.dumps([
                o and (
                    o.name, o.max_duration, o.initiation(observations).tolist(), o.policy(observations).tolist(),
                    o.termination(observations).tolist(),
                ) for o in bank.slots
            ]))
        """
        process = processes.python("-c", script, str(tmp_path), cwd=tmp_path)
        expected = behaviour(bank, OBSERVATIONS)
        assert [o if o is None else tuple(o) for o in json.loads(process.stdout)] == expected
        for option in (expected[1], expected[3]):
            assert 0 < sum(option[2]) < 1000
            assert len(set(option[3])) > 1
            assert 0 < sum(option[4]) < 1000

    def test_slots_that_the_file_does_not_name_are_left_alone(self, tmp_path: Path) -> None:
        filled_bank().save(tmp_path / "options")
        bank = empty_bank()
        mine = steady_option()
        bank.add(mine, 0)
        bank.add(steady_option(), 1)
        bank.load(tmp_path / "options")
        assert bank[0] is mine
        assert bank.filled == (0, 1, 3)
        assert behaviour(bank, OBSERVATIONS)[1:] == behaviour(filled_bank(), OBSERVATIONS)[1:]

    def test_empty_and_larger_banks(self, tmp_path: Path) -> None:
        empty_bank().save(tmp_path / "empty")
        bank = empty_bank()
        bank.load(tmp_path / "empty")
        assert len(bank) == 0
        filled_bank().save(tmp_path / "options")
        larger = empty_bank(max_options=9, observation_size=None, feature_size=None)
        larger.load(str(tmp_path / "options"))
        assert larger.filled == (1, 3)

    def test_an_option_without_initiation_states_and_numbers_of_other_types(self, tmp_path: Path) -> None:
        bank = empty_bank()
        scale: Any = np.ones(2, dtype=np.float32)
        single, whole = cast("float", np.float32(0.5)), cast("int", np.int64(5))
        nowhere = Region(np.zeros((0, 2)), scale, single)
        subgoal = Region(np.array([[1.0, 2.0]]), scale, 1)
        bank.add(SubgoalOption(subgoal, nowhere, table().option_policy, max_duration=whole))
        bank.save(tmp_path / "options")
        again = empty_bank()
        again.load(tmp_path / "options")
        assert behaviour(again, OBSERVATIONS) == behaviour(bank, OBSERVATIONS)

    def test_a_half_space_comes_back_as_one(self, tmp_path: Path) -> None:
        bank, flat = empty_bank(), table()
        half_space = HalfSpace(np.array([[0.3, -0.2]]), np.ones(2), 0.0, np.array([1.0, 2.0]))
        bank.add(SubgoalOption(half_space, flat.initiation_set, flat.option_policy))
        bank.add(table(1))
        bank.save(tmp_path / "bank.safetensors")
        loaded = empty_bank()
        loaded.load(tmp_path / "bank.safetensors")
        subgoal, ball = loaded[0].subgoal, loaded[1].subgoal  # type: ignore[union-attr]  # both are SubgoalOptions
        assert isinstance(subgoal, HalfSpace)
        assert not isinstance(ball, HalfSpace)
        points = np.random.default_rng(0).normal(size=(50, 2))
        np.testing.assert_array_equal(subgoal.contains(points), half_space.contains(points))
        np.testing.assert_array_equal(subgoal.contains(points), (points - [0.3, -0.2]) @ [1.0, 2.0] >= 0)
        with safe_open(tmp_path / "bank.safetensors", framework="numpy") as file:
            assert file.metadata()["format"] == "sb3-options 2"
        bank.remove(0)
        bank.save(tmp_path / "balls.safetensors")
        with safe_open(tmp_path / "balls.safetensors", framework="numpy") as file:
            assert file.metadata()["format"] == "sb3-options 1"

    def test_an_option_on_a_group_of_features(self, tmp_path: Path) -> None:
        group = FeatureGroup("second", [1], present=[[1]], scale=[2])
        policy = TabularPolicy(np.array([[1.0], [2.0]]), np.eye(N_PRIMITIVE)[:2])
        subgoal = Region(np.array([[3.0]]), np.array([2.0]), 0.5, group=group)
        initiation = Region(np.array([[1.0], [2.0]]), np.array([2.0]), 0.5, group=group)
        bank = empty_bank()
        bank.add(SubgoalOption(subgoal, initiation, policy, policy_input="features"))
        bank.save(tmp_path / "options")
        loaded = empty_bank()
        loaded.load(tmp_path / "options")
        points = np.array([[9.0, 1.0], [-9.0, 2.0], [0.0, 3.0], [1.0, 0.0]])
        for option in (bank[0], loaded[0]):
            assert isinstance(option, SubgoalOption)
            assert option.subgoal.group == option.initiation_set.group == group
            option = option.bind(lambda observations: observations)  # type: ignore[arg-type,return-value]  # identity
            assert option.initiation(points).tolist() == [True, True, False, False]
            assert option.termination(points).tolist() == [0, 0, 1, 0]
            assert option.policy(points[:2]).tolist() == [0, 1]
        with safe_open(tmp_path / "options", framework="numpy") as file:
            assert file.metadata()["format"] == "sb3-options 3"
        narrow = OptionBank(N_PRIMITIVE, 4, feature_size=1)
        with pytest.raises(ValueError, match=f"{re.escape(ONE_FEATURE)}$"):
            narrow.load(tmp_path / "options")

    def test_an_option_that_sees_more_than_its_subgoal_says(self, tmp_path: Path) -> None:
        group = FeatureGroup("second", [1], scale=[2], seen={"name": "both", "features": [1, 0], "scale": [2, 1]})
        policy = TabularPolicy(np.array([[1.0, 0.0], [1.0, 5.0]]), np.eye(N_PRIMITIVE)[:2])
        subgoal = Region(np.array([[3.0]]), np.array([2.0]), 0.5, group=group)
        initiation = Region(np.array([[1.0, 0.0], [1.0, 5.0]]), np.array([2.0, 1.0]), 0.5, group=group.sees)
        bank = empty_bank()
        bank.add(SubgoalOption(subgoal, initiation, policy, policy_input="features"))
        bank.save(tmp_path / "options")
        loaded = empty_bank()
        loaded.load(tmp_path / "options")
        points = np.array([[0.0, 1.0], [5.0, 1.0], [2.0, 1.0], [7.0, 3.0]])
        for option in (bank[0], loaded[0]):
            assert isinstance(option, SubgoalOption)
            assert (option.subgoal.group, option.initiation_set.group) == (group, group.sees)
            option = option.bind(lambda observations: observations)  # type: ignore[arg-type,return-value]  # identity
            assert option.initiation(points).tolist() == [True, True, False, False]
            assert option.termination(points).tolist() == [0, 0, 0, 1]
            assert option.policy(points[:2]).tolist() == [0, 1]
        narrow = replace(subgoal, group=replace(group, seen={"name": "one", "features": [1]}))
        other = empty_bank()
        other.add(SubgoalOption(narrow, initiation, policy, policy_input="features"))
        other.save(tmp_path / "wrong")
        with pytest.raises(ValueError, match="its initiation set has 2 features, its group names 1"):
            empty_bank().load(tmp_path / "wrong")

    def test_hand_made_options_must_be_there_already(self, tmp_path: Path) -> None:
        bank = filled_bank()
        bank.add(steady_option(name="mine"), 0)
        bank.save(tmp_path / "options")
        other = empty_bank()
        message = (
            r"options does not fit: slot 0 held the hand-made option 'mine', which is code and not in the file; "
            r"add it to the bank first\.$"
        )
        with pytest.raises(ValueError, match=message):
            other.load(tmp_path / "options")
        assert len(other) == 0
        other.add(steady_option(name="yours"), 0)
        with pytest.raises(ValueError, match=message):
            other.load(tmp_path / "options")
        mine = steady_option(name="mine")
        other.add(mine, 0)
        other.load(tmp_path / "options")
        assert other[0] is mine
        assert other.filled == (0, 1, 3)

    @pytest.mark.parametrize(("owner", "name"), [(os, "fsync"), (Path, "replace"), (Path, "write_bytes")])
    def test_a_full_disk_leaves_the_old_file(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str
    ) -> None:
        path = tmp_path / "options.safetensors"
        empty_bank().save(path)
        old = path.read_bytes()

        def full(*_: Any) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(owner, name, full)
        with pytest.raises(OSError, match="No space left on device"):
            filled_bank().save(path)
        monkeypatch.undo()
        assert [p.name for p in tmp_path.iterdir()] == ["options.safetensors"]
        assert path.read_bytes() == old


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("options")


@pytest.fixture(scope="module")
def content(folder: Path) -> bytes:
    filled_bank().save(folder / "whole")
    return (folder / "whole").read_bytes()


def refused(path: Path, message: str, **changes: Any) -> None:
    """Loading raises ValueError, and the bank keeps what it had."""
    bank = empty_bank(**changes)
    if bank.max_options:
        bank.add(steady_option(), 0)
    before = bank.slots
    with pytest.raises(ValueError, match=message):
        bank.load(path)
    assert bank.slots == before


class TestDamage:
    def test_no_such_file(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"^There is no options file at .+nowhere\.$"):
            empty_bank().load(tmp_path / "nowhere")

    def test_truncated_anywhere(self, content: bytes, folder: Path) -> None:
        path = folder / "truncated"
        header = 8 + int.from_bytes(content[:8], "little")
        cuts = {*range(12), *range(0, len(content), 97), header - 1, header, header + 1, len(content) - 1}
        for cut in sorted(cuts):
            path.write_bytes(content[:cut])
            refused(path, r"truncated is no options file, or it is damaged: ")
        path.write_bytes(content + b"\0")
        refused(path, r"truncated is no options file, or it is damaged: ")

    @settings(max_examples=300, deadline=None)
    @given(data=st.data())
    def test_corrupted_anywhere(self, content: bytes, folder: Path, data: st.DataObject) -> None:
        """A changed byte is noticed, unless it changes nothing that the file says."""
        damaged = bytearray(content)
        for _ in range(data.draw(st.integers(1, 4))):
            # Half of the changes in the header, where most of what can go wrong is.
            end = data.draw(st.sampled_from([8, 8 + int.from_bytes(content[:8], "little"), len(content)]))
            damaged[data.draw(st.integers(0, end - 1))] = data.draw(st.integers(0, 255))
        path = folder / "corrupted"
        path.write_bytes(damaged)
        bank = empty_bank()
        message = None
        try:
            bank.load(path)
        except ValueError as error:
            message = str(error)
        if message is not None:
            assert "corrupted" in message  # it says which file
            assert bank.slots == (None,) * CAPACITY
        else:
            assert behaviour(bank, OBSERVATIONS[:50]) == behaviour(filled_bank(), OBSERVATIONS[:50])

    @settings(max_examples=100, deadline=None)
    @given(data=st.binary(max_size=200))
    def test_anything_else(self, folder: Path, data: bytes) -> None:
        path = folder / "anything"
        path.write_bytes(data)
        refused(path, "anything is no options file")

    @pytest.mark.parametrize("position", range(0, 2000, 100))
    def test_one_bit_of_an_array(self, content: bytes, folder: Path, position: int) -> None:
        damaged = bytearray(content)
        damaged[-1 - position] ^= 1
        path = folder / "bit"
        path.write_bytes(damaged)
        refused(path, r"bit is damaged: its contents are not what was written to it\.$")

    def test_a_file_can_run_no_code(self, tmp_path: Path) -> None:
        class Hostile:
            def __reduce__(self) -> tuple[Any, tuple[str]]:
                return (os.system, (f"touch {tmp_path / 'ran'}",))

        for hostile in (Hostile(), {"format": FILE_FORMAT, "bank": Hostile()}):
            path = tmp_path / "hostile.safetensors"
            path.write_bytes(pickle.dumps(hostile))
            refused(path, "hostile.safetensors is no options file, or it is damaged")
            assert not (tmp_path / "ran").exists()
            pickle.loads(path.read_bytes())  # the trap is real
            assert (tmp_path / "ran").exists()
            (tmp_path / "ran").unlink()

    def test_another_safetensors_file(self, tmp_path: Path) -> None:
        (tmp_path / "weights").write_bytes(to_safetensors({"w": np.zeros(3)}))
        versions = r"'sb3-options 1', 'sb3-options 2', 'sb3-options 3'\.$"
        message = rf"weights is no options file of this version: its format is None, expected one of {versions}"
        refused(tmp_path / "weights", message)


class TestOtherTasks:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"n_primitive": 3}, r"does not fit: its options choose among 4 primitive actions, this task has 3\.$"),
            (
                {"max_options": 3},
                r"does not fit: it has an option in slot 3, this bank only has 3 slots; make the wrapper with "
                r"max_options=5\.$",
            ),
            ({"max_options": 0}, r"it has an option in slot 1, this bank only has 0 slots"),
            (
                {"observation_size": 2},
                r"the option in slot 1, .*: its table has observations of shape \(30, 3\) and values of shape "
                r"\(30, 4\), expected 2 numbers an observation and 4 primitive actions\.$",
            ),
            (
                {"feature_size": 3},
                r"the option in slot ., .*: its subgoals have 2 features, the feature map here gives 3\.$",
            ),
        ],
    )
    def test_refused(self, content: bytes, folder: Path, changes: dict[str, Any], message: str) -> None:
        path = folder / "other"
        path.write_bytes(content)
        refused(path, message, **changes)

    def test_a_policy_of_features_fits_their_number_and_not_the_observations(self, tmp_path: Path) -> None:
        bank, region = empty_bank(), Region(np.array([[1.0, 2.0]]), np.ones(2), 0.5)
        policy = TabularPolicy(np.array([[0.0, 0.0], [2.0, 2.0]]), np.eye(4)[:2])
        bank.add(SubgoalOption(region, region, policy, policy_input="features"))
        bank.save(tmp_path / "options")
        again = empty_bank()
        again.load(tmp_path / "options")
        option = again[0]
        assert isinstance(option, SubgoalOption)
        assert option.policy_input == "features"
        assert behaviour(again, OBSERVATIONS) == behaviour(bank, OBSERVATIONS)

    def test_a_network_for_other_observations(self, tmp_path: Path) -> None:
        bank = empty_bank()
        bank.add(network())
        bank.save(tmp_path / "options")
        refused(tmp_path / "options", r"its network maps 3 numbers to 4 actions.+expected 7", observation_size=7)


def resealed(content: bytes, change: Any) -> bytes:
    """The file with its parts changed by somebody who knows how to make the digest fit."""
    length = int.from_bytes(content[:8], "little")
    about = json.loads(json.loads(content[8 : 8 + length])["__metadata__"]["bank"])
    tensors = from_safetensors(content)
    change(about, tensors)
    text = json.dumps(about)
    return to_safetensors(tensors, {"format": FILE_FORMAT, "bank": text, "digest": digest(text, tensors)})


def put(**entries: Any) -> Any:
    return lambda about, tensors: about["slots"]["1"].update(entries)


def tensor(name: str, array: Any) -> Any:
    return lambda about, tensors: tensors.update({name: array}) if array is not None else tensors.pop(name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            put(max_duration=0),
            "slot 1, .*: max_duration must be a whole number of primitive steps, at least 1, got 0",
        ),
        (put(max_duration=float("inf")), "slot 1, .*: max_duration must be a whole number"),
        (put(max_duration=float("nan")), "slot 1, .*: max_duration must be a whole number"),
        (put(max_duration="10"), "slot 1, .*: max_duration must be a whole number"),
        (put(max_duration=None), "slot 1, .*: max_duration must be a whole number"),
        (put(policy_input="state"), "its policy acts on 'state', expected one of observation, features"),
        (put(radius={"subgoal": -1.0, "initiation": 1.0}), "its subgoal holds numbers that are not finite, or a neg"),
        (put(radius={"subgoal": 1.0, "initiation": float("nan")}), "its initiation holds numbers that are not finite"),
        (put(radius={"subgoal": 1.0}), "is damaged: KeyError"),
        (put(radius={"subgoal": "wide", "initiation": 1.0}), "is damaged: "),
        (put(radius={"subgoal": 10**400, "initiation": 1.0}), "is damaged: "),
        (put(radius=3), "is damaged: TypeError"),
        (lambda about, _: about.pop("slots"), "is damaged: KeyError"),
        (lambda about, _: about.update(slots=[1]), "is damaged: AttributeError"),
        (lambda about, _: about.update(slots={"first": {}}), "does not fit: invalid literal for int"),
        (lambda about, _: about.update(slots={"-1": {}}), "does not fit: it has an option in slot -1"),
        (lambda about, _: about.update(slots={"0": 5}), "is damaged: AttributeError"),
        (lambda about, _: about.update(slots={"0": {"hand_made": True}}), "is damaged: KeyError"),
        (tensor("1.subgoal", None), "is damaged: KeyError"),
        (tensor("1.subgoal", np.zeros(2)), r"its subgoal has points of shape \(2,\) and a scale of shape \(2,\)"),
        (
            tensor("1.subgoal_scale", np.ones(3)),
            r"its subgoal has points of shape \(1, 2\) and a scale of shape \(3,\)",
        ),
        (tensor("1.subgoal", np.full((1, 2), np.nan)), "its subgoal holds numbers that are not finite"),
        (tensor("1.initiation_scale", np.full(2, np.inf)), "its initiation holds numbers that are not finite"),
        (
            lambda about, tensors: tensors.update({"1.initiation": np.zeros((4, 3)), "1.initiation_scale": np.ones(3)}),
            "its initiation set has 3 features, its subgoal 2",
        ),
        (tensor("1.table_values", None), "its policy lacks the array 'network_mean'"),
        (tensor("3.network_bias_0", None), "its policy lacks the array 'network_bias_0'"),
        (tensor("3.network_weight_2", np.zeros((4, 4))), "its policy lacks the array 'network_bias_2'"),
        (tensor("3.network_weight_1", np.zeros((9, 4))), "its network maps 3 numbers to 4 actions"),
    ],
)
def test_a_strangers_file_that_makes_no_sense(content: bytes, folder: Path, change: Any, message: str) -> None:
    path = folder / "stranger"
    path.write_bytes(resealed(content, change))
    refused(path, "stranger .*" + message)


def test_resealing_itself_does_no_harm(content: bytes, folder: Path) -> None:
    path = folder / "resealed"
    path.write_bytes(resealed(content, put()))
    bank = empty_bank()
    bank.load(path)
    assert behaviour(bank, OBSERVATIONS) == behaviour(filled_bank(), OBSERVATIONS)


def test_metadata_that_is_no_json(folder: Path) -> None:
    for text in ("{", "[" * 100_000, "5"):
        path = folder / "nested"
        path.write_bytes(to_safetensors({}, {"format": FILE_FORMAT, "bank": text, "digest": digest(text, {})}))
        refused(path, "nested is damaged: ")
