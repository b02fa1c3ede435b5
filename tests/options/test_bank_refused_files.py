"""Files that are damaged, of another task or a stranger's are refused, and the bank keeps what it had."""

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import save as to_safetensors

from sb3_options.density.regions import Region
from sb3_options.options.file import FILE_FORMAT, opened
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from sb3_options.options.sealed import digest, sealed, unsealed
from tests.options.banks import CAPACITY, OBSERVATIONS, behaviour, empty_bank, filled_bank, network
from tests.support.helpers import steady_option


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("options")


@pytest.fixture(scope="module")
def content(folder: Path) -> bytes:
    filled_bank().save(folder / "whole")
    return (folder / "whole").read_bytes()


def refused(path: Path, message: str, content: bytes | None = None, **changes: Any) -> None:
    """Loading the file, with this content, raises ValueError, and the bank keeps what it had."""
    if content is not None:
        path.write_bytes(content)
    bank = empty_bank(**changes)
    if bank.max_options:
        bank.add(steady_option(), 0)
    before = bank.slots
    with pytest.raises(ValueError, match=message):
        bank.load(path)
    assert bank.slots == before


class TestDamage:
    def test_no_such_file(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"No such file or directory: .+nowhere"):
            empty_bank().load(tmp_path / "nowhere")

    @settings(max_examples=300)
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
        try:
            bank.load(path)
        except ValueError as error:
            assert "corrupted" in str(error)  # noqa: PT017  # it says which file; some changes are none
            assert bank.slots == (None,) * CAPACITY
        else:
            assert behaviour(bank, OBSERVATIONS[:50]) == behaviour(filled_bank(), OBSERVATIONS[:50])

    def test_a_file_can_run_no_code(self, tmp_path: Path) -> None:
        class Hostile:
            def __reduce__(self) -> tuple[Any, tuple[str]]:
                return (os.system, (f"touch {tmp_path / 'ran'}",))

        for hostile in (Hostile(), {"format": FILE_FORMAT, "bank": Hostile()}):
            content = pickle.dumps(hostile)
            refused(tmp_path / "hostile", "hostile is no options file, or it is damaged", content)
            assert not (tmp_path / "ran").exists()
            pickle.loads(content)  # the trap is real
            assert (tmp_path / "ran").exists()
            (tmp_path / "ran").unlink()

    def test_another_safetensors_file(self, tmp_path: Path) -> None:
        message = r"weights is no options file, or it is damaged: its format is None, expected 'sb3-options 1'\.$"
        refused(tmp_path / "weights", message, to_safetensors({"w": np.zeros(3)}))


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
            ({"max_options": 0}, r"it has an option in slot 3, this bank only has 0 slots"),
            (
                {"observation_size": 2},
                r"the option in slot 1, .*: its table has observations of shape \(30, 3\) and values of shape "
                r"\(30, 4\), expected 2 numbers an observation and 4 primitive actions, all finite\.$",
            ),
            ({"feature_size": 3}, r"the option in slot 1, .*: its subgoal has points of .*, expected 3 features"),
        ],
    )
    def test_refused(self, content: bytes, folder: Path, changes: dict[str, Any], message: str) -> None:
        refused(folder / "other", message, content, **changes)

    def test_a_policy_of_features_fits_their_number_and_not_the_observations(self, tmp_path: Path) -> None:
        bank, region = empty_bank(), Region(np.array([[1.0, 2.0]]), np.ones(2), 0.5)
        policy = TabularPolicy(np.array([[0.0, 0.0], [2.0, 2.0]]), np.eye(4)[:2])
        bank.add(SubgoalOption(region, region, policy, policy_input="features"))
        bank.save(tmp_path / "options")
        again = empty_bank()
        again.load(tmp_path / "options")
        assert getattr(again[0], "policy_input", None) == "features"
        assert behaviour(again, OBSERVATIONS) == behaviour(bank, OBSERVATIONS)

    def test_a_network_for_other_observations(self, tmp_path: Path) -> None:
        bank = empty_bank()
        bank.add(network())
        bank.save(tmp_path / "options")
        refused(tmp_path / "options", r"its network maps 3 numbers to 4 actions.+expected 7", observation_size=7)


