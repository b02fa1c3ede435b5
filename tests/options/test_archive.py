"""Options inside a ``model.zip`` that may come from anybody."""

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from sb3_options import OptionBank
from sb3_options.options import archive
from sb3_options.options.archive import CARRIED, content_in, packed_text

CONTENT = OptionBank(4, 4).content()


def zipped(path: Path, members: Mapping[str, str | bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


def test_the_text_is_found_also_compressed(tmp_path: Path) -> None:
    data = json.dumps({CARRIED: packed_text(CONTENT)})
    for compression in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        path = zipped(tmp_path / "model.zip", {"data": data}, compression)
        assert content_in(path) == CONTENT
        OptionBank(4, 4).load(path)


@pytest.mark.parametrize(
    "members",
    [
        {"data": "no json"},
        {"data": json.dumps({CARRIED: 3})},
        {"data": json.dumps({CARRIED: "no base64!"})},
        {"data": json.dumps({CARRIED: packed_text(CONTENT)[:40]})},
        {"data": "[" * 100_000},
    ],
    ids=["data", "type", "text", "cut", "nested"],
)
def test_damage_is_said_in_one_line(members: dict[str, str], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"model\.zip is no options file, or it is damaged: ") as error:
        content_in(zipped(tmp_path / "model.zip", members))
    assert "\n" not in str(error.value)


def test_little_does_not_become_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive, "MAX_BYTES", 1_000)
    bomb: Any = b"\0" * 1_001
    for members in ({"data": bomb}, {"data": json.dumps({CARRIED: packed_text(bomb)})}):
        with pytest.raises(ValueError, match="more than 1,000 bytes"):
            content_in(zipped(tmp_path / "model.zip", members, zipfile.ZIP_DEFLATED))
