"""What to type where a package is missing."""

from __future__ import annotations


def how_to_install(*extras: str) -> str:
    """The command that installs extras, of a release or in a checkout."""
    which = f"[{','.join(extras)}]"
    return f"pip install 'sb3-options{which}' (in a checkout '.{which}')"
