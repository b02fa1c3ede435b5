"""The console script ``sb3-options``, and ``python -m sb3_options``."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; without arguments show its help."""
    try:
        from sb3_options import cli
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("sb3_options"):
            raise
        sys.exit(f"sb3-options needs the package {error.name}: pip install 'sb3-options[train,contrib]'")
    cli.main(sys.argv[1:] or ["--help"])


if __name__ == "__main__":
    main()