def resealed(content: bytes, change: Any) -> bytes:
    """The file with its parts changed by somebody who knows how to make the digest fit."""
    parts, tensors = unsealed(content, FILE_FORMAT)
    change(parts["bank"], tensors)
    return sealed(FILE_FORMAT, parts, tensors)


def put(**entries: Any) -> Any:
    return lambda about, tensors: about["slots"]["1"].update(entries)


def tensor(name: str, array: Any) -> Any:
    return lambda about, tensors: tensors.update({name: array}) if array is not None else tensors.pop(name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put(max_duration=0), "1.max_duration should be greater than or equal to 1, got 0"),
        (put(max_duration=float("nan")), "max_duration should be a finite number"),
        (put(policy_input="state"), "policy_input should be 'observation' or 'features', got 'state'"),
        (put(radius={"subgoal": -1.0, "initiation": 1.0}), "radius.subgoal should be greater than or equal to 0"),
        (put(radius={"subgoal": 1.0}), r"slot 1, .*: KeyError\('initiation'\)"),
        (put(radius={"subgoal": 10**400, "initiation": 1.0}), "radius.subgoal should be a valid number"),
        (lambda about, _: about.update(slots=[1]), "slots should be a valid dictionary"),
        (lambda about, _: about.update(slots={"first": {}}), "slots.first.*should be a valid integer"),
        (lambda about, _: about.update(slots={"-1": {}}), "slots.-1.*should be greater than or equal to 0"),
        (lambda about, _: about.update(max_options=10**12), "max_options should be less than or equal to 1000000"),
        (lambda about, _: about.update(n_primitive=0), "n_primitive should be greater than or equal to 1"),
        (lambda about, _: about.update(made_for={"space": "Box"}), "made_for.*digest"),
        (tensor("1.table_states", np.zeros(())), r"its table has observations of shape \(\) and values of"),
        (tensor("1.table_states", np.full((30, 3), np.nan)), "its table has observations .* all finite"),
        (tensor("3.network_mean", np.zeros(())), "its network maps 1 numbers to 4 actions"),
        (tensor("1.subgoal", None), r"slot 1, .*: KeyError\('subgoal'\)"),
        (tensor("1.subgoal", np.zeros(2)), "the option in slot 1, "),
        (tensor("1.subgoal_scale", np.ones(3)), r"points of shape \(1, 2\) and a scale of shape \(3,\)"),
        (tensor("1.subgoal", np.full((1, 2), np.nan)), "its subgoal has points .* expected 2 features and finite"),
        (tensor("1.subgoal_normal", np.ones(3)), "its subgoal has points .* expected 2 features and finite"),
        (tensor("1.initiation", np.zeros((4, 3))), "its initiation has points .* expected 2 features"),
        (tensor("1.table_values", None), r"KeyError\('table_values'\)"),
        (tensor("3.network_bias_0", None), r"KeyError\('network_bias_0'\)"),
        (tensor("3.network_weight_1", np.zeros((9, 4))), "its network maps 3 numbers to 4 actions"),
    ],
)
def test_a_strangers_file_that_makes_no_sense(content: bytes, folder: Path, change: Any, message: str) -> None:
    refused(folder / "stranger", "stranger .*" + message, resealed(content, change))
    with pytest.raises(ValueError, match="stranger .*" + message):  # the same where there is no bank to fill
        opened(folder / "stranger").options()


@pytest.mark.parametrize("text", ["{", "[" * 100_000, "5"])
def test_metadata_that_is_no_json(folder: Path, text: str) -> None:
    metadata = {"format": FILE_FORMAT, "bank": text, "digest": digest({"bank": text}, {})}
    refused(folder / "nested", "nested is no options file, or it is damaged: ", to_safetensors({}, metadata))
