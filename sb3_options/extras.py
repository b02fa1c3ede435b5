"""The command that installs a missing package."""


def how_to_install(*extras: str) -> str:
    """Return the command that installs extras, for a release or in a checkout."""
    which = f"[{','.join(extras)}]"
    return f"pip install 'sb3-options{which}' (in a checkout '.{which}')"
