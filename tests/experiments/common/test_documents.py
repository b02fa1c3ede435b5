from pathlib import Path

import pytest

from experiments.common.documents import fill, number


def test_numbers() -> None:
    interval = {"mean": 1234.5, "low": 1000.0, "high": 2000.0}
    assert number(interval) == "1234.50 (1000.00 to 2000.00)"
    assert number(interval, form="{:,.0f}") == "1,234 (1,000 to 2,000)"
    assert number({"value": 2.0, "low": None, "high": None}, "value") == "2.00"
    assert number({"mean": None, "low": None, "high": None}) == "–"
    assert number(None) == ""


def test_fills_between_the_marks(tmp_path: Path) -> None:
    document = tmp_path / "page.md"
    document.write_text("before <!-- a -->old<!-- end a --> after")
    for part in ("new", "newer"):
        fill(document, {"a": part})
        assert document.read_text() == f"before <!-- a -->\n{part}\n<!-- end a --> after"
    with pytest.raises(ValueError, match="must have one <!-- b --> and one <!-- end b --> after it"):
        fill(document, {"b": "new"})
