"""What a bank wrote to a file comes back as it was, in another process too."""

import errno
import json
import os
import re
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from tests.options.banks import N_PRIMITIVE, OBSERVATIONS, behaviour, empty_bank, filled_bank
from tests.support import processes
from tests.support.helpers import steady_option

ONE_FEATURE = "does not fit, the option in slot 0, 'subgoal': group 'second' names feature 1, the feature map gives 1."


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
        narrow = OptionBank(N_PRIMITIVE, 4, feature_size=1)
        with pytest.raises(ValueError, match=f"{re.escape(ONE_FEATURE)}$"):
            narrow.load(tmp_path / "options")

    def test_hand_made_options_must_be_there_already(self, tmp_path: Path) -> None:
        bank = filled_bank()
        bank.add(steady_option(name="mine"), 0)
        bank.save(tmp_path / "options")
        other = empty_bank()
        message = r"options does not fit: slot 0 held the hand-made option 'mine'.+add it to the bank first"
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
        monkeypatch.setattr(owner, name, MagicMock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
        with pytest.raises(OSError, match="No space left on device"):
            filled_bank().save(path)
        monkeypatch.undo()
        assert [p.name for p in tmp_path.iterdir()] == ["options.safetensors"]
        assert path.read_bytes() == old
