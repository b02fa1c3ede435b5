"""Documents whose numbers a study fills in."""

from __future__ import annotations

import dataclasses
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


def described(settings: Any, in_paper: Mapping[str, str | None]) -> dict[str, dict[str, Any]]:
    """For results.json: the value of each setting of a dataclass, and what the paper says of it (None: nothing)."""
    values = dataclasses.asdict(settings)
    return {name: {"value": value, "in_paper": in_paper.get(name)} for name, value in values.items()}


def settings_lines(settings: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Each setting, for the screen."""
    return [f"  {name} = {s['value']} ({s['in_paper'] or 'not in the paper'})" for name, s in settings.items()]


def settings_table(settings: dict[str, dict[str, Any]]) -> str:
    """Each setting, and whether the paper gives it."""
    rows = ["| setting | value | in the paper |", "|---|---|---|"]
    rows += [f"| `{name}` | {s['value']} | {s['in_paper'] or 'no'} |" for name, s in settings.items()]
    return "\n".join(rows)


def number(interval: Mapping[str, Any] | None, key: str = "mean", *, form: str = "{:.2f}") -> str:
    """An estimate with its interval, if it has one; nothing where there is no estimate to make."""
    if interval is None:
        return ""
    if interval[key] is None:
        return "–"
    text, *ends = (form.format(interval[k]) for k in (key, "low", "high") if interval[k] is not None)
    return f"{text} ({' to '.join(ends)})" if ends else text


def _filled(text: str, name: str, part: str, document: Path) -> str:
    """The text with ``part`` between the markers of that name."""
    pieces = re.split(rf"(<!-- (?:end )?{name} -->)", text)
    if pieces[1::2] != [f"<!-- {name} -->", f"<!-- end {name} -->"]:
        raise ValueError(f"{document} must have one <!-- {name} --> and one <!-- end {name} --> after it.")
    pieces[2] = f"\n{part}\n"
    return "".join(pieces)
