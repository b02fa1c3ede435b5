"""Documents whose numbers a study fills in."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_options.atomic import atomic_write


def fill(document: Path, parts: Mapping[str, str]) -> None:
    """Replace what stands between ``<!-- NAME -->`` and ``<!-- end NAME -->`` for every name.

    Raises:
        ValueError: The document does not have exactly these two marks of a name, in this order.
    """
    text = document.read_text(encoding="utf-8")
    for name, part in parts.items():
        text = _filled(text, name, part, document)
    with atomic_write(document) as temporary:
        temporary.write_text(text, encoding="utf-8")


def settings_table(settings: dict[str, dict[str, Any]]) -> str:
    """Each setting, and whether the paper gives it."""
    rows = ["| setting | value | in the paper |", "|---|---|---|"]
    rows += [f"| `{name}` | {s['value']} | {s['in_paper'] or 'no'} |" for name, s in settings.items()]
    return "\n".join(rows)


def number(interval: Mapping[str, Any], key: str = "mean", *, decimals: int = 2) -> str:
    """An estimate with its interval, if it has one."""
    if interval[key] is None:
        return "–"
    around = "" if interval["low"] is None else f" ({interval['low']:.{decimals}f} to {interval['high']:.{decimals}f})"
    return f"{interval[key]:.{decimals}f}{around}"


def _filled(text: str, name: str, part: str, document: Path) -> str:
    """The text with ``part`` between the markers of that name."""
    pieces = re.split(rf"(<!-- (?:end )?{name} -->)", text)
    if pieces[1::2] != [f"<!-- {name} -->", f"<!-- end {name} -->"]:
        raise ValueError(f"{document} must have one <!-- {name} --> and one <!-- end {name} --> after it.")
    pieces[2] = f"\n{part}\n"
    return "".join(pieces)
